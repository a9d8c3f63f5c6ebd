"""Processor workers as separate processes: killed, stopped, and left running when the proxy dies."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import skyloop
from skyloop.client import Drone, Result
from skyloop.messages import LinkState
from tests.support.processes import Process, eventually

pytestmark = pytest.mark.process

PROCESSOR = f"{Path(__file__).with_name('processor.py')}:Marks"
FPS = 30
WITHIN_S = 1.0  # within which the other workers have taken over a dead worker's share


class Collected:
    """All results, in order of arrival."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._results: list[Result] = []

    def add(self, result: Result) -> None:
        with self._lock:
            self._results.append(result)

    def after(self, captured_ns: int) -> list[Result]:
        """Results for frames captured later than that."""
        with self._lock:
            return [result for result in self._results if result.captured_ns > captured_ns]

    def pids(self, captured_ns: int = 0) -> set[int]:
        return {result.value["pid"] for result in self.after(captured_ns)}


@contextmanager
def collecting(drone: Drone) -> Iterator[Collected]:
    found = Collected()
    with drone.on_result(found.add, "marks", inline=True):
        yield found


def work(start: Callable[..., Process], count: int) -> list[Process]:
    return [start("-m", "skyloop", "process", PROCESSOR, "--drone", "alpha") for _ in range(count)]


def whole_since(found: Collected, begin_ns: int, length: int = 10) -> int | None:
    """Capture time of the first frame of this many consecutive ones that each have a result; None: not yet."""
    run: list[Result] = []
    for result in sorted(found.after(begin_ns), key=lambda one: one.seq):
        if run and result.seq != run[-1].seq + 1:
            run = []
        run.append(result)
        if len(run) == length:
            return run[0].captured_ns
    return None


def until_shared(found: Collected, workers: list[Process]) -> None:
    """Wait until each worker has its share."""
    for worker in workers:
        worker.until("marks front  part")
    newest_ns = max((result.captured_ns for result in found.after(0)), default=0)
    eventually(lambda: found.pids(newest_ns) == {one.pid for one in workers}, "all work")


@pytest.mark.parametrize(
    ("number", "limit_s"), [(signal.SIGKILL, WITHIN_S), (signal.SIGSTOP, 2.5)], ids=["killed", "stopped"]
)
def test_a_dead_workers_share_goes_to_the_others(
    proxy: Callable[..., Process], start: Callable[..., Process], number: signal.Signals, limit_s: float
) -> None:
    proxy(f"sim://?world=empty&cameras=front&fps={FPS}")
    with skyloop.connect("alpha", access="observe") as drone, collecting(drone) as found:
        workers = work(start, 3)
        until_shared(found, workers)
        begin_ns = drone.feedback().captured_ns
        workers[0].signal(number)
        eventually(lambda: whole_since(found, begin_ns) is not None, "each frame has a result again")
        whole_ns = whole_since(found, begin_ns)
        assert whole_ns is not None
        took_s = (whole_ns - begin_ns) / 1e9
        print(f"{number.name}: the frames of the gone worker are done by others after {took_s * 1e3:.0f} ms")
        assert took_s < limit_s
        assert found.pids(whole_ns) <= {one.pid for one in workers[1:]}
        if number is signal.SIGSTOP:
            workers[0].signal(signal.SIGCONT)
            newest_ns = drone.feedback().captured_ns
            eventually(lambda: workers[0].pid in found.pids(newest_ns), "it works again")


def test_workers_outlive_their_proxy(proxy: Callable[..., Process], start: Callable[..., Process]) -> None:
    uri = f"sim://?world=empty&cameras=front&fps={FPS}"
    first = proxy(uri)
    with skyloop.connect("alpha", access="observe") as drone, collecting(drone) as found:
        workers = work(start, 2)
        until_shared(found, workers)
        first.signal(signal.SIGKILL)
        first.wait()
        proxy(uri)
        drone.wait(lambda _: drone.link.application is LinkState.UP, 10.0)
        again_ns = drone.feedback().captured_ns
        eventually(lambda: found.pids(again_ns) == {one.pid for one in workers}, "both work again")
