"""``python -m benchmarks.peers``: the paper's experiment, in turns with the bare hand-over and other libraries."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from benchmarks.measuring.contenders import FLOOR, OURS, Contender
from benchmarks.measuring.contract import Arrivals
from benchmarks.measuring.pair import Pair
from benchmarks.measuring.schedule import CHANNELS, Size, Turn
from benchmarks.measuring.statistics import Summary, summarize
from benchmarks.measuring.workers import Workers
from skyloop.bench import Machine
from skyloop.errors import LinkError
from skyloop.files import MAX_RESULTS, read_json

TURN_S: Final = 5.0

#: Mean delays on one host in the paper's Table 1 [ms], by channel (Mellado-Bataller et al., IAS-12, 2013).
PAPER_MEAN_MS: Final = {"command": 0.091, "feedback": 0.109, "video": 1.038}

Progress = Callable[[float, str], None]


class Cell(msgspec.Struct, frozen=True):
    """One channel of one contender, while frames of one size were flowing."""

    contender: str
    size: str  #: of the frames, ``320×240``
    channel: str
    summary: Summary


class Series(msgspec.Struct, frozen=True):
    """Skyloop's individual delays with frames of the first size, which the figures show."""

    channel: str
    at_s: list[float]  #: since the beginning, excluding the turns of other contenders
    delay_us: list[float]


class Delays(msgspec.Struct, frozen=True, tag_field="what", tag="delays"):
    """A whole run, as in ``delays.json``. ``seconds``: how long each contender was measured with each size."""

    machine: Machine
    seconds: float
    sizes: list[str]
    contenders: dict[str, str]  #: names and titles
    versions: dict[str, str]  #: of the other libraries
    skipped: dict[str, str]  #: other libraries that could not be measured, with reasons
    cells: list[Cell]
    series: list[Series]

    def summary(self, contender: str, size: str, channel: str) -> Summary | None:
        """Return the figures of one channel of one contender; None if they were not measured."""
        for cell in self.cells:
            if (cell.contender, cell.size, cell.channel) == (contender, size, channel):
                return cell.summary
        return None


def measure(
    seconds: float,
    sizes: Sequence[Size],
    peers: Sequence[Contender] = (),
    skipped: dict[str, str] | None = None,
    progress: Progress = lambda _share, _what: None,
) -> Delays:
    """Measure Skyloop, the floor and other contenders in turns.

    Args:
        seconds: Duration for each contender with each frame size [s].
        sizes: Sizes of the frames.
        peers: Further contenders.
        skipped: Contenders that can't be measured, with reasons, for the results.
        progress: Called with the fraction done, 0 to 1, and the next step.

    Raises:
        LinkError: A contender's processes did not find each other, or nothing arrived.
    """
    machine = Machine.here()
    contenders = [FLOOR, OURS, *peers]
    turns = turns_of(seconds, sizes)
    found: dict[tuple[str, str], list[tuple[Turn, Arrivals]]] = {}
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, Workers() as workers:
        pairs = {each.name: Pair(workers, each.module, folder, python=each.python) for each in contenders}
        for number, turn in enumerate(turns):
            for index, each in enumerate(contenders):
                progress((number + index / len(contenders)) / len(turns), f"{each.title}, {turn.size}")
                found.setdefault((each.name, str(turn.size)), []).append((turn, pairs[each.name].measure(turn)))
    return Delays(
        machine=machine,
        seconds=seconds,
        sizes=[str(size) for size in sizes],
        contenders={each.name: each.title for each in contenders},
        versions={each.name: each.version for each in peers},
        skipped=skipped or {},
        cells=[cell for (name, size), done in found.items() for cell in _cells(name, size, done)],
        series=[_series(channel, found[OURS.name, str(sizes[0])]) for channel in CHANNELS],
    )


def turns_of(seconds: float, sizes: Sequence[Size]) -> list[Turn]:
    """Return turns of about five seconds, cycling through the sizes."""
    rounds = max(1, round(seconds / TURN_S))
    return [Turn(number, seconds / rounds, size) for number in range(rounds) for size in sizes]


def _cells(name: str, size: str, done: Sequence[tuple[Turn, Arrivals]]) -> list[Cell]:
    cells = []
    for channel in CHANNELS:
        sent = sum(turn.count(channel) for turn, _ in done)
        delays_ns = [received - at for _, arrivals in done for at, received in arrivals[channel]]
        if not delays_ns:
            raise LinkError(f"not one sample of {channel} with frames of {size} arrived through {name}")
        cells.append(Cell(name, size, channel, summarize(delays_ns, sent=sent, period_s=done[0][0].period_s(channel))))
    return cells


def _series(channel: str, done: Sequence[tuple[Turn, Arrivals]]) -> Series:
    at_s: list[float] = []
    delay_us: list[float] = []
    before_s = 0.0
    for turn, arrivals in done:
        first_ns = min(pair[0] for pairs in arrivals.values() for pair in pairs)
        for sent_ns, received_ns in arrivals[channel]:
            at_s.append(round(before_s + (sent_ns - first_ns) / 1e9, 3))
            delay_us.append(round((received_ns - sent_ns) / 1e3, 1))
        before_s += turn.seconds
    return Series(channel, at_s, delay_us)


def load(path: Path) -> Delays:
    """Read ``delays.json``.

    Raises:
        FileFormatError: The file has another format.
    """
    return read_json(path, Delays, "the results of benchmarks.peers", MAX_RESULTS)
