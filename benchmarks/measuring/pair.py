"""The two processes of one contender, measured turn by turn."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Final

from benchmarks.measuring.contract import Arrivals, application_side, vehicle_side
from benchmarks.measuring.schedule import CHANNELS, SETTLE_S, WARM_UP_S, Turn
from benchmarks.measuring.workers import STARTS_WITHIN_S, Workers

_LATE_S: Final = 20.0  # time allowed for an answer on a busy machine
_AHEAD_NS: Final = 50_000_000


class Pair:
    """The vehicle's and the application's process of one contender.

    Args:
        workers: Starts and ends the processes.
        module: Holds the contender's ends; see :mod:`benchmarks.measuring.contract`.
        address: A separate folder for its sockets.
        python: The interpreter that runs the module.
        application_module: Holds the application's end, if that is another module.
        prefixes: Put before the interpreter, for the vehicle's side and the application's.
    """

    def __init__(
        self,
        workers: Workers,
        module: str,
        address: str,
        *,
        python: str = sys.executable,
        application_module: str | None = None,
        prefixes: tuple[Sequence[str], Sequence[str]] = ((), ()),
    ) -> None:
        there, here = prefixes
        self.vehicle = workers.start(vehicle_side, module, address, python=python, prefix=there)
        self.application = workers.start(
            application_side, application_module or module, address, python=python, prefix=here
        )
        for worker in (self.vehicle, self.application):
            worker.answer(STARTS_WITHIN_S)

    def open(self, turn: Turn) -> None:
        """Connect the two ends for a turn."""
        for worker in (self.vehicle, self.application):
            worker.pipe.send(turn)
            worker.answer(STARTS_WITHIN_S)

    def begin(self) -> int:
        """Start the samples; return when counting begins [ns]."""
        begin_ns = time.monotonic_ns() + round(WARM_UP_S * 1e9) + _AHEAD_NS
        for worker in (self.vehicle, self.application):
            worker.pipe.send(begin_ns)
        return begin_ns

    def arrivals(self, turn: Turn, begin_ns: int) -> Arrivals:
        """Wait for the end of the turn, and return the samples that arrived."""
        found: Arrivals = {channel: [] for channel in CHANNELS}
        for worker in (self.application, self.vehicle):
            found |= worker.answer(turn.seconds + WARM_UP_S + SETTLE_S + _LATE_S)
        return since(found, begin_ns)

    def measure(self, turn: Turn) -> Arrivals:
        """Measure a whole turn."""
        self.open(turn)
        return self.arrivals(turn, self.begin())


def since(arrivals: Arrivals, begin_ns: int) -> Arrivals:
    """Return the arrivals of samples sent at this time or later."""
    return {channel: [pair for pair in pairs if pair[0] >= begin_ns] for channel, pairs in arrivals.items()}
