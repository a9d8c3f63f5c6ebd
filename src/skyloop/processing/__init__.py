"""Processors: classes that process frames on any host and publish their results. See docs/processors.md."""

from skyloop.processing.worker import Code, Output, Settings, Status, Worker, load_processor

__all__ = ["Code", "Output", "Settings", "Status", "Worker", "load_processor"]
