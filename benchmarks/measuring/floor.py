"""The floor: the bare hand-over in Python, that of ``skyloop bench``; see :mod:`benchmarks.measuring.contract`."""

from skyloop.bench import BareApplication as Application
from skyloop.bench import BareVehicle as Vehicle

__all__ = ["Application", "Vehicle"]
