"""Measure simulated drones over the network, each flown by its own controller, while users fail."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from benchmarks import swarming
from benchmarks.hosts.namespaces import Lab, problem
from benchmarks.measuring.machine import cpu_time_s
from benchmarks.measuring.schedule import sleep_until
from benchmarks.measuring.workers import Worker, Workers
from benchmarks.swarming import Step
from skyloop.bench import Machine, Spread, spread
from skyloop.files import MAX_RESULTS, read_json
from skyloop.network.config import DEFAULT_PORT, free_port

STOPPED_S: Final = 1.2  #: longer than ``failsafe.hover_after_s``, and shorter than ``failsafe.land_after_s``
#: A step of the ladder is expected within this time after its cause, including the rule's own 0.5 s.
WITHIN_S: Final = 2.0
SEED: Final = 4
_STARTS_WITHIN_S: Final = 60.0
_ANSWERS_WITHIN_S: Final = 60.0
_LOOPBACK: Final = "127.0.0.1"

Progress = Callable[[float, str], None]


class Expected(NamedTuple):
    """A drone that must fail safe, because its user stopped at this time."""

    drone: str
    since_ns: int


class Verdict(msgspec.Struct, frozen=True):
    """The outcome of the expected failsafes."""

    expected: int
    missed: int
    needless: int  #: failsafes taken although no user had stopped
    delay: Spread | None  #: from the user's last moment to the step; None if there was no step


class Swarm(msgspec.Struct, frozen=True, tag_field="what", tag="swarm"):
    """A whole run, as in ``swarm.json``."""

    machine: Machine
    seconds: float
    drones: int
    users: int
    observers: int
    hosts: bool  #: whether the parts were on separate hosts, or all on the loopback of one
    command: Spread  #: delay from sending to applying
    feedback: Spread  #: delay from the capture to the user
    feedback_at_observers: Spread | None
    commands_per_s: float  #: executed by each drone, including the time without its user
    frames_per_s: float  #: received from each drone by an observer; 0 without observers
    failsafe: Verdict
    cpu: dict[str, float]  #: cores in use by each part


def judge(expected: Sequence[Expected], steps: Sequence[Step]) -> Verdict:
    """Return the expected failsafes that were taken, and the unexpected ones."""
    left = sorted(steps, key=lambda step: step.at_ns)
    delays_ns = []
    for wish in expected:
        for step in left:
            if step.drone == wish.drone and 0 <= step.at_ns - wish.since_ns <= WITHIN_S * 1e9:
                delays_ns.append(step.at_ns - wish.since_ns)
                left.remove(step)
                break
    delay = spread(delays_ns) if delays_ns else None
    return Verdict(len(expected), len(expected) - len(delays_ns), len(left), delay)


def stops_of(users: int, seconds: float, seed: int = SEED) -> list[float]:
    """Return the times at which each user stops for a while, one after another [s from the beginning]."""
    rng = random.Random(seed)
    room_s = seconds / users
    return [(user + rng.uniform(0.2, 0.6)) * room_s for user in range(users)]


def measure(
    seconds: float,
    drones: int = 10,
    users: int = 1,
    observers: int = 0,
    progress: Progress = lambda _share, _what: None,
) -> Swarm:
    """Make processes share the drones and fly them.

    Each process is stopped once, and finally the first one is killed. With root, each part has its own host.

    Args:
        seconds: Duration [s].
        drones: Number of drones.
        users: Number of processes that fly them.
        observers: Number of processes that watch all of them.
        progress: Called with the fraction done, 0 to 1, and the next step.
    """
    machine = Machine.here()
    with _stage(drones, users, observers) as stage:
        progress(0.0, "taking off")
        stage.take_off()
        flight = stage.play(seconds, progress)
    return Swarm(
        machine,
        seconds,
        drones,
        users,
        observers,
        not problem(),
        spread(flight.commands_ns),
        spread(flight.feedback_ns),
        spread(flight.observed_ns) if observers else None,
        len(flight.commands_ns) / seconds / drones,
        flight.frames / observers / seconds / drones if observers else 0.0,
        judge(flight.expected, flight.steps),
        flight.cpu,
    )


class Flight(NamedTuple):
    """The observations of a run; delays in ns."""

    commands_ns: list[int]
    feedback_ns: list[int]
    observed_ns: list[int]  #: ages of feedback at the observers
    frames: int  #: at all observers together
    expected: list[Expected]
    steps: list[Step]
    cpu: dict[str, float]


Start = Callable[[str, Callable[..., None], Sequence[str]], Worker]


class _Stage:
    """The processes of a run."""

    def __init__(self, start: Start, drones: int, users: int, observers: int) -> None:
        self.names = [f"sim{number}" for number in range(1, drones + 1)]
        self._simulation = start("simulation", swarming.simulate, self.names)
        self.shares = [self.names[user::users] for user in range(users)]
        self._users = [start(f"user{number}", swarming.fly, share) for number, share in enumerate(self.shares)]
        self._observers = [start(f"observer{number}", swarming.look_on, self.names) for number in range(observers)]
        self._witness = start("witness", swarming.bear_witness, self.names)

    def take_off(self) -> None:
        """Connect everyone, and make all drones fly."""
        everybody = [self._witness, *self._users, *self._observers]
        for worker in everybody:
            worker.pipe.send("go")
        for worker in everybody:
            worker.answer(_STARTS_WITHIN_S)

    def play(self, seconds: float, progress: Progress) -> Flight:
        """Stop and resume users; finally collect everyone's observations, and kill the first user."""
        users = len(self._users)
        expected: list[Expected] = []
        for worker in (*self._users, *self._observers):
            _ask(worker, "tell")  # which discards earlier observations
        begin_ns = time.monotonic_ns()
        before_s = self._used_s()
        for user, at_s in enumerate(stops_of(users, seconds)):
            sleep_until(begin_ns + round(at_s * 1e9))
            progress(at_s / seconds, f"user {user + 1} is stopped")
            expected += self._expect(user)
            os.kill(self._users[user].pid, signal.SIGSTOP)
            time.sleep(STOPPED_S)
            os.kill(self._users[user].pid, signal.SIGCONT)
        sleep_until(begin_ns + round(seconds * 1e9))
        end_ns = time.monotonic_ns()
        cpu = {part: (used_s - before_s[part]) / seconds for part, used_s in self._used_s().items()}
        feedback = [delay_ns for worker in self._users for delay_ns in _ask(worker, "tell")]
        looked = [_ask(worker, "tell") for worker in self._observers]
        expected += self._expect(0)
        os.kill(self._users[0].pid, signal.SIGKILL)
        time.sleep(WITHIN_S)
        steps, commands = _ask(self._witness, "end")
        return Flight(
            [delay_ns for at_ns, delay_ns in commands if begin_ns <= at_ns < end_ns],
            feedback,
            [delay_ns for delays_ns, _ in looked for delay_ns in delays_ns],
            sum(frames for _, frames in looked),
            expected,
            steps,
            cpu,
        )

    def _expect(self, user: int) -> list[Expected]:
        """Return the expected failsafes of the flying drones; drones on the ground have no reason to fail safe."""
        flying = _ask(self._witness, "flying")
        now_ns = time.monotonic_ns()
        return [Expected(drone, now_ns) for drone in self.shares[user] if drone in flying]

    def _used_s(self) -> dict[str, float]:
        parts = {"simulation": [self._simulation], "users": self._users, "observers": self._observers}
        return {part: sum(cpu_time_s(worker.pid) for worker in found) for part, found in parts.items() if found}


@contextmanager
def _stage(drones: int, users: int, observers: int) -> Iterator[_Stage]:
    with ExitStack() as stack:
        lab = None if problem() else stack.enter_context(Lab())
        workers = stack.enter_context(Workers())
        segment = None if lab is None else lab.segment("10.77.1.0/24")
        place = f"{_LOOPBACK}:{free_port(_LOOPBACK)}" if lab is None else f"10.77.1.1:{DEFAULT_PORT}"

        def start(name: str, work: Callable[..., None], drones: Sequence[str]) -> Worker:
            prefix: Sequence[str] = ()
            if lab is not None and segment is not None:
                host = lab.host(name)
                segment.join(host)  # the first one to join has the first address
                prefix = host.prefix
            worker = workers.start(work, place, drones, prefix=prefix)
            worker.answer(_STARTS_WITHIN_S)
            return worker

        yield _Stage(start, drones, users, observers)


def _ask(worker: Worker, word: str) -> Any:
    worker.pipe.send(word)
    return worker.answer(_ANSWERS_WITHIN_S)


def load(path: Path) -> Swarm:
    """Read ``swarm.json``.

    Raises:
        FileFormatError: The file has another format.
    """
    return read_json(path, Swarm, "the results of benchmarks.swarm", MAX_RESULTS)


if __name__ == "__main__":
    from benchmarks.command import main

    main("swarm")
