"""``replay://FLIGHT.mcap``: a vehicle that does again what was recorded."""

from skyloop.vehicles.replay.driver import ReplayDriver

__all__ = ["ReplayDriver"]
