"""``python -m benchmarks.warmth``: what keeping code warm saves and costs, by how often it is run.

It is itself a contender of :mod:`benchmarks.measuring.contract`: Skyloop's own ends, whose address ends with the
interval.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from benchmarks.measuring import ours
from benchmarks.measuring.contract import Received
from benchmarks.measuring.machine import cpu_time_s
from benchmarks.measuring.pair import Pair
from benchmarks.measuring.schedule import CHANNELS, Turn
from benchmarks.measuring.statistics import Summary, summarize
from benchmarks.measuring.tables import Table, median_and_p99
from benchmarks.measuring.workers import Workers
from skyloop.bench import Machine
from skyloop.client import Drone, connect
from skyloop.proxy.warm_up import WARMER

PERIODS_MS: Final = (0, 5, 10, 20)
TURN_S: Final = 5.0
SIDES: Final = ("proxy", "pilot")


class PeriodResult(msgspec.Struct, frozen=True):
    """One interval. ``cpu``: cores in use by each of :data:`SIDES`, the turns' beginnings and ends included."""

    period_ms: int
    channels: dict[str, Summary]
    cpu: dict[str, float]


class Warmth(msgspec.Struct, frozen=True):
    """A whole run, as in ``warmth.json``. ``seconds``: how long each interval was measured."""

    machine: Machine
    seconds: float
    rows: list[PeriodResult]


class Vehicle(ours.Vehicle):
    """The vehicle's end, whose proxy keeps its code warm as often as the address says."""

    def __init__(self, address: str, received: Received) -> None:
        super().__init__(address, received)
        self._proxy.handler.warm_s = _period_s(address)

    def close(self) -> None:
        """Stop the proxy."""
        super().close()
        WARMER.keep(self._proxy, 0.0)


class Application(ours.Application):
    """The application's end, which keeps its code warm as often as the address says."""

    def _connect(self, address: str) -> Drone:
        return connect(ours.proxy_name(address), name="bench", on_exit="hover", warm_s=_period_s(address))


def measure(
    seconds: float,
    periods_ms: Sequence[int] = PERIODS_MS,
    progress: Callable[[float, str], None] = lambda _share, _what: None,
) -> Warmth:
    """Measure each interval, in turns with the others.

    Args:
        seconds: How long each is measured [s].
        periods_ms: The intervals; 0 is never.
        progress: Called with the share that is done, 0 to 1, and what comes next.
    """
    machine = Machine.here()
    rounds = max(1, round(seconds / TURN_S))
    delays: dict[tuple[int, str], list[int]] = {}
    used_s = {(period_ms, side): 0.0 for period_ms in periods_ms for side in SIDES}
    sent = dict.fromkeys(CHANNELS, 0)
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, Workers() as workers:
        pairs = {each: Pair(workers, __name__, str(Path(folder) / f"warm-{each}")) for each in periods_ms}
        for number in range(rounds):
            turn = Turn(number, seconds / rounds)
            for channel in CHANNELS:
                sent[channel] += turn.count(channel)
            for index, (period_ms, pair) in enumerate(pairs.items()):
                progress((number + index / len(pairs)) / rounds, f"{period_ms} ms")
                sides = dict(zip(SIDES, (pair.vehicle, pair.application), strict=True))
                pair.open(turn)
                before_s = {side: cpu_time_s(worker.pid) for side, worker in sides.items()}
                for channel, arrived in pair.arrivals(turn, pair.begin()).items():
                    delays.setdefault((period_ms, channel), []).extend(at - since for since, at in arrived)
                for side, worker in sides.items():
                    used_s[period_ms, side] += cpu_time_s(worker.pid) - before_s[side]
    turn = Turn(0, seconds)
    rows = [
        PeriodResult(
            period_ms,
            {
                channel: summarize(delays[period_ms, channel], sent=sent[channel], period_s=turn.period_s(channel))
                for channel in CHANNELS
            },
            {side: used_s[period_ms, side] / seconds for side in SIDES},
        )
        for period_ms in periods_ms
    ]
    return Warmth(machine, seconds, rows)


def table(results: Warmth) -> Table:
    """Return the delays and the processor time of each interval."""
    rows = [
        [
            f"{row.period_ms} ms" if row.period_ms else "never",
            *(median_and_p99(row.channels.get(channel)) for channel in CHANNELS),
            *(f"{100 * row.cpu[side]:.1f}" for side in SIDES),
        ]
        for row in results.rows
    ]
    columns = ["run each", *CHANNELS, "proxy, % of a core", "pilot, % of a core"]
    return Table("Delays in µs by how often code is kept warm: median (99th percentile)", columns, rows)


def _period_s(address: str) -> float:
    return float(address.rpartition("-")[2]) / 1e3


if __name__ == "__main__":
    from benchmarks.command import main

    main("warmth")
