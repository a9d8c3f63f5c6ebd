"""Flight recordings: :func:`record` writes them to MCAP files, which other viewers can also open."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skyloop.recording.options import RecorderState, Status
    from skyloop.recording.recorder import Recorder, record

_HOMES = {
    "Recorder": "skyloop.recording.recorder",
    "RecorderState": "skyloop.recording.options",
    "Status": "skyloop.recording.options",
    "record": "skyloop.recording.recorder",
}

__all__ = ["Recorder", "RecorderState", "Status", "record"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'skyloop.recording' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
