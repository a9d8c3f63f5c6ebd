"""Controllers: an application's own control loop as a class."""

from skyloop.control.controller import Controller, RunSummary

__all__ = ["Controller", "RunSummary"]
