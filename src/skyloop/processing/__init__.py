"""Processors: classes that process frames on any host and publish their results. See docs/processors.md."""

from skyloop.processing.loading import Code, load_processor
from skyloop.processing.worker import Output, Settings, Status, Worker

__all__ = ["Code", "Output", "Settings", "Status", "Worker", "load_processor"]
