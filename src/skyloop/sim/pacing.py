"""Running a simulation in step with a clock."""

from __future__ import annotations

import math
from collections.abc import Callable

from skyloop.clock import NS_PER_S, Clock, monotonic_ns
from skyloop.errors import UsageError
from skyloop.sim.dynamics import STEP_S

MOST_LAG_S = 0.25
_LONGEST_RUN_STEPS = 25
SLOW_SHARE = 0.95  #: a simulation that reaches less of its speed is too slow,
SLOW_NS = 5 * NS_PER_S  #: over this time,
SLOW_AGAIN_NS = 60 * NS_PER_S  #: which is said again after this one


class Pacer:
    """Runs the steps that are due, by absolute deadlines: step k is due at start + k · STEP_S / speed.

    Small delays are caught up. Beyond ``most_lag_s`` of the clock, the rest is given up, counted in ``lost_s``, and the
    deadlines move. Not thread-safe: one thread owns it::

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
        """``step(n)`` does n steps. ``speed`` is how many seconds of simulation a second of the clock is worth."""
        if not (math.isfinite(speed) and 0 < speed <= 1000):
            raise UsageError(f"speed must be greater than 0 and at most 1000, not {speed!r}")
        self._step = step
        self._clock = clock
        self._ns_per_step = STEP_S / speed * NS_PER_S
        self._speed = speed
        self._most_lag_ns = most_lag_s * NS_PER_S
        self._start_ns = clock()
        self._done = 0
        self.lost_s = 0.0  # of the clock, given up so far

    def run_due(self) -> float:
        """Do the steps that are due, some at a time.

        Returns:
            How long to wait until the next step [s]; 0 if one is due.
        """
        behind = self._clock() - self._due_ns(self._done + 1)
        if behind < 0:
            return -behind / NS_PER_S
        excess = behind - self._most_lag_ns
        if excess > 0:
            self._start_ns += round(excess)
            self.lost_s += excess / NS_PER_S
            behind -= round(excess)
        # At high speeds a run is longer, so that the caller isn't asked for every step.
        most = max(_LONGEST_RUN_STEPS, int(_LONGEST_RUN_STEPS * self._speed))
        steps = min(int(behind / self._ns_per_step) + 1, most)
        self._step(steps)
        self._done += steps
        return max(0.0, (self._due_ns(self._done + 1) - self._clock()) / NS_PER_S)

    def clock_ns(self, time_s: float) -> int:
        """Convert a time of the simulation to the clock, by the present deadlines.

        Args:
            time_s: Since this pacer's start.

        Returns:
            When the simulation was, or will be, at that time.
        """
        return self._due_ns(time_s / STEP_S)

    def _due_ns(self, step: float) -> int:
        return self._start_ns + round(step * self._ns_per_step)


class SlownessWatch:
    """Finds that a computer is too slow for a simulation, by what its :class:`Pacer` gave up. Pure.

    Args:
        now_ns: When the simulation begins.
    """

    def __init__(self, now_ns: int) -> None:
        self._since_ns = now_ns
        self._lost_s = 0.0
        self._said_ns: int | None = None

    def update(self, lost_s: float, now_ns: int) -> float | None:
        """Return the share of its speed that the simulation reaches, when that is to be said; usually None.

        Args:
            lost_s: What was given up so far.
            now_ns: The present time.
        """
        passed_ns = now_ns - self._since_ns
        if passed_ns < SLOW_NS:
            return None
        share = 1.0 - (lost_s - self._lost_s) * NS_PER_S / passed_ns
        self._since_ns, self._lost_s = now_ns, lost_s
        if share >= SLOW_SHARE or (self._said_ns is not None and now_ns - self._said_ns < SLOW_AGAIN_NS):
            return None
        self._said_ns = now_ns
        return share
