"""Where a vehicle's world axes lie on the earth. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

_KEYS: Final = (
    "origin.latitude_deg",
    "origin.longitude_deg",
    "origin.altitude_amsl_m",
    "origin.radius_m",
)


class EarthOrigin(NamedTuple):
    """The place on the earth where the world axes of ``Feedback.position_m`` begin, x to the east and y to the north.

    Autopilots project the earth onto their axes with a sphere. With theirs, a place that is converted here is the place
    that they mean by it; with another one it would be off by up to 0.6 % of its distance.
    """

    latitude_deg: float  #: [°], north positive
    longitude_deg: float  #: [°], east positive
    altitude_m: float  #: above mean sea level [m]
    radius_m: float  #: of the sphere that the vehicle takes the earth for [m]

    @classmethod
    def of(cls, native: Mapping[str, object] | None) -> EarthOrigin | None:
        """Return the origin that a driver has put into ``Feedback.native``; None if there is none that makes sense."""
        found = [native.get(key) if native else None for key in _KEYS]
        numbers = [float(one) for one in found if isinstance(one, int | float) and math.isfinite(one)]
        if len(numbers) < len(_KEYS) or not (is_on_earth(*numbers[:2]) and numbers[3] > 0.0):
            return None
        return cls(*numbers)

    def native(self) -> dict[str, float]:
        """Return what a driver puts into ``Feedback.native``."""
        return dict(zip(_KEYS, self, strict=True))

    def position_of(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> tuple[float, float, float]:
        """Return a place in world axes: x east, y north, z up [m].

        Args:
            latitude_deg: [°], north positive.
            longitude_deg: [°], east positive; the shorter way round is taken.
            altitude_m: Above mean sea level [m].
        """
        east_rad = math.radians(math.remainder(longitude_deg - self.longitude_deg, 360.0))
        middle_rad = math.radians((latitude_deg + self.latitude_deg) / 2.0)
        north_m = math.radians(latitude_deg - self.latitude_deg) * self.radius_m
        return east_rad * math.cos(middle_rad) * self.radius_m, north_m, altitude_m - self.altitude_m

    def place_of(self, position: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return latitude [°], longitude [°] and altitude above mean sea level [m] of a place in world axes [m]."""
        x, y, z = position
        latitude_deg = self.latitude_deg + math.degrees(y / self.radius_m)
        middle_rad = math.radians((latitude_deg + self.latitude_deg) / 2.0)
        longitude_deg = self.longitude_deg + math.degrees(x / (self.radius_m * math.cos(middle_rad)))
        return latitude_deg, math.remainder(longitude_deg, 360.0), self.altitude_m + z


def is_on_earth(latitude_deg: float, longitude_deg: float) -> bool:
    """Return whether there is such a place, and east and north are known there; False for NaN."""
    return abs(latitude_deg) < 89.9 and abs(longitude_deg) <= 180.0
