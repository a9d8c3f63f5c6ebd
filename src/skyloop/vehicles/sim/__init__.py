"""``sim://``: a simulated drone in a simulated world, alone or with others of one host."""

from skyloop.vehicles.sim.driver import SimDriver
from skyloop.vehicles.sim.options import options_of

__all__ = ["SimDriver", "options_of"]
