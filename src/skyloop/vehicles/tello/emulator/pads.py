"""Mission pads on the floor of the world, as the Tello sees them. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from skyloop.sim.reports import VehicleTruth

MOST: Final = 8
LOWEST_M: Final = 0.3  #: between these heights a pad is recognised; estimates
HIGHEST_M: Final = 1.2
_VIEW: Final = 0.5  # of the height: how far aside the camera that looks down still sees one; estimate


@dataclass(frozen=True, slots=True)
class Sighting:
    """A pad below, and where the drone is above it: axes of the world, as all pads are aligned with them."""

    number: int
    place_m: tuple[float, float, float]


def seen(pads: Mapping[int, tuple[float, float]], truth: VehicleTruth) -> Sighting | None:
    """Return the nearest pad in view.

    Args:
        pads: x and y in world axes [m], by number.
        truth: The drone as it is.
    """
    x, y, z = truth.position_m
    if not LOWEST_M <= z <= HIGHEST_M:
        return None
    in_view = {number: math.dist((x, y), place) for number, place in pads.items()}
    nearest = min(in_view, key=lambda number: in_view[number], default=None)
    if nearest is None or in_view[nearest] > _VIEW * z:
        return None
    east, north = pads[nearest]
    return Sighting(nearest, (x - east, y - north, z))
