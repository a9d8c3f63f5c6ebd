"""Measure video over mobile uplinks that are replayed between two hosts: ``python -m benchmarks.video_path``."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path as File
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.hosts.impairments import Impairments
from benchmarks.hosts.namespaces import Host, Lab
from benchmarks.hosts.path import Path
from benchmarks.hosts.traces import Trace
from benchmarks.measuring.contract import Arrivals
from benchmarks.measuring.pair import Pair
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, VIDEO, Turn, sleep_until
from benchmarks.measuring.tables import UNKNOWN, Table
from benchmarks.measuring.workers import Workers
from benchmarks.over_path import FORMS, FPS, address
from benchmarks.video_judge import QUALITY, SIZE
from skyloop.bench import Machine
from skyloop.files import MAX_RESULTS, read_json

WEBRTC: Final = "WebRTC (aiortc)"
CONTENDERS: Final = (*FORMS, WEBRTC)
PYTHON_VARIABLE: Final = "SKYLOOP_AIORTC_PYTHON"
DELAY_S: Final = 0.02  #: each way, in addition to the wait for capacity
GOOD_KBIT_S: Final = 300.0  #: only seconds of a trace that carry this much are judged
FROZEN_MS: Final = 250.0 + 1000.0 / FPS  #: the picture counts as frozen while the newest one shown is older
_PATH: Final = Impairments(delay_s=DELAY_S)
_SEED: Final = 8
_SECOND_MS: Final = 1000
_STEP_MS: Final = 5.0
_PORT: Final = 7447
_LOOKS_WITHIN_S: Final = 30.0

Progress = Callable[[float, str], None]


class Ages(msgspec.Struct, frozen=True):
    """Ages of arrivals while the path carried enough [ms]."""

    p50: float
    p95: float
    p99: float


class PathCase(msgspec.Struct, frozen=True):
    """One contender on one trace."""

    trace: str
    contender: str
    carried_kbit_s: float  #: by the path, on average over the whole time
    sent_kbit_s: float  #: part of that used by everything the vehicle sent
    good_share: float  #: fraction of the time with enough capacity, to which all but two of the fields below refer
    video: Ages | None  #: age of each picture on arrival at the application; None if none arrived
    frozen_share: float | None
    unavoidable_share: float  #: fraction in which a frozen picture was unavoidable
    frozen_of_all: float | None  #: of the whole time, at any capacity …
    unavoidable_of_all: float  #: … and the unavoidable part of that
    pictures_per_s: float
    psnr_db: float | None
    feedback: Ages | None
    command: Ages | None
    commands_share: float  #: fraction of all commands sent that were executed
    shown: list[tuple[int, int]] = []  #: time of arrival [ms] and age of each picture; of one trace only


class VideoPath(msgspec.Struct, frozen=True, tag_field="what", tag="video_path"):
    """A whole run, as in ``video_path.json``. ``seconds``: how long each case was measured."""

    machine: Machine
    seconds: float
    cases: list[PathCase]
    skipped: dict[str, str] = {}


def aiortc_python() -> tuple[str, str]:
    """Return the interpreter with aiortc, and the reason if there is none; one of the two is empty."""
    python = os.environ.get(PYTHON_VARIABLE) or sys.executable
    try:
        ended = subprocess.run(
            [python, "-c", "import aiortc, numpy"], capture_output=True, text=True, timeout=_LOOKS_WITHIN_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return "", f"{python} does not run ({type(error).__name__})"
    if ended.returncode:
        why = (ended.stderr.strip().splitlines() or ["it can't be imported"])[-1]
        return "", f"{why}: pip install aiortc numpy, in an environment whose interpreter {PYTHON_VARIABLE} names"
    return python, ""


def measure(
    seconds: float,
    traces: Iterable[Trace],
    contenders: Sequence[str] = CONTENDERS,
    progress: Progress = lambda _share, _what: None,
) -> VideoPath:
    """Measure each contender on each trace.

    Args:
        seconds: Duration of each case, from the beginning of the trace [s].
        traces: Capacities of the path to the pilot.
        contenders: Some of :data:`CONTENDERS`.
        progress: Called with the fraction done, 0 to 1, and the next step.

    Raises:
        UnsupportedError: No hosts can be created here.
    """
    machine, skipped, cases = Machine.here(), {}, []
    python, why = aiortc_python() if WEBRTC in contenders else ("", "")
    if why:
        skipped[WEBRTC] = why
    wanted = [(trace, contender) for trace in traces for contender in contenders if contender not in skipped]
    for index, (trace, contender) in enumerate(wanted):
        progress(index / len(wanted), f"{trace.name}, {contender}")
        with Lab() as lab, Workers() as workers:  # a separate lab for each, because WebRTC uses any path it finds
            hosts = lab.host("vehicle"), lab.host("pilot")
            case = _Stage(lab, workers, hosts, contender, python).play(trace, seconds)
        if trace.name != wanted[0][0].name:
            case = msgspec.structs.replace(case, shown=[])
        cases.append(case)
    return VideoPath(machine, seconds, cases, skipped)


class _Stage:
    """A path, and both ends of one contender."""

    def __init__(self, lab: Lab, workers: Workers, hosts: tuple[Host, Host], contender: str, python: str) -> None:
        self._path = Path(lab, *hosts, seed=_SEED, impairments=_PATH)
        self._contender = contender
        place = f"{self._path.first}:{_PORT}"
        prefixes = (hosts[0].prefix, hosts[1].prefix)
        if contender == WEBRTC:
            self._pair = Pair(workers, "benchmarks.peers.webrtc", place, python=python, prefixes=prefixes)
        else:
            self._pair = Pair(workers, "benchmarks.over_path", address(contender, place), prefixes=prefixes)

    def play(self, trace: Trace, seconds: float) -> PathCase:
        """Connect before the trace begins, and disconnect after its end."""
        turn = Turn(0, seconds, SIZE, 1.0 / FPS)
        self._pair.open(turn)
        begin_ns = self._pair.begin()
        sleep_until(begin_ns)
        self._path.tell()
        self._path.set(replace(_PATH, trace=replace(trace, begin_ns=begin_ns)), _PATH)
        sleep_until(begin_ns + round(seconds * 1e9))
        there, _ = self._path.tell()
        self._path.set(_PATH)
        arrivals = self._pair.arrivals(turn, begin_ns)
        return judge(self._contender, trace, seconds, begin_ns, arrivals, there.size)


def judge(contender: str, trace: Trace, seconds: float, begin_ns: int, arrivals: Arrivals, sent_bytes: int) -> PathCase:
    """Compute the figures from the arrivals. Pure.

    Args:
        contender: Its name.
        trace: The path's capacity.
        seconds: Duration [s].
        begin_ns: Start time.
        arrivals: Times of sending and receiving, by channel [ns].
        sent_bytes: Bytes that passed the path to the pilot.
    """
    good = [
        trace.kbit(begin, begin + _SECOND_MS) >= GOOD_KBIT_S
        for begin in range(0, int(seconds * _SECOND_MS), _SECOND_MS)
    ]
    shown = _newest_first(arrivals.get(VIDEO, []), begin_ns, seconds)
    in_time = [age for at, age in shown if good[int(at // _SECOND_MS)]]
    qualities = [(float(name.removeprefix(QUALITY)), pairs) for name, pairs in arrivals.items() if QUALITY in name]
    judged = sum(len(pairs) for _, pairs in qualities)
    # Pictures captured before the start are unknown, so nothing counts as frozen until their age would be too great.
    steps = np.arange(FROZEN_MS, seconds * _SECOND_MS, _STEP_MS)
    counts = np.array([good[int(ms // _SECOND_MS)] for ms in steps])
    commands, delay_ms = arrivals.get(COMMAND, []), DELAY_S * 1e3
    frozen = _frozen(shown, steps)
    unavoidable = np.array([trace.waits_ms(ms - delay_ms) + delay_ms > FROZEN_MS for ms in steps])
    return PathCase(
        trace=trace.name,
        contender=contender,
        carried_kbit_s=trace.kbit(0, seconds * _SECOND_MS) / seconds,
        sent_kbit_s=sent_bytes * 8e-3 / seconds,
        good_share=sum(good) / len(good),
        video=_ages(in_time),
        frozen_share=float(np.mean(frozen[counts])) if in_time else None,
        unavoidable_share=float(np.mean(unavoidable[counts])) if counts.any() else 0.0,
        frozen_of_all=float(np.mean(frozen)) if in_time else None,
        unavoidable_of_all=float(np.mean(unavoidable)),
        pictures_per_s=len(in_time) / max(1, sum(good)),
        psnr_db=sum(decibel * len(pairs) for decibel, pairs in qualities) / judged if judged else None,
        feedback=_ages(_in_good(arrivals.get(FEEDBACK, []), good, begin_ns)),
        command=_ages(_in_good(commands, good, begin_ns)),
        commands_share=len(commands) / Turn(0, seconds).count(COMMAND),
        shown=[(round(at), round(age)) for at, age in shown],
    )


def _newest_first(pairs: list[tuple[int, int]], begin_ns: int, seconds: float) -> list[tuple[float, float]]:
    """Return each picture's arrival time, from the start [ms], and its age, without overtaken pictures."""
    found, newest_ns = [], -1
    for sent_ns, received_ns in sorted(pairs, key=lambda pair: pair[1]):
        at_ms = (received_ns - begin_ns) / 1e6
        if sent_ns > newest_ns and at_ms < seconds * _SECOND_MS:
            newest_ns = sent_ns
            found.append((at_ms, (received_ns - sent_ns) / 1e6))
    return found


def _in_good(pairs: list[tuple[int, int]], good: Sequence[bool], begin_ns: int) -> list[float]:
    """Return the ages of arrivals while the path carried enough [ms]."""
    found = []
    for sent_ns, received_ns in pairs:
        second = int((received_ns - begin_ns) / 1e6 // _SECOND_MS)
        if second < len(good) and good[second]:
            found.append((received_ns - sent_ns) / 1e6)
    return found


def _ages(ages_ms: list[float]) -> Ages | None:
    return Ages(*(float(value) for value in np.percentile(ages_ms, [50, 95, 99]))) if ages_ms else None


def _frozen(shown: list[tuple[float, float]], steps: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether the newest picture shown is too old at each of the steps [ms]."""
    if not shown:
        return np.ones(len(steps), dtype=np.bool_)
    came = np.array([at for at, _ in shown])
    captured = np.array([at - age for at, age in shown])
    index = np.searchsorted(came, steps, side="right") - 1
    found: NDArray[np.bool_] = np.where(index >= 0, steps - captured[np.maximum(index, 0)], np.inf) > FROZEN_MS
    return found


def table(results: VideoPath) -> Table:
    """Return all figures."""
    rows = []
    for case in results.cases:
        rows.append(
            [
                case.trace,
                case.contender,
                _three(case.video),
                f"{case.good_share:.0%}",
                _frozen_share(case.frozen_share, case.unavoidable_share),
                _frozen_share(case.frozen_of_all, case.unavoidable_of_all),
                f"{case.pictures_per_s:.1f}",
                f"{case.sent_kbit_s:.0f} / {case.carried_kbit_s:.0f}",
                UNKNOWN if case.psnr_db is None else f"{case.psnr_db:.0f}",
                _three(case.feedback),
                _three(case.command),
                f"{case.commands_share:.1%}",
            ]
        )
    columns = [
        *("uplink", "video", "its age", "seconds of 300 kbit/s", "frozen in these (unavoidably)", "in all"),
        *("pictures a second", "kbit/s used / carried", "PSNR in dB", "age of feedback", "age of commands", "executed"),
    ]
    return Table("Ages in ms: median, 95th and 99th percentile, while the uplink carries 300 kbit/s", columns, rows)


def _frozen_share(share: float | None, unavoidable: float) -> str:
    return UNKNOWN if share is None else f"{share:.1%} ({unavoidable:.1%})"


def _three(ages: Ages | None) -> str:
    return UNKNOWN if ages is None else f"{ages.p50:.0f}, {ages.p95:.0f}, {ages.p99:.0f}"


def load(path: File) -> VideoPath:
    """Read ``video_path.json``.

    Raises:
        FileFormatError: The file has another format.
    """
    return read_json(path, VideoPath, "the results of benchmarks.video_path", MAX_RESULTS)


if __name__ == "__main__":
    from benchmarks.command import main

    main("video_path")
