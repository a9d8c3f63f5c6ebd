"""The floor: a bare transfer in Python, as in ``skyloop bench``; see :mod:`benchmarks.measuring.contract`."""

from skyloop.bench import BareApplication as Application
from skyloop.bench import BareVehicle as Vehicle

__all__ = ["Application", "Vehicle"]
