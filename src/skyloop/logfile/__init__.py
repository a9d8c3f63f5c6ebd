"""Recording files: their layout, and reading them. Knows the messages and the MCAP format, nothing else."""
