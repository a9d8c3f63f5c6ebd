"""The emulated world on the Earth: latitude, longitude and altitude, and the autopilot's own east, north, up. Pure."""

from __future__ import annotations

import math
from typing import Final

from skyloop.messages.feedback import EarthOrigin
from skyloop.vehicles.mavlink.wire.axes import Vector

ORIGIN: Final = EarthOrigin(47.397742, 8.545594, 488.0, math.degrees(111_320.0))


def geodetic(place: Vector) -> tuple[int, int, int]:
    """Return latitude and longitude [1e-7 degrees] and altitude above mean sea level [mm]."""
    latitude_deg, longitude_deg, altitude_m = ORIGIN.place_of(place)
    return round(latitude_deg * 1e7), round(longitude_deg * 1e7), round(altitude_m * 1000)


def place_of(latitude_deg: float, longitude_deg: float, up: float) -> Vector:
    """Return east, north, up of a latitude and longitude, at a height above the origin [m]."""
    return ORIGIN.position_of(latitude_deg, longitude_deg, ORIGIN.altitude_m + up)


def on_earth(latitude_deg: float, longitude_deg: float) -> bool:
    """Return whether there is such a position; False for NaN."""
    return abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0
