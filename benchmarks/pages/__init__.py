"""Pages of the documentation, filled from what was measured: ``python -m benchmarks.pages.NAME [FOLDER]``."""
