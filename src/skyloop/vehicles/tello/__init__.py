"""``tello://HOST``: the Ryze Tello, by its text protocol."""

from skyloop.vehicles.tello.driver import TelloDriver

__all__ = ["TelloDriver"]
