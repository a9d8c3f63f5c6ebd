"""``ardrone://HOST``: the Parrot AR.Drone, 1 and 2."""

from skyloop.vehicles.ardrone.driver import ArdroneDriver

__all__ = ["ArdroneDriver"]
