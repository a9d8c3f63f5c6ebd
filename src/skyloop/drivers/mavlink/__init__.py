"""``mavlink://…``: ArduCopter and PX4 multirotors."""

from skyloop.drivers.mavlink.driver import MavlinkDriver

__all__ = ["MavlinkDriver"]
