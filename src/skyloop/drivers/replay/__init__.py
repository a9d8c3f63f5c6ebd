"""``replay://FLIGHT.mcap``: a vehicle that does again what was recorded."""

from skyloop.drivers.replay.driver import ReplayDriver

__all__ = ["ReplayDriver"]
