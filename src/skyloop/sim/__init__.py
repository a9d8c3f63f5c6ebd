"""The simulator: worlds loaded from text files, and quadrotors with the logic of real firmware.

Its owner advances it step by step. It imports neither proxies nor networks, and only :class:`Pacer` reads a clock.
"""

from skyloop.sim.dynamics import STEP_S
from skyloop.sim.instruments import Firmware, Readings
from skyloop.sim.options import Pacer
from skyloop.sim.parameters import LIMIT_RANGES, Limits, VehicleParameters
from skyloop.sim.reports import Occurrence, OccurrenceKind, VehicleFeedback, VehicleTruth
from skyloop.sim.simulation import Simulation
from skyloop.sim.world import TargetState, Wind, World
from skyloop.sim.world_file import load_world, parse_world, shipped_worlds

__all__ = [
    "LIMIT_RANGES",
    "STEP_S",
    "Firmware",
    "Limits",
    "Occurrence",
    "OccurrenceKind",
    "Pacer",
    "Readings",
    "Simulation",
    "TargetState",
    "VehicleFeedback",
    "VehicleParameters",
    "VehicleTruth",
    "Wind",
    "World",
    "load_world",
    "parse_world",
    "shipped_worlds",
]
