"""The drone's cameras as capabilities announce them. Pure.

Intrinsics of the AR.Drone 2: calibrations of one such drone as published with ardrone_autonomy (branch of TUM), for
pictures of 640×360; another drone's differ by some per cent. Nothing is known of the AR.Drone 1's.
"""

from __future__ import annotations

from typing import Final

import msgspec

from skyloop.drivers.intrinsics import intrinsics_of
from skyloop.drivers.uri import VehicleUri
from skyloop.messages import CameraInfo, Intrinsics
from skyloop.messages.encoded import H264

Rotation = tuple[float, float, float, float, float, float, float, float, float]

_LOOKING_FORWARD: Final[Rotation] = (0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
_LOOKING_DOWN: Final[Rotation] = (0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0)
_FRONT: Final = Intrinsics(
    561.999146, 561.782697, 307.433982, 190.144373, distortion=(-0.50758, 0.24911, 0.000579, 0.000996, 0.0)
)
_BOTTOM: Final = Intrinsics(686.994766, 688.195055, 329.323208, 159.323007)
_CAMERAS: Final = {
    1: (
        CameraInfo("front", 320, 240, 15.0, rotation=_LOOKING_FORWARD),
        CameraInfo("bottom", 176, 144, 60.0, rotation=_LOOKING_DOWN),
    ),
    2: (
        CameraInfo("front", 640, 360, 30.0, intrinsics=_FRONT, rotation=_LOOKING_FORWARD, stream=H264),
        CameraInfo("bottom", 640, 360, 30.0, intrinsics=_BOTTOM, rotation=_LOOKING_DOWN, stream=H264),
    ),
}


def cameras_of(uri: VehicleUri, version: int | None) -> tuple[CameraInfo, ...]:
    """Both cameras, of which the drone shows one at a time; those of an AR.Drone 2 where the version is not known.

    Intrinsics in the address are the front camera's.
    """
    front, bottom = _CAMERAS[version or 2]
    given = intrinsics_of(uri, front.width, front.height)
    return (msgspec.structs.replace(front, intrinsics=given) if given is not None else front, bottom)
