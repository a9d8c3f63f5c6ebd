"""Units of a host: watchdog, ticker, workers."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from itertools import pairwise
from typing import cast

from skyloop.host.own_process import FIRST_PAUSE_S, LONGEST_PAUSE_S, pause_s
from skyloop.host.threads import (
    CHECK_S,
    HANG_CHECKS,
    IDLE_THREADS,
    MAX_THREADS,
    STALL_CHECKS,
    WHOLE_ROUNDS,
    RequestWorkers,
    SharedLoop,
    Ticker,
    Watchdog,
)
from skyloop.proxy import Proxy
from skyloop.transport.testing import wait_until
from tests.support.proxy_bench import Bench


@dataclass(eq=False)
class Loop:
    inside: object = None
    entries: int = 0
    empty: bool = False

    def close(self) -> None: ...


class Watched:
    """A watchdog with a manual clock."""

    def __init__(self) -> None:
        self.loop = Loop()
        self.loops: list[SharedLoop] = [self.loop]
        self.stalls: list[object] = []
        self.hangs: list[object] = []
        self.now_s = 100.0
        self.watchdog = Watchdog(
            lambda: self.loops,
            lambda _, inside: self.stalls.append(inside),
            lambda _, inside: self.hangs.append(inside),
        )
        self.check(2)

    def check(self, times: int = 1, apart_s: float = CHECK_S) -> None:
        for _ in range(times):
            self.now_s += apart_s
            self.watchdog.check(self.now_s)


def test_a_call_that_does_not_return_is_reported_twice() -> None:
    watched = Watched()
    watched.loop.inside, watched.loop.entries = "x", 7
    watched.check(STALL_CHECKS)
    assert watched.stalls == []
    watched.check()
    assert watched.stalls == ["x"]
    watched.check(HANG_CHECKS - STALL_CHECKS - 1)
    assert watched.hangs == []
    watched.check(5)
    assert (watched.stalls, watched.hangs) == (["x"], ["x"])


def test_calls_that_return_are_never_a_stall() -> None:
    watched = Watched()
    for number in range(3 * HANG_CHECKS):
        watched.loop.inside, watched.loop.entries = "x", number
        watched.check()
    watched.loop.inside = None
    watched.check(3 * HANG_CHECKS)
    assert watched.stalls == watched.hangs == []


def test_a_suspended_process_has_no_stall() -> None:
    """The check is late: the loop had no more time than the watchdog."""
    watched = Watched()
    watched.loop.inside, watched.loop.entries = "x", 1
    watched.check(3 * HANG_CHECKS, apart_s=10.0)
    assert watched.stalls == watched.hangs == []


def test_each_stalling_call_is_reported() -> None:
    watched = Watched()
    for number, inside in enumerate("xy"):
        watched.loop.inside, watched.loop.entries = inside, number + 1
        watched.check(STALL_CHECKS + 2)
    assert watched.stalls == ["x", "y"]


def test_handling_a_stall_may_fail() -> None:
    loop = Loop("x", 1)
    hangs: list[object] = []

    def fail(*_: object) -> None:
        raise RuntimeError("on purpose")

    watchdog = Watchdog(lambda: [loop], fail, lambda _, inside: hangs.append(inside))
    for number in range(HANG_CHECKS + 5):
        watchdog.check(1.0 + number * CHECK_S)
    assert hangs == ["x"]


def test_a_split_ticker_keeps_its_one_proxy() -> None:
    ticks: dict[str, list[str]] = {"one": [], "two": []}
    with Bench() as one, Bench() as two:
        for name, bench in (("one", one), ("two", two)):
            bench.proxy.tick = lambda _, name=name: ticks[name].append(threading.current_thread().name)  # type: ignore[method-assign,misc]
        ticker = Ticker(lambda *_: None, [one.proxy, two.proxy])
        wait_until(lambda: all(map(len, ticks.values())), "both are ticked")
        new = ticker.split(one.proxy)
        assert not ticker.remove(two.proxy)
        counts = {name: len(found) for name, found in ticks.items()}
        wait_until(lambda: all(len(ticks[name]) > counts[name] + 2 for name in ticks), "both still are")
        assert new.remove(two.proxy)
        new.close()
        count = len(ticks["two"])
        wait_until(lambda: len(ticks["one"]) > counts["one"] + 10, "the other one continues")
        assert len(ticks["two"]) == count
        ticker.close()


class Ticked:
    """Stands in for a proxy, and records its ticks."""

    name = "ticked"

    def __init__(self, *, at_rest: bool) -> None:
        self.at_rest = at_rest
        self.ticks: list[str] = []

    def clock(self) -> int:
        return 0

    def tick(self, _: int) -> None:
        self.ticks.append("whole")

    def tick_flight(self, _: int) -> None:
        self.ticks.append("flight")


def test_a_resting_vehicle_gets_a_fifth_of_a_flying_ones_ticks() -> None:
    flies, rests = Ticked(at_rest=False), Ticked(at_rest=True)
    ticker = Ticker(lambda *_: None, cast(list[Proxy], [flies, rests]))
    wait_until(lambda: len(flies.ticks) >= 4 * WHOLE_ROUNDS, "each had four rounds")
    ticker.close()
    whole = [number for number, tick in enumerate(flies.ticks) if tick == "whole"]
    assert [later - number for number, later in pairwise(whole)] == [WHOLE_ROUNDS] * (len(whole) - 1)
    assert set(rests.ticks) == {"whole"}
    assert abs(len(rests.ticks) - len(whole)) <= 1


def test_a_resting_vehicle_gets_all_ticks_as_soon_as_a_pilot_takes_it() -> None:
    rests = Ticked(at_rest=True)
    ticker = Ticker(lambda *_: None, cast(list[Proxy], [rests]))
    wait_until(lambda: bool(rests.ticks), "it is ticked")
    rests.at_rest = False
    wait_until(lambda: rests.ticks.count("flight") >= WHOLE_ROUNDS, "it is ticked in each round")
    ticker.close()


def test_a_queues_jobs_run_in_order_one_at_a_time() -> None:
    workers = RequestWorkers()
    queues = [workers.queue() for _ in range(5)]
    done: list[tuple[int, int]] = []
    inside = [0] * len(queues)

    def job(queue: int, number: int) -> None:
        inside[queue] += 1
        assert inside[queue] == 1
        done.append((queue, number))
        inside[queue] -= 1

    for number in range(50):
        for index, queue in enumerate(queues):
            queue.put(lambda index=index, number=number: job(index, number))  # type: ignore[misc]
    wait_until(lambda: len(done) == 250, "all are done")
    for index in range(len(queues)):
        assert [number for queue, number in done if queue == index] == list(range(50))
    workers.close()


def test_a_hanging_queue_delays_no_other_and_stops_in_time() -> None:
    workers = RequestWorkers()
    gate, reached = threading.Event(), threading.Event()
    stuck, other = workers.queue(), workers.queue()
    for queue in (stuck, other):
        queue.start()
    stuck.put(lambda: (reached.set(), gate.wait(30.0))[0])  # type: ignore[func-returns-value]
    assert reached.wait(10.0)
    stuck.put(lambda: reached.clear())
    done = threading.Event()
    other.put(done.set)
    assert done.wait(10.0)
    stuck.stop(0.01)
    stuck.put(lambda: reached.clear())
    gate.set()
    other.stop(1.0)
    workers.close()
    assert reached.is_set(), "the waiting job was dropped"


def test_the_threads_end() -> None:
    workers = RequestWorkers()
    gate = threading.Event()
    others = set(threading.enumerate())
    for _ in range(2 * MAX_THREADS):
        workers.queue().put(lambda: (gate.wait(30.0), None)[1])
    before = [thread for thread in threading.enumerate() if thread not in others]
    assert len(before) <= MAX_THREADS
    gate.set()
    workers.close()
    wait_until(lambda: not [t for t in before if t.is_alive()], "they end")
    assert IDLE_THREADS < MAX_THREADS


def test_pauses_before_a_restart_grow_up_to_a_limit() -> None:
    pauses = [pause_s(deaths) for deaths in range(1, 40)]
    assert pauses[0] == FIRST_PAUSE_S
    assert pauses == sorted(pauses)
    assert pauses[-1] == LONGEST_PAUSE_S
