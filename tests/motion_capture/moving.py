"""The content of the servers written from public facts: one body that climbs and turns, and a hidden one."""

from __future__ import annotations

import math
from typing import Final

BODIES: Final = ("alpha_body", "wand")  #: the second one is hidden in every frame
PERIOD_S: Final = 0.01


def pose(frame: int) -> tuple[tuple[float, float, float], float]:
    """Return the first body's position [m], z up, and yaw [rad] in a frame. Its height encodes the frame."""
    return (1.5, -0.25, 1.0 + 0.001 * (frame % 1000)), math.remainder(0.01 * (frame % 1000), math.tau)


def frame_of(height_m: float) -> int:
    """Return the frame in which the body had this height."""
    return round((height_m - 1.0) * 1000)
