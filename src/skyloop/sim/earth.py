"""Where the worlds are on Earth: what satellite receivers, barometers and magnetometers need.

Every world's origin is at one place in Zürich, where PX4's simulations start by default.
"""

from __future__ import annotations

import math
from typing import Final

from skyloop.sim.world import Vec3

LATITUDE_DEG: Final = 47.397742  #: of the worlds' origin, WGS 84
LONGITUDE_DEG: Final = 8.545594
ALTITUDE_M: Final = 488.0  #: of the worlds' floor above mean sea level

#: Of the Earth there, east, north, up: the World Magnetic Model 2025, at the beginning of 2026.
MAGNETIC_FIELD_GAUSS: Final[Vec3] = (0.01334, 0.21523, -0.43290)

_EQUATOR_M, _FLATTENING = 6378137.0, 1 / 298.257223563  # WGS 84
_SEA_LEVEL_PA, _SEA_LEVEL_K, _LAPSE_K_M, _EXPONENT = 101325.0, 288.15, 0.0065, 5.25588  # ISO 2533, standard atmosphere


def _radii_m() -> tuple[float, float]:
    """Return the Earth's radii of curvature at the origin: along the meridian, and across it."""
    squared = _FLATTENING * (2 - _FLATTENING)
    bulge = 1 - squared * math.sin(math.radians(LATITUDE_DEG)) ** 2
    return _EQUATOR_M * (1 - squared) / bulge**1.5, _EQUATOR_M / math.sqrt(bulge)


_MERIDIAN_M, _NORMAL_M = _radii_m()
_DEG_PER_NORTH_M = math.degrees(1 / (_MERIDIAN_M + ALTITUDE_M))
_DEG_PER_EAST_M = math.degrees(1 / ((_NORMAL_M + ALTITUDE_M) * math.cos(math.radians(LATITUDE_DEG))))


def geodetic(position_m: Vec3) -> Vec3:
    """Return latitude, longitude [deg] and altitude above mean sea level [m] of a place, world axes.

    The Earth counts as flat: a kilometre away that is wrong by less than 0.1 m.
    """
    east, north, up = position_m
    return LATITUDE_DEG + north * _DEG_PER_NORTH_M, LONGITUDE_DEG + east * _DEG_PER_EAST_M, ALTITUDE_M + up


def local(latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vec3:
    """Return the place in world axes: the inverse of :func:`geodetic`."""
    north = (latitude_deg - LATITUDE_DEG) / _DEG_PER_NORTH_M
    return (longitude_deg - LONGITUDE_DEG) / _DEG_PER_EAST_M, north, altitude_m - ALTITUDE_M


def pressure_pa(height_m: float) -> float:
    """Return the air's pressure at a height above the worlds' floor, in the standard atmosphere."""
    share = 1 - _LAPSE_K_M * (ALTITUDE_M + height_m) / _SEA_LEVEL_K
    return float(_SEA_LEVEL_PA * share**_EXPONENT)
