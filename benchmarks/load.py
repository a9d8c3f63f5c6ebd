"""Measure the pilot's delays while other applications watch, are slow, stall or record."""

from __future__ import annotations

import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from benchmarks.disk import small_disk
from benchmarks.measuring.contract import Arrivals
from benchmarks.measuring.machine import cpu_time_s
from benchmarks.measuring.ours import proxy_name
from benchmarks.measuring.pair import Pair, since
from benchmarks.measuring.schedule import CHANNELS, FRAME_PERIOD_S, MIDDLE, SMALL, Size, Turn, sleep_until
from benchmarks.measuring.statistics import Summary, summarize
from benchmarks.measuring.workers import STARTS_WITHIN_S, Worker, Workers
from benchmarks.onlookers import OWN, SHARED, look, observe, record, serve, show
from skyloop.bench import Machine
from skyloop.errors import LinkError, UsageError
from skyloop.files import MAX_RESULTS, read_json

TURN_S: Final = 5.0
RECORDED_PERIOD_S: Final = 1 / 30
STUCK_AMONG: Final = 8  #: number of observers, one of which is stopped
ENCODED: Final = "8 viewers of H.264, one of them stopped"  #: half share one format, the others have one each
_ANSWERS_WITHIN_S: Final = 20.0

ALONE: Final = "nobody else"
SLOW: Final = "a processor of 200 ms a frame"
#: The parts whose processor time is measured. The pages have no browser: see :mod:`skyloop.cockpit.testing`.
PARTS: Final = ("proxy", "pilot", "observers", "recorder", "cockpit", "pages", "view")
RECORDED: Final = "recorder"
KILLED: Final = "recorder, killed half-way"
FULL: Final = "recorder, disk full"
VIEWED: Final = "a viewer of skyloop view --foxglove"
VIEWED_STUCK: Final = f"{VIEWED}, stopped"

Progress = Callable[[float, str], None]


class Case(NamedTuple):
    """The other applications that are connected."""

    name: str
    observers: int = 0
    stuck: bool = False  #: whether the last of the observers is stopped
    encoded: bool = False  #: whether the observers receive H.264
    slow: bool = False
    recorder: bool = False
    killed: bool = False  #: whether the recorder is killed half-way through
    disk_full: bool = False  #: whether the recorder's disk is full
    pages: int = 0  #: number of cockpit pages
    viewed: bool = False  #: whether a viewer, possibly stopped, subscribes to everything on a Foxglove server
    size: Size = SMALL
    frame_period_s: float = FRAME_PERIOD_S


class CaseResult(msgspec.Struct, frozen=True):
    """One case: the pilot's delays (``command``, ``feedback``, ``video``) and those of others by channel."""

    case: str
    size: str
    frames_per_s: float
    observers: int
    channels: dict[str, Summary]
    cpu: dict[str, float]  #: cores in use by each part: 1.0 is one full core
    recorder_lost: dict[str, int] | None = None  #: samples by channel that a recorder dropped or missed
    recorder_stopped: str = ""  #: why a recorder had paused at the end of a turn, such as a full disk
    pages: int = 0  #: number of cockpit pages, whose channel is ``video, pages``


class Load(msgspec.Struct, frozen=True, tag_field="what", tag="load"):
    """A whole run, as in ``load.json``. ``seconds``: how long each case was measured."""

    machine: Machine
    seconds: float
    cases: list[CaseResult]
    skipped: dict[str, str]  #: reasons for omitted cases, by name

    def case(self, name: str, size: Size = SMALL, frame_period_s: float = FRAME_PERIOD_S) -> CaseResult | None:
        """Return a case's result; None if it was not measured."""
        wanted = (name, str(size), _rate(frame_period_s))
        return next((case for case in self.cases if (case.case, case.size, case.frames_per_s) == wanted), None)


def observers_name(number: int, *, stuck: bool = False) -> str:
    """Return the name of a case with observers."""
    noun = "observer" if number == 1 else "observers"
    return f"{number} {noun}" + (", one of them stopped" if stuck else "")


def pages_name(number: int) -> str:
    """Return the name of a case with cockpit pages."""
    return f"{number} cockpit page" + ("" if number == 1 else "s")


def cases_of(
    observers: Sequence[int],
    *,
    slow_processor: bool = True,
    stuck: bool = True,
    recorder: bool = True,
    disk_full: bool = True,
    pages: int = 0,
    encoded: bool = False,
    viewed: bool = False,
) -> list[Case]:
    """Return the cases to measure.

    Args:
        observers: A case for each of these numbers of observers.
        slow_processor: Whether to measure a slow processor.
        stuck: Whether to measure a stopped observer.
        recorder: Whether to measure a recorder, and one that is killed.
        disk_full: Whether to measure a recorder whose disk is full.
        pages: How many cockpit pages to measure; 0 for none.
        encoded: Whether to measure viewers of H.264.
        viewed: Whether to measure a viewer of Foxglove's server, and one that is stopped.
    """
    cases = [Case(ALONE)]
    counts = sorted({number for number in observers if number > 0})
    if stuck and STUCK_AMONG not in counts:
        counts = sorted([*counts, STUCK_AMONG])
    for number in counts:
        cases.append(Case(observers_name(number), observers=number))
        if stuck and number == STUCK_AMONG:
            cases.append(Case(observers_name(number, stuck=True), observers=number, stuck=True))
    if encoded:
        cases.append(Case(ENCODED, observers=STUCK_AMONG, stuck=True, encoded=True))
    if slow_processor:
        cases.append(Case(SLOW, slow=True))
    if pages or viewed:
        cases.append(Case(ALONE, size=MIDDLE))
    if pages:
        cases.append(Case(pages_name(pages), pages=pages, size=MIDDLE))
    if viewed:
        seen = Case(VIEWED, viewed=True, size=MIDDLE)
        cases += [seen, seen._replace(name=VIEWED_STUCK, stuck=True)]
    recorded = Case(RECORDED, recorder=True, size=MIDDLE, frame_period_s=RECORDED_PERIOD_S)
    if recorder or disk_full:
        cases.append(recorded._replace(name=ALONE, recorder=False))
    if recorder:
        cases += [recorded, recorded._replace(name=KILLED, killed=True)]
    if disk_full:
        cases.append(recorded._replace(name=FULL, disk_full=True))
    return cases


def measure(
    seconds: float,
    cases: Sequence[Case],
    *,
    record_to: Path | None = None,
    skipped: dict[str, str] | None = None,
    progress: Progress = lambda _share, _what: None,
) -> Load:
    """Measure each case, in turns.

    Without a disk to fill, its case is omitted, and the result's ``skipped`` gives the reason.

    Args:
        seconds: Duration of each case [s].
        cases: The cases.
        record_to: The folder for the recorder.
        skipped: Cases omitted by the caller, with reasons, for the result.
        progress: Called with the fraction done, 0 to 1, and the next step.
    """
    machine = Machine.here()
    rounds = max(1, round(seconds / TURN_S))
    skipped = dict(skipped or {})
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-"))
        folders = {False: record_to or Path(folder)}
        if any(case.disk_full for case in cases):
            try:
                folders[True] = stack.enter_context(small_disk(record_to))
            except UsageError as error:
                skipped[FULL] = str(error)
                cases = [case for case in cases if not case.disk_full]
        tallies = [_Tally(case) for case in cases]
        stage = _Stage(stack.enter_context(Workers()), folder, cases, folders)
        for number in range(rounds):
            for index, tally in enumerate(tallies):
                progress((number + index / len(cases)) / rounds, tally.case.name)
                case = tally.case
                stage.play(tally, Turn(number, seconds / rounds, case.size, case.frame_period_s))
    return Load(machine, seconds, [tally.result() for tally in tallies], skipped)


class _Tally:
    """The measurements of one case so far."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.delays_ns: dict[str, list[int]] = {}
        self.sent: dict[str, int] = {}
        self.cpu_s: dict[str, float] = {}
        self.seconds = 0.0
        self.recorder_lost: dict[str, int] | None = None
        self.recorder_stopped = ""
        self._period_s: dict[str, float] = {}

    def add(self, turn: Turn, arrivals: Arrivals, *, of: str = "", times: int = 1) -> None:
        """Add samples that arrived at the pilot, or at ``times`` others."""
        for channel, pairs in arrivals.items():
            name = f"{channel}, {of}" if of else channel
            kind = channel.partition(",")[0]
            self._period_s[name] = turn.period_s(kind)
            self.delays_ns.setdefault(name, []).extend(received - sent for sent, received in pairs)
            self.sent[name] = self.sent.get(name, 0) + times * turn.count(kind)

    def use(self, turn: Turn, before_s: Mapping[str, float], after_s: Mapping[str, float]) -> None:
        """Add the processor time that the parts used in a turn."""
        self.seconds += turn.seconds
        for part, used_s in after_s.items():
            self.cpu_s[part] = self.cpu_s.get(part, 0.0) + used_s - before_s[part]

    def recorded(self, samples: Mapping[str, int], stopped: str) -> None:
        """Add the samples by channel that a recorder left out in a turn, and why it had paused at the end."""
        self.recorder_stopped = stopped or self.recorder_stopped
        before = self.recorder_lost or {}
        self.recorder_lost = {name: before.get(name, 0) + samples.get(name, 0) for name in {*before, *samples}}

    def result(self) -> CaseResult:
        case = self.case
        for channel in CHANNELS:
            if not self.delays_ns[channel]:
                raise LinkError(f"not one sample of {channel} arrived with: {case.name}")
        return CaseResult(
            case=case.name,
            size=str(case.size),
            frames_per_s=_rate(case.frame_period_s),
            observers=case.observers,
            channels={
                name: summarize(delays, sent=self.sent[name], period_s=self._period_s[name])
                for name, delays in self.delays_ns.items()
                if delays
            },
            cpu={part: used_s / self.seconds for part, used_s in self.cpu_s.items()},
            recorder_lost=self.recorder_lost,
            recorder_stopped=self.recorder_stopped,
            pages=case.pages,
        )


class _Stage:
    """The processes of all cases; a case connects only those it needs."""

    def __init__(self, workers: Workers, folder: str, cases: Sequence[Case], folders: Mapping[bool, Path]) -> None:
        """``folders``: those for recordings, with enough space (False) or a disk to fill (True)."""
        self._workers = workers
        self._proxy = proxy_name(folder)
        self._folders = folders
        modules = {case.slow: "benchmarks.slow" if case.slow else None for case in cases}
        self._pairs = {
            slow: Pair(workers, "benchmarks.measuring.ours", folder, application_module=module)
            for slow, module in modules.items()
        }
        self._observers = [workers.start(observe, self._proxy) for _ in range(max(case.observers for case in cases))]
        for worker in self._observers:
            worker.answer(STARTS_WITHIN_S)

    def play(self, tally: _Tally, turn: Turn) -> None:
        """Run one turn of a case."""
        case = tally.case
        pair = self._pairs[case.slow]
        observers = self._observers[: case.observers]
        pair.open(turn)
        _tell(observers, ["connect"] if not case.encoded else [SHARED, OWN])
        recorder = self._start_recorder(turn, fill=case.disk_full) if case.recorder else None
        pages = self._workers.start(show, self._proxy, case.pages) if case.pages else None
        view = self._workers.start(serve, self._proxy) if case.viewed else None
        viewer = None if view is None else self._workers.start(look, view.answer(STARTS_WITHIN_S))
        if viewer is not None:
            viewer.answer(STARTS_WITHIN_S)
        parts = {
            "proxy": [pair.vehicle.pid],
            "pilot": [pair.application.pid],
            "observers": [worker.pid for worker in observers],
            "recorder": [] if recorder is None or case.killed else [recorder.pid],
            "cockpit": [] if pages is None else [pages.answer(STARTS_WITHIN_S)],
            "pages": [] if pages is None else [pages.pid],
            "view": [] if view is None else [view.pid],
        }
        begin_ns = pair.begin()
        with _stopped(([viewer] if viewer is not None else observers[-1:]) if case.stuck else []):
            sleep_until(begin_ns)
            before_s = _used_s(parts)
            half_ns = round(turn.seconds * 0.5e9)
            sleep_until(begin_ns + half_ns)
            if case.killed and recorder is not None:
                os.kill(recorder.pid, signal.SIGKILL)
            sleep_until(begin_ns + 2 * half_ns)
            tally.use(turn, before_s, _used_s(parts))
        tally.add(turn, pair.arrivals(turn, begin_ns))
        for worker in observers:
            worker.pipe.send("end")
        others = [worker.answer(_ANSWERS_WITHIN_S) for worker in observers]
        for worker in filter(None, (viewer, view)):
            _end(worker)
        for arrivals in others[:-1] if case.stuck else others:
            tally.add(turn, since(arrivals, begin_ns), of="observers")
        if pages is not None:
            tally.add(turn, since(_end(pages), begin_ns), of="pages", times=case.pages)
        if recorder is not None and not case.killed:
            tally.recorded(*_end(recorder))

    def _start_recorder(self, turn: Turn, *, fill: bool) -> Worker:
        file = self._folders[fill] / f"bench-{turn.number}.mcap"
        worker = self._workers.start(record, self._proxy, str(file), fill)
        worker.answer(STARTS_WITHIN_S)
        return worker


def _tell(workers: Sequence[Worker], words: Sequence[str]) -> None:
    """Send all workers these messages, one after another, and collect the answers."""
    for worker, word in zip(workers, cycle(words), strict=False):
        worker.pipe.send(word)
    for worker in workers:
        worker.answer(_ANSWERS_WITHIN_S)


@contextmanager
def _stopped(workers: Sequence[Worker]) -> Iterator[None]:
    """Suspend processes during the block, like Ctrl-Z."""
    for worker in workers:
        os.kill(worker.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for worker in workers:
            os.kill(worker.pid, signal.SIGCONT)


def _used_s(parts: Mapping[str, Sequence[int]]) -> dict[str, float]:
    """Return the processor time of each part's processes so far, without parts that have none."""
    return {part: sum(map(cpu_time_s, pids)) for part, pids in parts.items() if pids}


def _end(worker: Worker) -> Any:
    """End a worker, and return its last message."""
    worker.pipe.send("end")
    return worker.answer(_ANSWERS_WITHIN_S)


def _rate(frame_period_s: float) -> float:
    return round(1 / frame_period_s, 1)


def load(path: Path) -> Load:
    """Read ``load.json``.

    Raises:
        FileFormatError: The file has another format.
    """
    return read_json(path, Load, "the results of benchmarks.load", MAX_RESULTS)


if __name__ == "__main__":
    from benchmarks.command import main

    main("load")
