"""Motion capture: Vicon, OptiTrack, Qualisys and VRPN by the ``motioncapture`` package, and the simulator's truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from skyloop.motion_capture.address import SIM, System, parse_system
from skyloop.motion_capture.calibration import Calibration, calibrate
from skyloop.motion_capture.capture import MotionCapture, Source, TrackEvent
from skyloop.motion_capture.pose import BodyPose
from skyloop.motion_capture.source import ChildSource
from skyloop.motion_capture.tracking import TrackState
from skyloop.motion_capture.truth import TruthSource
from skyloop.motion_capture.worker import RawFrame

__all__ = [
    "BodyPose",
    "Calibration",
    "MotionCapture",
    "System",
    "TrackEvent",
    "TrackState",
    "calibrate",
    "mocap",
    "parse_system",
]


def mocap(address: str, bodies: Mapping[str, str], *, timeout_s: float = 10.0) -> MotionCapture:
    """Connect to a motion capture system; returns with its first frame.

    ``address``: ``vicon://HOST``, ``optitrack://HOST``, ``qualisys://HOST``, ``vrpn://HOST`` (extra ``[mocap]``), or
    ``sim://`` for the true poses of simulated drones. ``bodies``: names of drones to the names that the system gives
    their bodies, ``{"alpha": "alpha_body"}``. Positions in metres, world axes with z up.

    Raises :class:`UsageError`, :class:`UnknownNameError`, :class:`LinkError` if no frame comes within ``timeout_s``,
    and :class:`MissingExtraError`.
    """
    system = parse_system(address)
    return MotionCapture(system, bodies, _source).open(timeout_s)


def _source(
    system: System, names: Iterable[str], take: Callable[[RawFrame], None], trouble: Callable[[str], None]
) -> Source:
    return TruthSource(names, take) if system.kind == SIM else ChildSource(system, take, trouble)
