"""``skyloop bench load``: what becomes of the pilot's delays when others look on, are slow, stand still or record."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from skyloop.bench.contract import Arrivals
from skyloop.bench.machine import Machine, cpu_time_s
from skyloop.bench.onlookers import observe, record
from skyloop.bench.ours import proxy_name
from skyloop.bench.pair import Pair, since
from skyloop.bench.schedule import CHANNELS, FRAME_PERIOD_S, MIDDLE, SMALL, Size, Turn
from skyloop.bench.statistics import Summary, summarize
from skyloop.bench.workers import STARTS_WITHIN_S, Worker, Workers
from skyloop.errors import LinkError

TURN_S: Final = 5.0
RECORDED_PERIOD_S: Final = 1 / 30
STUCK_AMONG: Final = 8  #: observers, one of which is stopped
_ANSWERS_WITHIN_S: Final = 20.0

ALONE: Final = "nobody else"
SLOW: Final = "a processor of 200 ms a frame"
PARTS: Final = ("proxy", "pilot", "observers", "recorder")  #: whose processor time is measured
RECORDED: Final = "recorder"
KILLED: Final = "recorder, killed half-way"

Progress = Callable[[float, str], None]


class Case(NamedTuple):
    """Who else is there."""

    name: str
    observers: int = 0
    stuck: bool = False  #: the last of the observers is stopped
    slow: bool = False
    recorder: bool = False
    killed: bool = False  #: the recorder, half-way through
    size: Size = SMALL
    frame_period_s: float = FRAME_PERIOD_S


class CaseResult(msgspec.Struct, frozen=True):
    """One case: the pilot's delays (``command``, ``feedback``, ``video``) and those of others by channel."""

    case: str
    size: str
    frames_per_s: float
    observers: int
    channels: dict[str, Summary]
    cpu: dict[str, float]  #: cores in use by each part: 1.0 is one core all the time
    recorder_lost: dict[str, int] | None = None  #: samples by channel that a recorder dropped or missed


class Load(msgspec.Struct, frozen=True, tag_field="what", tag="load"):
    """A whole run; what ``load.json`` holds. ``seconds``: that each case was measured."""

    machine: Machine
    seconds: float
    cases: list[CaseResult]
    skipped: dict[str, str]

    def case(self, name: str, size: Size = SMALL) -> CaseResult | None:
        """None if it was not measured."""
        return next((case for case in self.cases if case.case == name and case.size == str(size)), None)


def observers_name(number: int, *, stuck: bool = False) -> str:
    noun = "observer" if number == 1 else "observers"
    return f"{number} {noun}" + (", one of them stopped" if stuck else "")


def cases_of(
    observers: Sequence[int], *, slow_processor: bool = True, stuck: bool = True, recorder: bool = True
) -> list[Case]:
    """What to measure. Pure."""
    cases = [Case(ALONE)]
    counts = sorted({number for number in observers if number > 0})
    if stuck and STUCK_AMONG not in counts:
        counts = sorted([*counts, STUCK_AMONG])
    for number in counts:
        cases.append(Case(observers_name(number), observers=number))
        if stuck and number == STUCK_AMONG:
            cases.append(Case(observers_name(number, stuck=True), observers=number, stuck=True))
    if slow_processor:
        cases.append(Case(SLOW, slow=True))
    if recorder:
        recorded = Case(RECORDED, recorder=True, size=MIDDLE, frame_period_s=RECORDED_PERIOD_S)
        cases += [recorded._replace(name=ALONE, recorder=False), recorded, recorded._replace(name=KILLED, killed=True)]
    return cases


def measure(
    seconds: float,
    cases: Sequence[Case],
    *,
    record_to: Path | None = None,
    skipped: dict[str, str] | None = None,
    progress: Progress = lambda _share, _what: None,
) -> Load:
    """Measure each case for ``seconds``, in turns. ``record_to``: the folder that the recorder writes to."""
    machine = Machine.here()
    rounds = max(1, round(seconds / TURN_S))
    tallies = [_Tally(case) for case in cases]
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, Workers() as workers:
        stage = _Stage(workers, folder, cases, record_to or Path(folder))
        for number in range(rounds):
            for index, tally in enumerate(tallies):
                progress((number + index / len(cases)) / rounds, tally.case.name)
                case = tally.case
                stage.play(tally, Turn(number, seconds / rounds, case.size, case.frame_period_s))
    return Load(machine, seconds, [tally.result() for tally in tallies], skipped or {})


class _Tally:
    """What was measured of one case so far."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.delays_ns: dict[str, list[int]] = {}
        self.sent: dict[str, int] = {}
        self.cpu_s: dict[str, float] = {}
        self.seconds = 0.0
        self.recorder_lost: dict[str, int] | None = None
        self._period_s: dict[str, float] = {}

    def add(self, turn: Turn, arrivals: Arrivals, *, of: str = "", times: int = 1) -> None:
        """Samples that arrived at the pilot, or at ``times`` others."""
        for channel, pairs in arrivals.items():
            name = f"{channel}, {of}" if of else channel
            kind = channel.partition(",")[0]
            self._period_s[name] = turn.period_s(kind)
            self.delays_ns.setdefault(name, []).extend(heard - sent for sent, heard in pairs)
            self.sent[name] = self.sent.get(name, 0) + times * turn.count(kind)

    def result(self) -> CaseResult:
        case = self.case
        for channel in CHANNELS:
            if not self.delays_ns[channel]:
                raise LinkError(f"not one sample of {channel} arrived with: {case.name}")
        return CaseResult(
            case=case.name,
            size=str(case.size),
            frames_per_s=round(1 / case.frame_period_s, 1),
            observers=case.observers,
            channels={
                name: summarize(delays, sent=self.sent[name], period_s=self._period_s[name])
                for name, delays in self.delays_ns.items()
                if delays
            },
            cpu={part: used_s / self.seconds for part, used_s in self.cpu_s.items()},
            recorder_lost=self.recorder_lost,
        )


class _Stage:
    """The processes of all cases; those that a case does not need are not connected meanwhile."""

    def __init__(self, workers: Workers, folder: str, cases: Sequence[Case], record_to: Path) -> None:
        self._workers = workers
        self._proxy = proxy_name(folder)
        self._record_to = record_to
        modules = {case.slow: "skyloop.bench.slow" if case.slow else None for case in cases}
        self._pairs = {
            slow: Pair(workers, "skyloop.bench.ours", folder, application_module=module)
            for slow, module in modules.items()
        }
        self._observers = [workers.start(observe, self._proxy) for _ in range(max(case.observers for case in cases))]
        for worker in self._observers:
            worker.answer(STARTS_WITHIN_S)

    def play(self, tally: _Tally, turn: Turn) -> None:
        """One turn of a case."""
        case = tally.case
        pair = self._pairs[case.slow]
        observers = self._observers[: case.observers]
        pair.open(turn)
        _tell(observers, "connect")
        recorder = self._start_recorder(turn) if case.recorder else None
        processes = ([pair.vehicle], [pair.application], observers, [] if recorder is None else [recorder])
        parts = {part: workers for part, workers in zip(PARTS, processes, strict=True) if workers}
        begin_ns = pair.begin()
        with _stopped(observers[-1:] if case.stuck else []):
            _sleep_until(begin_ns)
            before_s = {part: _used_s(workers) for part, workers in parts.items()}
            half_ns = round(turn.seconds * 0.5e9)
            _sleep_until(begin_ns + half_ns)
            if case.killed and recorder is not None:
                os.kill(recorder.pid, signal.SIGKILL)
            _sleep_until(begin_ns + 2 * half_ns)
            for part, workers in parts.items():
                if not (case.killed and part == "recorder"):
                    tally.cpu_s[part] = tally.cpu_s.get(part, 0.0) + _used_s(workers) - before_s[part]
        tally.seconds += turn.seconds
        tally.add(turn, pair.arrivals(turn, begin_ns))
        for worker in observers:
            worker.pipe.send("end")
        others = [worker.answer(_ANSWERS_WITHIN_S) for worker in observers]
        for arrivals in others[:-1] if case.stuck else others:
            tally.add(turn, since(arrivals, begin_ns), of="observers")
        if recorder is not None and not case.killed:
            recorder.pipe.send("end")
            _add_losses(tally, recorder.answer(_ANSWERS_WITHIN_S))

    def _start_recorder(self, turn: Turn) -> Worker:
        worker = self._workers.start(record, self._proxy, str(self._record_to / f"bench-{turn.number}.mcap"))
        worker.answer(STARTS_WITHIN_S)
        return worker


def _tell(workers: Sequence[Worker], word: str) -> None:
    """All at once, then all their answers."""
    for worker in workers:
        worker.pipe.send(word)
    for worker in workers:
        worker.answer(_ANSWERS_WITHIN_S)


@contextmanager
def _stopped(workers: Sequence[Worker]) -> Iterator[None]:
    """As if their users had pressed Ctrl-Z."""
    for worker in workers:
        os.kill(worker.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for worker in workers:
            os.kill(worker.pid, signal.SIGCONT)


def _used_s(workers: Sequence[Worker]) -> float:
    return sum(cpu_time_s(worker.pid) for worker in workers)


def _sleep_until(at_ns: int) -> None:
    time.sleep(max(0, at_ns - time.monotonic_ns()) / 1e9)


def _add_losses(tally: _Tally, losses: dict[str, int]) -> None:
    before = tally.recorder_lost or {}
    tally.recorder_lost = {name: before.get(name, 0) + losses.get(name, 0) for name in {*before, *losses}}


def load(path: Path) -> Load:
    """What ``load.json`` holds. Raises ``msgspec.ValidationError`` for anything else."""
    return msgspec.json.decode(path.read_bytes(), type=Load)
