"""Options for a simulated world and its drones, and the pacing of a simulation by a clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from skyloop.clock import NS_PER_S, Clock, monotonic_ns
from skyloop.errors import UsageError
from skyloop.messages import ACTION_NAMES
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA, CameraModel
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.parameters import VehicleParameters, with_scaled_flaws
from skyloop.sim.world import Wind, World
from skyloop.sim.world_file import load_world

#: Actions that simulated vehicles support natively; the proxy itself flies them to positions and back to the start.
EVERY_ACTION: Final = frozenset(ACTION_NAMES.values()) - {"position", "return_to_start"}
STANDARD_VEHICLE: Final = VehicleParameters()
MOST_LAG_S: Final = 0.25  #: default for the lag behind the clock beyond which steps are skipped


@dataclass(frozen=True, slots=True)
class SimOptions:
    """Options for a simulated world and its drones."""

    world: str = "room"  #: name of a built-in world, or path of a world file
    seed: int = 0  #: seed for all noise and gusts
    speed: float = 1.0  #: ratio of simulated to real time
    cameras: tuple[CameraModel, ...] = (FRONT_CAMERA, BOTTOM_CAMERA)
    noise: float = 1.0  #: factor applied to the sensors' noise and biases
    wind: float = 1.0  #: factor applied to the world's wind
    battery: float = 1.0  #: charge at the start, 0 to 1
    quality: str = "smooth"  #: image quality: ``fast``, ``smooth`` or ``best``
    native: frozenset[str] = EVERY_ACTION  #: actions that the drone's driver supports natively
    position: bool = True  #: whether the drone reports its position
    velocity: bool = True  #: whether the drone reports its velocity; it always uses the velocity for its own flight
    truth: bool = True  #: whether the drone also reports its true state
    rate_hz: float = 40.0  #: number of reports per second
    most_lag_s: float = MOST_LAG_S  #: the world skips steps if it lags behind the clock by more than this [s]
    parameters: VehicleParameters = STANDARD_VEHICLE
    autopilot: str | None = None  #: real firmware that flies the drones: ``ardupilot``, ``betaflight`` or ``px4``
    #: folder for the firmware's settings; if None, they are kept only as long as the drone exists
    autopilot_folder: str | None = None

    def load_world(self) -> World:
        """Load the world."""
        return load_world(self.world, self.seed)

    def blowing(self, wind: Wind) -> Wind:
        """Return a world's wind multiplied by the factor :attr:`wind`."""
        x, y, z = wind.mean_m_s
        mean = (x * self.wind, y * self.wind, z * self.wind)
        return replace(wind, mean_m_s=mean, gust_m_s=wind.gust_m_s * self.wind)

    def vehicle(self) -> VehicleParameters:
        """Return the vehicle with its sensors' noise and biases multiplied by the factor :attr:`noise`."""
        return with_scaled_flaws(self.parameters, self.noise)


_LONGEST_RUN_STEPS = 25  # maximum number of steps per call when running in real time
SLOW_SHARE = 0.95  #: a simulation below this fraction of its speed counts as too slow
SLOW_NS = 5 * NS_PER_S  #: period over which the speed is measured
SLOW_AGAIN_NS = 60 * NS_PER_S  #: interval between warnings


class Pacer:
    """Runs the steps that are due, using absolute deadlines: step k is due at start + k · STEP_S / speed.

    The pacer catches up on small delays. If the lag exceeds ``most_lag_s``, the excess is skipped and counted in
    ``lost_s``, and the deadlines are postponed. Use a pacer from one thread only::

        while not stop.wait(pacer.run_due()):
            publish()
    """

    def __init__(
        self,
        step: Callable[[int], None],
        *,
        speed: float = 1.0,
        most_lag_s: float = MOST_LAG_S,
        clock: Clock = monotonic_ns,
    ) -> None:
        """Start now. ``step(n)`` runs n steps; ``speed`` is in simulated seconds per second of clock time."""
        if not (math.isfinite(speed) and 0 < speed <= 1000):
            raise UsageError(f"speed must be greater than 0 and at most 1000, not {speed!r}")
        self._step = step
        self._clock = clock
        self._ns_per_step = STEP_S / speed * NS_PER_S
        self._speed = speed
        self._most_lag_ns = most_lag_s * NS_PER_S
        self._start_ns = clock()
        self._done = 0
        self.lost_s = 0.0  # clock time skipped so far

    def run_due(self) -> float:
        """Run the steps that are due, in batches; return the time until the next step [s], 0 if one is due already."""
        behind = self._clock() - self._due_ns(self._done + 1)
        if behind < 0:
            return -behind / NS_PER_S
        excess = behind - self._most_lag_ns
        if excess > 0:
            self._start_ns += round(excess)
            self.lost_s += excess / NS_PER_S
            behind -= round(excess)
        # At high speeds, use longer batches so that control returns less often than once per step.
        most = max(_LONGEST_RUN_STEPS, int(_LONGEST_RUN_STEPS * self._speed))
        steps = min(int(behind / self._ns_per_step) + 1, most)
        self._step(steps)
        self._done += steps
        return max(0.0, (self._due_ns(self._done + 1) - self._clock()) / NS_PER_S)

    def clock_ns(self, time_s: float) -> int:
        """Return the clock time at which the simulation reached, or will reach, a time since the pacer's start."""
        return self._due_ns(time_s / STEP_S)

    def _due_ns(self, step: float) -> int:
        return self._start_ns + round(step * self._ns_per_step)


class SlownessWatch:
    """Detects that the computer is too slow for a simulation, from the time that its :class:`Pacer` skipped. Pure."""

    def __init__(self, now_ns: int) -> None:
        self._since_ns = now_ns
        self._lost_s = 0.0
        self._warned_ns: int | None = None

    def update(self, lost_s: float, now_ns: int) -> float | None:
        """Return the achieved fraction of the simulation's speed if a warning is due, else None."""
        passed_ns = now_ns - self._since_ns
        if passed_ns < SLOW_NS:
            return None
        share = 1.0 - (lost_s - self._lost_s) * NS_PER_S / passed_ns
        self._since_ns, self._lost_s = now_ns, lost_s
        if share >= SLOW_SHARE or (self._warned_ns is not None and now_ns - self._warned_ns < SLOW_AGAIN_NS):
            return None
        self._warned_ns = now_ns
        return share
