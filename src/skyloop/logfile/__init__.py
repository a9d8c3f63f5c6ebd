"""Recordings as files: what is in them, and reading them. Knows the messages and the MCAP format, nothing else."""
