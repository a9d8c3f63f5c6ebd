"""What the servers written from public facts show: one body that climbs and turns, and one that is hidden."""

from __future__ import annotations

import math
from typing import Final

BODIES: Final = ("alpha_body", "wand")  #: the second one is hidden in every frame
PERIOD_S: Final = 0.01


def pose(frame: int) -> tuple[tuple[float, float, float], float]:
    """Where the first body is in a frame: its place [m], with z up, and its yaw [rad]. Its height tells the frame."""
    return (1.5, -0.25, 1.0 + 0.001 * (frame % 1000)), math.remainder(0.01 * (frame % 1000), math.tau)


def frame_of(height_m: float) -> int:
    """The frame in which the body was so high."""
    return round((height_m - 1.0) * 1000)
