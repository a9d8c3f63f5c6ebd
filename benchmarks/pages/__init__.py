"""Fill pages of the documentation with measured figures: ``python -m benchmarks.pages.NAME [FOLDER]``."""
