"""Skyloop: closes the loop between a camera and a small drone with a few lines of Python.

::

    import skyloop

    with skyloop.connect("sim://") as drone:
        drone.takeoff()
        drone.velocity(forward=0.3)

Every name is imported when it is first used, so that ``import skyloop`` loads nothing heavy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skyloop import aio
    from skyloop.client import (
        AuthorityStatus,
        ChannelStats,
        Distribution,
        Drone,
        Frame,
        LinkStatus,
        Listener,
        Logbook,
        Result,
        Swarm,
        TakeoverRequest,
        connect,
        swarm,
    )
    from skyloop.control import Controller, RunSummary
    from skyloop.errors import (
        AuthorityError,
        ClosedError,
        DecodeError,
        DriverError,
        FileFormatError,
        LinkError,
        MissingExtraError,
        NameTakenError,
        NoAnswerError,
        ParameterError,
        RefusedError,
        SkyloopError,
        SwarmError,
        UnknownNameError,
        UnsupportedError,
        UsageError,
    )
    from skyloop.messages import (
        Annotation,
        Applied,
        Attitude,
        CameraInfo,
        Capabilities,
        Command,
        EmergencyStop,
        Event,
        EventKind,
        Failsafe,
        Feedback,
        FlightState,
        Hover,
        Idle,
        Intrinsics,
        Land,
        LinkState,
        LogEntry,
        Parameter,
        Points,
        Polyline,
        Severity,
        Takeoff,
        Text,
        Velocity,
    )
    from skyloop.motion_capture import MotionCapture, mocap
    from skyloop.recording import Recorder, record

_HOMES = {
    "skyloop.client": (
        "AuthorityStatus",
        "ChannelStats",
        "Distribution",
        "Drone",
        "Frame",
        "LinkStatus",
        "Listener",
        "Logbook",
        "Result",
        "Swarm",
        "TakeoverRequest",
        "connect",
        "swarm",
    ),
    "skyloop.control": ("Controller", "RunSummary"),
    "skyloop.errors": (
        "AuthorityError",
        "ClosedError",
        "DecodeError",
        "DriverError",
        "FileFormatError",
        "LinkError",
        "MissingExtraError",
        "NameTakenError",
        "NoAnswerError",
        "ParameterError",
        "RefusedError",
        "SkyloopError",
        "SwarmError",
        "UnknownNameError",
        "UnsupportedError",
        "UsageError",
    ),
    "skyloop.messages": (
        "Annotation",
        "Applied",
        "Attitude",
        "CameraInfo",
        "Capabilities",
        "Command",
        "EmergencyStop",
        "Event",
        "EventKind",
        "Failsafe",
        "Feedback",
        "FlightState",
        "Hover",
        "Idle",
        "Intrinsics",
        "Land",
        "LinkState",
        "LogEntry",
        "Parameter",
        "Points",
        "Polyline",
        "Severity",
        "Takeoff",
        "Text",
        "Velocity",
    ),
    "skyloop.motion_capture": ("MotionCapture", "mocap"),
    "skyloop.recording": ("Recorder", "record"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "__version__",
    "aio",
    "Annotation",
    "Applied",
    "Attitude",
    "AuthorityError",
    "AuthorityStatus",
    "CameraInfo",
    "Capabilities",
    "ChannelStats",
    "ClosedError",
    "Command",
    "Controller",
    "DecodeError",
    "Distribution",
    "DriverError",
    "Drone",
    "EmergencyStop",
    "Event",
    "EventKind",
    "Failsafe",
    "Feedback",
    "FileFormatError",
    "FlightState",
    "Frame",
    "Hover",
    "Idle",
    "Intrinsics",
    "Land",
    "LinkError",
    "LinkState",
    "LinkStatus",
    "Listener",
    "LogEntry",
    "Logbook",
    "MissingExtraError",
    "MotionCapture",
    "NameTakenError",
    "NoAnswerError",
    "Parameter",
    "ParameterError",
    "Points",
    "Polyline",
    "Recorder",
    "RefusedError",
    "Result",
    "RunSummary",
    "Severity",
    "SkyloopError",
    "Swarm",
    "SwarmError",
    "Takeoff",
    "TakeoverRequest",
    "Text",
    "UnknownNameError",
    "UnsupportedError",
    "UsageError",
    "Velocity",
    "connect",
    "mocap",
    "record",
    "swarm",
]

__version__: str


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    elif name == "aio":
        value = import_module("skyloop.aio")
    elif name == "__version__":
        value = _version()
    else:
        raise AttributeError(f"module 'skyloop' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("skyloop")
    except PackageNotFoundError:
        return "0+unknown"
