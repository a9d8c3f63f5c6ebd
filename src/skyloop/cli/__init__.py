"""The ``skyloop`` command."""

from skyloop.cli.app import main

__all__ = ["main"]
