"""Code that is kept warm: on one thread, while somebody wants it, and never at the cost of anything else."""

from __future__ import annotations

import itertools
import queue
import threading

import pytest

from skyloop.transport.testing import wait_until
from skyloop.warmth import LOOK_S, Pieces, Warmer


class Pace:
    """A sleep that lasts until the test lets it go on."""

    def __init__(self) -> None:
        self.slept: queue.Queue[float] = queue.Queue()
        self._turn: queue.Queue[None] = queue.Queue()

    def sleep(self, seconds: float) -> None:
        if not seconds:
            return  # between two pieces
        self.slept.put(seconds)
        self._turn.get(timeout=10.0)

    def go_on(self) -> None:
        self._turn.put(None)


def always(_now_s: float) -> bool:
    return True


def warm_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == "skyloop-warm-test"]


def test_it_runs_while_somebody_wants_it_as_often_as_the_one_who_wants_it_most() -> None:
    pace, runs = Pace(), list[int]()
    warmer = Warmer(lambda: [lambda: runs.append(1)], "test", sleep=pace.sleep, clock=lambda: 0.0, spare=always)
    assert not warmer.active
    assert warm_threads() == []
    warmer.keep("one", 0.005)
    assert pace.slept.get(timeout=10.0) == 0.005
    assert (warmer.active, len(runs), warm_threads()) == (True, 1, ["skyloop-warm-test"])
    warmer.keep("one", 0.005)  # nothing changes
    warmer.keep("two", 0.002)
    pace.go_on()
    assert pace.slept.get(timeout=10.0) == 0.002
    warmer.keep("two", 0.0)
    pace.go_on()
    assert pace.slept.get(timeout=10.0) == 0.005
    assert len(runs) == 3
    warmer.keep("one", 0.0)
    assert not warmer.active
    pace.go_on()
    wait_until(lambda: not warm_threads(), "the thread has ended")
    assert len(runs) == 3
    warmer.keep("three", 0.004)
    assert pace.slept.get(timeout=10.0) == 0.004
    warmer.keep("three", 0.0)
    pace.go_on()
    wait_until(lambda: not warm_threads(), "the second thread has ended")


def test_what_it_runs_is_made_once_and_not_before_it_is_wanted() -> None:
    pace, made = Pace(), list[str]()

    def make() -> Pieces:
        made.append(threading.current_thread().name)
        return (lambda: None,)

    warmer = Warmer(make, "test", sleep=pace.sleep, clock=lambda: 0.0, spare=always)
    assert made == []
    for _ in range(2):
        warmer.keep("one", 0.005)
        pace.slept.get(timeout=10.0)
        warmer.keep("one", 0.0)
        pace.go_on()
        wait_until(lambda: not warm_threads(), "the thread has ended")
    assert made == ["skyloop-warm-test"]


def test_code_that_fails_is_given_up_and_told_once(caplog: pytest.LogCaptureFixture) -> None:
    pace = Pace()

    def broken() -> None:
        raise RuntimeError("as bad as can be")

    warmer = Warmer(lambda: [broken], "test", sleep=pace.sleep, clock=lambda: 0.0, spare=always)
    warmer.keep("one", 0.005)
    wait_until(lambda: "is given up" in caplog.text and not warm_threads(), "it was given up")
    assert not warmer.active
    warmer.keep("one", 0.005)  # its drone asks twenty times a second
    assert not warmer.active
    assert warm_threads() == []
    assert caplog.text.count("is given up") == 1


def test_where_the_processor_is_busy_it_runs_ever_more_rarely_and_comes_back() -> None:
    now_s, late_s = 0.0, 0.0
    slept: list[float] = []
    ended = threading.Event()

    def sleep(seconds: float) -> None:
        nonlocal now_s, late_s
        if not seconds:
            return
        slept.append(seconds)
        late_s = 0.01 if len(slept) <= 10 else 0.0
        now_s += seconds + late_s
        if len(slept) == 30:
            warmer.keep("one", 0.0)
            ended.set()

    warmer = Warmer(lambda: [lambda: None], "test", sleep=sleep, clock=lambda: now_s, spare=always)
    warmer.keep("one", 0.005)
    assert ended.wait(10.0)
    assert slept[:5] == pytest.approx([0.005, 0.01, 0.02, 0.04, 0.08])
    assert slept[9] == slept[10] == 1.0
    assert slept[11:14] == pytest.approx([0.5, 0.25, 0.125])
    assert slept[-1] == pytest.approx(0.005)


def test_it_pauses_while_the_computer_has_no_processor_to_spare_and_goes_on_by_itself() -> None:
    now_s, runs = 0.0, list[float]()
    slept: list[float] = []
    ended = threading.Event()

    def sleep(seconds: float) -> None:
        nonlocal now_s
        slept.append(seconds)
        now_s += seconds
        if now_s > 5.0 and seconds:
            warmer.keep("one", 0.0)
            ended.set()

    asked: list[float] = []

    def spare(at_s: float) -> bool:
        asked.append(at_s)
        return not 1.0 <= at_s < 3.0

    warmer = Warmer(lambda: [lambda: runs.append(now_s)], "test", sleep=sleep, clock=lambda: now_s, spare=spare)
    warmer.keep("one", 0.1)
    assert ended.wait(10.0)
    assert not [at_s for at_s in runs if 1.1 < at_s < 3.0]
    assert len([at_s for at_s in runs if at_s < 1.1]) >= 9
    assert len([at_s for at_s in runs if at_s > 3.0]) >= 15
    assert min(later - before for before, later in itertools.pairwise(asked)) > LOOK_S - 0.001
    assert len(asked) <= 11
