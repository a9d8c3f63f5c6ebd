"""The drone's cameras as capabilities announce them. Pure.

Intrinsics: a calibration of one such drone as published with tello_ros, for pictures of 960×720; another drone's differ
by some per cent. Nothing is known of the lens of the camera that looks down.
"""

from __future__ import annotations

from typing import Final

import msgspec

from skyloop.drivers.intrinsics import intrinsics_of
from skyloop.drivers.uri import VehicleUri
from skyloop.messages import CameraInfo, Intrinsics

FRONT: Final = "front"
BOTTOM: Final = "bottom"
WIDTH: Final = 960
_CALIBRATION: Final = Intrinsics(
    921.170702, 919.018377, 459.904354, 351.238301, distortion=(-0.033458, 0.105152, 0.001256, -0.006647, 0.0)
)
_CAMERAS: Final = (
    CameraInfo(
        FRONT,
        WIDTH,
        720,
        30.0,
        intrinsics=_CALIBRATION,
        rotation=(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0),
        position=(0.05, 0.0, 0.0),
    ),
    CameraInfo(BOTTOM, 320, 240, 30.0, rotation=(0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0)),
)


def cameras_of(uri: VehicleUri) -> tuple[CameraInfo, ...]:
    """Both cameras, of which the drone shows one at a time; the one that looks down needs SDK 3.0.

    Intrinsics in the address are the front camera's.
    """
    front, bottom = _CAMERAS
    given = intrinsics_of(uri, front.width, front.height)
    return (msgspec.structs.replace(front, intrinsics=given) if given is not None else front, bottom)


def intrinsics_for(front: CameraInfo, camera: str, width: int) -> Intrinsics | None:
    """Of pictures of this width, which the drone makes smaller when asked to."""
    known = front.intrinsics
    if camera != FRONT or known is None:
        return None
    scale = width / front.width
    return msgspec.structs.replace(
        known,
        fx=known.fx * scale,
        fy=known.fy * scale,
        cx=(known.cx + 0.5) * scale - 0.5,
        cy=(known.cy + 0.5) * scale - 0.5,
    )
