"""``msp://tcp:HOST:PORT`` and ``msp:///dev/ttyACM0``: Betaflight and INAV, by the MultiWii serial protocol."""

from skyloop.vehicles.msp.driver import MspDriver

__all__ = ["MspDriver"]
