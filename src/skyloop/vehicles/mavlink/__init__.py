"""``mavlink://…``: ArduCopter and PX4 multirotors."""

from skyloop.vehicles.mavlink.driver import MavlinkDriver

__all__ = ["MavlinkDriver"]
