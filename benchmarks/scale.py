"""Add proxies and observers to one host until it is overloaded, and measure the cost of each."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import msgspec

from benchmarks import over_network
from benchmarks.hosts.namespaces import Lab, problem
from benchmarks.measuring.contract import Arrivals, Recorder, vehicle_side
from benchmarks.measuring.machine import cpu_time_s, memory_bytes
from benchmarks.measuring.ours import Listening
from benchmarks.measuring.pair import since
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, SETTLE_S, VIDEO, WARM_UP_S, Turn, paced, sleep_until
from benchmarks.measuring.statistics import Summary, summarize
from benchmarks.measuring.waypoints import fly
from benchmarks.measuring.workers import Pipe, Worker, Workers
from skyloop.bench import CAMERA, Machine
from skyloop.errors import LinkError, NoAnswerError
from skyloop.files import MAX_RESULTS, read_json
from skyloop.network import FabricSettings
from skyloop.network.config import DEFAULT_PORT, Part
from skyloop.network.session import acquire, release

COUNTS: Final = (1, 2, 5, 10, 20, 50)
FRAME_PERIOD_S: Final = 0.1
TURN_S: Final = 10.0
PARTS: Final = ("proxies", "pilot", "observers", "router")
#: Signs of overload: fewer samples arrive, they are older than with one, or no processor is left.
LEAST_SHARE: Final = 0.99
MOST_P99: Final = 5.0
MOST_CORES: Final = 0.9
OBSERVED: Final = 10  #: observers in the cases that give the unit costs
_AT_ONCE: Final = 10  # processes that connect at the same moment
_AHEAD_NS: Final = 200_000_000
_ANSWERS_WITHIN_S: Final = 120.0

Progress = Callable[[float, str], None]


class Case(NamedTuple):
    """The numbers of a case.

    One process flies all proxies' vehicles; the observers are spread over the proxies in turn.
    """

    proxies: int
    observers: int
    video: bool = True  #: whether observers get video too
    router: bool = False  #: whether the observers are on another segment, behind a router

    @property
    def name(self) -> str:
        return (
            f"{self.proxies} {'proxy' if self.proxies == 1 else 'proxies'}, {self.observers} "
            f"{'observer' if self.observers == 1 else 'observers'}"
            + ("" if self.video else ", no video")
            + (", through a router" if self.router else "")
        )


class CaseResult(msgspec.Struct, frozen=True):
    """One case. Channels: ``command``, ``feedback`` at the pilot, and both ``…, observers``."""

    proxies: int
    observers: int
    video: bool
    router: bool
    channels: dict[str, Summary]
    shares: dict[str, float]  #: fraction of each channel's samples that arrived
    cpu: dict[str, float]  #: cores in use by each part: 1.0 is one full core
    memory_mb: dict[str, float]  #: unshared memory of one process of each part
    opened_s: float  #: time the pilot took to connect to all proxies in sequence


class Scale(msgspec.Struct, frozen=True, tag_field="what", tag="scale"):
    """A whole run, as in ``scale.json``. ``seconds``: how long each case was measured."""

    machine: Machine
    seconds: float
    cases: list[CaseResult]
    skipped: dict[str, str]
    jpeg_us: float  #: processor time to encode one frame

    def series(self, many: str) -> list[CaseResult]:
        """Return a series of cases.

        Args:
            many: ``"proxies"``: growing numbers of proxies, each with an observer; ``"observers"``: of one proxy.
        """
        found = [case for case in self.cases if case.video and not case.router and case.observers]
        wanted = [
            case for case in found if (case.proxies == case.observers if many == "proxies" else case.proxies == 1)
        ]
        return sorted(wanted, key=lambda case: case.observers)

    def case(self, wanted: Case) -> CaseResult | None:
        """Return a case's result; None if it was not measured."""
        return next(
            (case for case in self.cases if (case.proxies, case.observers, case.video, case.router) == wanted), None
        )


def bends(series: Sequence[CaseResult], cores: int) -> tuple[CaseResult, str] | None:
    """Return the first overloaded case of a series, and why; None if there is none.

    Overloaded means that too few samples arrive, that the 99th percentile of a delay is too many times the first
    case's, or that too many cores are in use.
    """
    for case in series:
        for channel, share in case.shares.items():
            if share < LEAST_SHARE:
                return case, f"{share:.1%} of {channel} arrived"
        for channel, summary in case.channels.items():
            first = series[0].channels.get(channel)
            if first is not None and summary.p99_us > MOST_P99 * first.p99_us:
                times = summary.p99_us / first.p99_us
                return case, f"the 99th percentile of {channel} is {times:.0f} times the first's"
        if sum(case.cpu.values()) > MOST_CORES * cores:
            return case, f"{sum(case.cpu.values()):.1f} of {cores} cores are in use"
    return None


#: The cases that give the unit costs: see :mod:`benchmarks.units`.
UNIT_CASES: Final = (
    Case(1, 0, video=False),
    Case(1, OBSERVED, video=False),
    Case(1, OBSERVED),
    Case(1, OBSERVED, router=True),
    Case(1, OBSERVED, video=False, router=True),
)


def cases_of(counts: Sequence[int]) -> list[Case]:
    """Return the cases to measure."""
    counts = sorted({count for count in counts if count > 0})
    return list(dict.fromkeys([*(Case(n, n) for n in counts), *(Case(1, n) for n in counts), *UNIT_CASES]))


def measure(seconds: float, cases: Sequence[Case], progress: Progress = lambda _share, _what: None) -> Scale:
    """Measure each case.

    Cases with a router need separate hosts, and are omitted without them.

    Args:
        seconds: Duration of each case [s].
        cases: The cases.
        progress: Called with the fraction done, 0 to 1, and the next step.
    """
    machine = Machine.here()
    skipped: dict[str, str] = {}
    if why := problem():
        skipped = {case.name: why for case in cases if case.router}
        cases = [case for case in cases if not case.router]
    results = []
    for number, case in enumerate(cases):
        progress(number / len(cases), case.name)
        try:
            with _stage(case) as stage:
                results.append(stage.play(seconds))
        except (LinkError, NoAnswerError) as error:  # far too many for this machine: keep the other cases
            skipped[case.name] = str(error)
    return Scale(machine, seconds, results, skipped, over_network.jpeg_us())


class _Stage:
    """The processes of one case."""

    def __init__(self, case: Case, workers: Workers, places: _Places) -> None:
        self._case = case
        self.parts: dict[str, list[Worker]] = {part: [] for part in PARTS}

        def start(part: str, work: Callable[..., None], *arguments: object) -> None:
            self.parts[part].append(workers.start(work, *arguments, prefix=places.prefixes.get(part, ())))

        if places.router:
            start("router", route, places.router)
        names = [f"drone{number}" for number in range(case.proxies)]
        places_of = [places.router[:1] or (loopback(number),) for number in range(case.proxies)]
        for name, place in zip(names, places_of, strict=True):
            address = over_network.address(name, *place, listens=not places.router)
            start("proxies", vehicle_side, over_network.__name__, address)
        everybody = tuple(dict.fromkeys(place for each in places_of for place in each))
        start("pilot", fly_all, [over_network.address(name, *everybody) for name in names])
        for number in range(case.observers):
            index = number % case.proxies
            place = places.router[1:] or places_of[index]
            start("observers", observe, over_network.address(names[index], *place), case.video)
        for worker in self._all():
            worker.answer(_ANSWERS_WITHIN_S)

    def _all(self) -> list[Worker]:
        return [worker for part in PARTS for worker in self.parts[part]]

    def play(self, seconds: float) -> CaseResult:
        """Open everything, measure, and close."""
        turn = Turn(0, seconds, frame_period_s=FRAME_PERIOD_S)
        producers = [*self.parts["proxies"], *self.parts["pilot"]]
        _tell(self.parts["proxies"], turn)
        [opened_s] = _tell(self.parts["pilot"], turn)
        _tell(self.parts["observers"], turn)
        begin_ns = time.monotonic_ns() + round(WARM_UP_S * 1e9) + _AHEAD_NS
        for worker in producers:
            worker.pipe.send(begin_ns)
        sleep_until(begin_ns)
        before_s = self._used_s()
        sleep_until(begin_ns + round(seconds * 1e9))
        used_s = {part: after_s - before_s[part] for part, after_s in self._used_s().items()}
        memory = {part: memory_bytes(workers[0].pid) / 1e6 for part, workers in self.parts.items() if workers}
        received = [worker.answer(seconds + SETTLE_S + _ANSWERS_WITHIN_S) for worker in producers]
        for worker in self.parts["observers"]:
            worker.pipe.send("end")
        observed = [worker.answer(_ANSWERS_WITHIN_S) for worker in self.parts["observers"]]
        tally = _Tally(turn, begin_ns)
        for arrivals in received[: self._case.proxies]:
            tally.add({COMMAND: arrivals.get(COMMAND, [])}, COMMAND)
        tally.add(received[-1], FEEDBACK, times=self._case.proxies)
        for arrivals in observed:
            tally.add(arrivals, FEEDBACK, of="observers")
            if self._case.video:
                tally.add(arrivals, VIDEO, of="observers")
        case = self._case
        return CaseResult(
            case.proxies,
            case.observers,
            case.video,
            case.router,
            tally.channels(),
            tally.shares(),
            {part: used / seconds for part, used in used_s.items()},
            memory,
            opened_s,
        )

    def _used_s(self) -> dict[str, float]:
        return {
            part: sum(cpu_time_s(worker.pid) for worker in workers) for part, workers in self.parts.items() if workers
        }


class _Places(NamedTuple):
    """Where the parts run, if not all of them on this host's loopback."""

    router: tuple[str, ...] = ()  #: addresses of a router, on the proxies' segment and the observers'
    prefixes: Mapping[str, Sequence[str]] = MappingProxyType({})


@contextmanager
def _stage(case: Case) -> Iterator[_Stage]:
    with ExitStack() as stack:
        if not case.router:
            yield _Stage(case, stack.enter_context(Workers()), _Places())
            return
        lab = stack.enter_context(Lab())
        inner, outer = lab.segment("10.77.1.0/24"), lab.segment("10.77.2.0/24")
        hosts = {part: lab.host(part) for part in ("proxies", "observers", "router")}
        inner.join(hosts["proxies"])
        outer.join(hosts["observers"])
        router = tuple(f"{segment.join(hosts['router'])}:{DEFAULT_PORT}" for segment in (inner, outer))
        prefixes = {part: host.prefix for part, host in hosts.items()} | {"pilot": hosts["proxies"].prefix}
        yield _Stage(case, stack.enter_context(Workers()), _Places(router, prefixes))


class _Tally:
    """The arrivals of a case."""

    def __init__(self, turn: Turn, begin_ns: int) -> None:
        self._turn = turn
        self._begin_ns = begin_ns
        self._delays_ns: dict[str, list[int]] = {}
        self._sent: dict[str, int] = {}

    def add(self, arrivals: Arrivals, channel: str, *, of: str = "", times: int = 1) -> None:
        name = f"{channel}, {of}" if of else channel
        found = since(arrivals, self._begin_ns).get(channel, [])
        self._delays_ns.setdefault(name, []).extend(received - sent for sent, received in found)
        self._sent[name] = self._sent.get(name, 0) + times * self._turn.count(channel)

    def channels(self) -> dict[str, Summary]:
        return {
            name: summarize(delays, sent=self._sent[name], period_s=self._turn.period_s(name.partition(",")[0]))
            for name, delays in self._delays_ns.items()
            if delays  # on a heavily overloaded machine nothing may arrive on a channel
        }

    def shares(self) -> dict[str, float]:
        return {name: min(1.0, len(delays) / self._sent[name]) for name, delays in self._delays_ns.items()}


def loopback(number: int) -> str:
    """Return an address of this host used by no other proxy of this or any other run."""
    return f"127.{20 + os.getpid() % 200}.{number // 250}.{1 + number % 250}:{DEFAULT_PORT}"


def fly_all(pipe: Pipe, addresses: Sequence[str]) -> None:
    """Run the pilot's process: it flies all drones, with the same period and at the same moment."""
    pipe.send("ready")
    while (turn := pipe.recv()) is not None:
        recorder = Recorder()
        opening_s = time.monotonic()
        with ExitStack() as stack:
            applications = []
            for each in addresses:
                applications.append(over_network.Pilot(each, recorder.received))
                stack.callback(applications[-1].close)
            pipe.send(time.monotonic() - opening_s)
            if (begin_ns := pipe.recv()) is None:
                return
            for _, setpoint in zip(paced(turn.deadlines_ns(COMMAND, begin_ns)), fly(), strict=False):
                for application in applications:
                    application.command(time.monotonic_ns(), setpoint)
            time.sleep(SETTLE_S)
            pipe.send(recorder.arrivals)  # before closing, which takes long on a heavily overloaded machine


def observe(pipe: Pipe, address: str, video: bool) -> None:
    """Run an observer of feedback and, if wanted, video, which sends its arrivals at the end of a turn."""
    pipe.send("ready")
    while pipe.recv() is not None:
        recorder = Recorder()
        listening = Listening(recorder.received)
        with over_network.connect(address, "observe") as drone:
            drone.on_feedback(listening.feedback, inline=True)
            if video:
                drone.on_frame(listening.frame, camera=CAMERA, inline=True, **over_network.JPEG)
            pipe.send("connected")
            pipe.recv()
        pipe.send(recorder.arrivals)


def route(pipe: Pipe, places: Sequence[str]) -> None:
    """Run a router on all segments until the end."""
    session = acquire(FabricSettings(listen=tuple(places), multicast=False), Part.ROUTER)
    pipe.send("ready")
    try:
        pipe.recv()
    finally:
        release(session, linger=False)


def _tell(workers: Sequence[Worker], turn: Turn) -> list[Any]:
    """Make the workers open for a turn, a few at a time; return their answers."""
    said = []
    for first in range(0, len(workers), _AT_ONCE):
        some = workers[first : first + _AT_ONCE]
        for worker in some:
            worker.pipe.send(turn)
        said += [worker.answer(_ANSWERS_WITHIN_S) for worker in some]
    return said


def load(path: Path) -> Scale:
    """Read ``scale.json``.

    Raises:
        FileFormatError: The file has another format.
    """
    return read_json(path, Scale, "the results of benchmarks.scale", MAX_RESULTS)


if __name__ == "__main__":
    from benchmarks.command import main

    main("scale")
