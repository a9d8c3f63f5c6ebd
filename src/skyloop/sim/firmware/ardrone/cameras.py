"""The cameras of the AR.Drones as models. Pure.

Of an AR.Drone 2: calibrations of one such drone as published with ardrone_autonomy (branch of TUM), for its pictures
of 640×360. Of an AR.Drone 1, of which no calibration was found: Parrot's technical specifications, 93° and 64° on the
diagonal.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA

_DIAGONAL_1_PX: Final = math.hypot(176, 144)
_FOCAL_1_PX: Final = BOTTOM_CAMERA.fx * _DIAGONAL_1_PX / math.hypot(BOTTOM_CAMERA.width, BOTTOM_CAMERA.height)

FRONT_2: Final = replace(
    FRONT_CAMERA,
    width=640,
    height=360,
    fx=561.999146,
    fy=561.782697,
    cx=307.433982,
    cy=190.144373,
    distortion=(-0.50758, 0.24911, 0.000579, 0.000996, 0.0),
)
#: The picture that the drone sends, which is the middle of its sensor's 320×240 at twice the size.
BOTTOM_2_SENT: Final = replace(
    BOTTOM_CAMERA, width=640, height=360, fx=686.994766, fy=688.195055, cx=329.323208, cy=159.323007
)
BOTTOM_2: Final = BOTTOM_2_SENT.scaled(0.5)
FRONT_1: Final = replace(FRONT_CAMERA, fps=15.0)
BOTTOM_1: Final = replace(
    BOTTOM_CAMERA, width=176, height=144, fps=15.0, fx=_FOCAL_1_PX, fy=_FOCAL_1_PX, cx=87.5, cy=71.5
)

CAMERAS: Final = {1: (FRONT_1, BOTTOM_1), 2: (FRONT_2, BOTTOM_2)}  #: front and bottom, by version
