"""``skyloop bench local``: each channel against the bare hand-over, in turns of about a second, in one run."""

from __future__ import annotations

import multiprocessing
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import msgspec
import numpy as np

from skyloop.bench.floor import Floor
from skyloop.bench.pair import Pair
from skyloop.bench.rounds import CHANNELS, COMMAND, Channel

TURN_S = 1.0

#: What this project holds itself to, as ratios of medians to the floor's.
TARGETS = {"command": 1.3, "feedback": 1.3, "video 320×240": 1.5, "video 1920×1080": 1.5}


class Spread(msgspec.Struct, frozen=True):
    """A distribution of delays in µs."""

    median_us: float
    p99_us: float
    samples: int


class Row(msgspec.Struct, frozen=True):
    """One channel: the floor, Skyloop to an inline listener, and to a listener in a thread of its own."""

    channel: str
    floor: Spread
    skyloop: Spread
    threaded: Spread | None
    ratio: float  #: of the medians, Skyloop (inline) to the floor
    target: float


class Machine(msgspec.Struct, frozen=True):
    """What the figures were taken on."""

    python: str
    system: str
    cores: int | None

    @classmethod
    def here(cls) -> Machine:
        return cls(platform.python_version(), f"{platform.system()} {platform.machine()}", os.cpu_count())


class Results(msgspec.Struct, frozen=True):
    machine: Machine
    rows: list[Row]


def measure(seconds: float, progress: Callable[[float], None] = lambda _: None) -> Results:
    """Measure all channels in about ``seconds``; ``progress`` is told the share that is done, 0 to 1."""
    turns = max(1, round(seconds / (2 * TURN_S * len(CHANNELS))))
    context = multiprocessing.get_context("spawn")
    with closing(Floor(context)) as floor, closing(Pair(context)) as pair:
        collected: dict[Channel, tuple[list[int], list[int], list[int]]] = {c: ([], [], []) for c in CHANNELS}
        for turn in range(turns):
            for index, channel in enumerate(CHANNELS):
                count = max(2, round(TURN_S / channel.period_s))
                bare, inline, threaded = collected[channel]
                bare.extend(floor.measure(channel, count))
                ours, own_thread = pair.measure(channel, count)
                inline.extend(ours)
                threaded.extend(own_thread)
                progress((turn * len(CHANNELS) + index + 1) / (turns * len(CHANNELS)))
    return Results(Machine.here(), [_row(channel, *lists) for channel, lists in collected.items()])


def _row(channel: Channel, bare: list[int], inline: list[int], threaded: list[int]) -> Row:
    floor, skyloop = spread(bare), spread(inline)
    return Row(
        channel.name,
        floor,
        skyloop,
        None if channel == COMMAND else spread(threaded),
        skyloop.median_us / floor.median_us,
        TARGETS[channel.name],
    )


def spread(delays_ns: Sequence[float]) -> Spread:
    """Median and 99th percentile. Raises ``ValueError`` for no samples at all: something did not flow."""
    if not delays_ns:
        raise ValueError("not one sample arrived")
    values = np.asarray(delays_ns) / 1e3
    return Spread(float(np.median(values)), float(np.percentile(values, 99)), len(delays_ns))


_Pair = TypeVar("_Pair", Floor, Pair)


@contextmanager
def closing(pair: _Pair) -> Iterator[_Pair]:
    try:
        yield pair
    finally:
        pair.close()
