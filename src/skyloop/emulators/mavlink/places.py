"""The emulated world on the Earth: latitude, longitude and altitude, and the autopilot's own east, north, up. Pure."""

from __future__ import annotations

import math
from typing import Final

from skyloop.wire.mavlink.axes import Vector

ORIGIN_LATITUDE_DEG: Final = 47.397742
ORIGIN_LONGITUDE_DEG: Final = 8.545594
ORIGIN_ALTITUDE_M: Final = 488.0  #: above mean sea level
_METRES_PER_DEG: Final = 111_320.0
_EAST_METRES_PER_DEG: Final = _METRES_PER_DEG * math.cos(math.radians(ORIGIN_LATITUDE_DEG))


def geodetic(place: Vector) -> tuple[int, int, int]:
    """Return latitude and longitude [1e-7 degrees] and altitude above mean sea level [mm]."""
    east, north, up = place
    latitude = ORIGIN_LATITUDE_DEG + north / _METRES_PER_DEG
    longitude = ORIGIN_LONGITUDE_DEG + east / _EAST_METRES_PER_DEG
    return round(latitude * 1e7), round(longitude * 1e7), round((ORIGIN_ALTITUDE_M + up) * 1000)


def place_of(latitude_deg: float, longitude_deg: float, up: float) -> Vector:
    """Return east, north, up of a latitude and longitude, at a height above the origin [m]."""
    north = (latitude_deg - ORIGIN_LATITUDE_DEG) * _METRES_PER_DEG
    east = (longitude_deg - ORIGIN_LONGITUDE_DEG) * _EAST_METRES_PER_DEG
    return east, north, up


def on_earth(latitude_deg: float, longitude_deg: float) -> bool:
    """Return whether there is such a position; False for NaN."""
    return abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0
