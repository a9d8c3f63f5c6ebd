"""Motion capture by Vicon, OptiTrack and Qualisys (package ``motioncapture``), VRPN and the simulator's true poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from skyloop.motion_capture.capture import MotionCapture, Source, TrackEvent
from skyloop.motion_capture.pose import BodyPose, Calibration, TrackState, calibrate
from skyloop.motion_capture.source import SIM, VRPN, ChildSource, RawFrame, System, TruthSource, parse_system
from skyloop.motion_capture.vrpn import VrpnSource

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
    """Connect to a motion capture system and wait for its first frame.

    Positions are in metres, in world axes with z up.

    Args:
        address: ``vicon://HOST``, ``optitrack://HOST`` or ``qualisys://HOST`` (extra ``[mocap]``), ``vrpn://HOST``, or
            ``sim://`` for the true poses of simulated drones.
        bodies: Names of drones, mapped to the names of their bodies in the system, such as ``{"alpha": "alpha_body"}``.
            For VRPN, a body is either a tracker, such as ``"Rig"``, or one of its sensors, such as ``"Rig:2"``.
        timeout_s: Maximum time to wait for the first frame [s].

    Raises:
        UsageError: An argument is invalid, or a VRPN tracker has several sensors and none was specified.
        UnknownNameError: There is no such system or option.
        LinkError: No frame arrived within ``timeout_s``.
        MissingExtraError: The extra ``[mocap]`` is not installed.
        UnsupportedError: A simulated drone does not report its true pose.
    """
    system = parse_system(address)
    return MotionCapture(system, bodies, _source)._open(timeout_s)


def _source(
    system: System, names: Iterable[str], take: Callable[[RawFrame], None], trouble: Callable[[str], None]
) -> Source:
    if system.kind == SIM:
        return TruthSource(names, take)
    if system.kind == VRPN:
        return VrpnSource(system, names, take, trouble)
    return ChildSource(system, take, trouble)
