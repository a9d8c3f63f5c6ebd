"""``sim://``: a simulated drone in a simulated world, alone or with others of one :class:`SimHost`."""

from skyloop.drivers.sim.driver import SimDriver
from skyloop.drivers.sim.host import SimHost
from skyloop.drivers.sim.options import SimOptions

__all__ = ["SimDriver", "SimHost", "SimOptions"]
