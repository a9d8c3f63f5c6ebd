"""Results of processors, read from a scripted proxy."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from skyloop.client import Drone, Result
from skyloop.errors import ClosedError, DecodeError, NoAnswerError, UsageError
from skyloop.messages import Feedback
from skyloop.transport.base import RESULTS
from tests.support.scripted_proxy import WAIT_S, ScriptedProxy, Sender, background, flown, scripted


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy, access="observe") as drone:
        yield drone


def until_subscribed(proxy: ScriptedProxy, drone: Drone, topic: str, count: int = 1) -> None:
    drone.wait(lambda _: proxy.server.subscribers(topic) == count, WAIT_S)


def test_the_newest_one(proxy: ScriptedProxy, drone: Drone) -> None:
    sender = Sender(proxy)
    assert drone.result("detector") is None
    until_subscribed(proxy, drone, "results/detector")
    sender.send(3, {"x": 1.5}, age_s=0.04)
    drone.wait(lambda _: drone.result("detector") is not None, WAIT_S)
    result = drone.result("detector")
    assert result is not None
    assert (result.processor, result.worker, result.camera, result.seq) == ("detector", 7, "front", 3)
    assert result.value == {"x": 1.5}
    assert result.made_ns - result.captured_ns == pytest.approx(40_000_000, abs=1000)
    assert result.took_s == 0.02
    assert 0.04 <= result.age_s < WAIT_S
    assert drone.result("detector", max_age_s=0.0) is None
    assert isinstance(result.feedback, Feedback)
    assert "Result of detector for front 3" in repr(result)


def test_iterating_yields_each_newest_and_ends_with_the_drone(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[int] = []
    ends: list[str] = []

    def look() -> None:
        for result in drone.results("detector", timeout_s=WAIT_S):
            got.append(result.seq)
        ends.append("closed")

    thread = background(look)
    until_subscribed(proxy, drone, "results/detector")
    sender = Sender(proxy)
    for seq in (1, 2, 3):
        sender.send(seq)
        drone.wait(lambda _, seq=seq: got[-1:] == [seq], WAIT_S)  # type: ignore[misc]
    drone.close()
    thread.join(WAIT_S)
    assert (got, ends) == ([1, 2, 3], ["closed"])
    with pytest.raises(ClosedError):
        drone.result("detector")


def test_leaving_the_loop_ends_the_subscription(proxy: ScriptedProxy, drone: Drone) -> None:
    def look() -> None:
        for _ in drone.results("detector", timeout_s=WAIT_S):
            return

    thread = background(look)
    until_subscribed(proxy, drone, "results/detector")
    Sender(proxy).send(1)
    thread.join(WAIT_S)
    until_subscribed(proxy, drone, "results/detector", 0)


def test_missing_results_raise_with_a_reason(proxy: ScriptedProxy, drone: Drone) -> None:
    with pytest.raises(
        NoAnswerError, match=r"no result of processor detector arrived within 0\.02 s: does skyloop proc"
    ):
        next(iter(drone.results("detector", timeout_s=0.02)))
    raised: list[str] = []

    def look() -> None:
        try:
            next(iter(drone.results("detector", timeout_s=0.5, max_age_s=1.0)))
        except NoAnswerError as error:
            raised.append(str(error))

    thread = background(look)
    until_subscribed(proxy, drone, "results/detector")
    Sender(proxy).send(1, age_s=2.0)
    thread.join(WAIT_S)
    assert raised == ["no sufficiently new result of detector arrived within 0.5 s; 1 were too old"]
    assert drone.stats["results/detector"].dropped == 1


@pytest.mark.parametrize("name", ["", "a/b", "x" * 65, "ä", 7])
def test_an_invalid_name(drone: Drone, name: Any) -> None:
    with pytest.raises(UsageError, match="the name of a processor must have 1 to 64 letters"):
        drone.result(name)


@pytest.mark.parametrize("age", [-1.0, float("nan"), "1"])
def test_an_invalid_age_limit(drone: Drone, age: Any) -> None:
    with pytest.raises(UsageError, match="max_age_s is"):
        drone.on_result(print, "detector", max_age_s=age)


def test_listeners(proxy: ScriptedProxy, drone: Drone) -> None:
    mine: list[int] = []
    everything: list[tuple[str, int]] = []
    one = drone.on_result(lambda result: mine.append(result.seq), "detector", inline=True, max_age_s=60.0)
    many = drone.on_result(lambda result: everything.append((result.processor, result.seq)))
    until_subscribed(proxy, drone, RESULTS)
    detector, finder = Sender(proxy), Sender(proxy, "finder")
    detector.send(1)
    finder.send(1)
    detector.send(2, age_s=-0.1)
    detector.send(3, age_s=61.0)
    finder.send(2)
    drone.wait(lambda _: len(everything) == 5, WAIT_S)
    assert everything == [("detector", 1), ("finder", 1), ("detector", 2), ("detector", 3), ("finder", 2)]
    assert mine == [1, 2]
    assert (one.delivered, one.expired, one.dropped) == (2, 0, 0)  # the third was overtaken by the second
    detector.send(4, age_s=-0.2)
    drone.wait(lambda _: mine == [1, 2, 4], WAIT_S)
    one.cancel()
    many.cancel()
    until_subscribed(proxy, drone, RESULTS, 0)
    with pytest.raises(UsageError, match="depth is 0 and must be at least 1"):
        drone.on_result(print, "detector", depth=0)
    with pytest.raises(UsageError, match="can't be called"):
        drone.on_result(7)  # type: ignore[arg-type]


def test_results_that_are_too_old_are_skipped_and_counted(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[int] = []
    with drone.on_result(lambda result: got.append(result.seq), "detector", inline=True, max_age_s=5.0) as listener:
        until_subscribed(proxy, drone, "results/detector")
        sender = Sender(proxy)
        sender.send(1, age_s=6.0)
        sender.send(2)
        drone.wait(lambda _: got == [2], WAIT_S)
        assert (listener.expired, listener.dropped) == (1, 1)
        assert drone.stats["results/detector"].dropped == 1


def test_a_busy_listener_gets_the_newest(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[int] = []
    entered, go_on = threading.Event(), threading.Event()

    def slow(result: Result) -> None:
        got.append(result.seq)
        entered.set()
        go_on.wait(WAIT_S)

    listener = drone.on_result(slow, "detector")
    until_subscribed(proxy, drone, "results/detector")
    sender = Sender(proxy)
    sender.send(1)
    assert entered.wait(WAIT_S)
    for seq in (2, 3, 4):
        sender.send(seq)
    drone.wait(lambda _: listener.dropped == 2, WAIT_S)
    go_on.set()
    drone.wait(lambda _: got == [1, 4], WAIT_S)


def test_numbers_show_losses_and_repetitions(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[int] = []
    drone.on_result(lambda result: got.append(result.seq), inline=True)
    drone.result("detector")  # subscribed on both topics: each result arrives twice
    until_subscribed(proxy, drone, RESULTS)
    until_subscribed(proxy, drone, "results/detector")
    a, b = Sender(proxy, worker=1), Sender(proxy, worker=2)
    a.send(1)
    b.send(2)
    a.send(3, number=5)
    b.send(4)
    drone.wait(lambda _: len(got) == 4, WAIT_S)
    assert got == [1, 2, 3, 4]
    stats = drone.stats["results/detector"]
    assert (stats.count, stats.lost, stats.malformed) == (4, 3, 0)
    assert stats.delay_s is not None


def test_after_a_restart_of_the_proxy_numbers_start_over(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[int] = []
    drone.on_result(lambda result: got.append(result.seq), "detector", inline=True)
    until_subscribed(proxy, drone, "results/detector")
    Sender(proxy).send(10, number=100)
    drone.wait(lambda _: got == [10], WAIT_S)
    proxy.stop()
    proxy.start()
    until_subscribed(proxy, drone, "results/detector")
    Sender(proxy).send(1, age_s=3600.0)  # on another clock
    drone.wait(lambda _: got == [10, 1], WAIT_S)


@dataclass
class Box:
    x: float
    corners: NDArray[np.float64]


def test_values_as_types(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.result("detector")
    until_subscribed(proxy, drone, "results/detector")
    Sender(proxy).send(1, [Box(1.0, np.eye(2))])
    drone.wait(lambda _: drone.result("detector") is not None, WAIT_S)
    result = drone.result("detector")
    assert result is not None
    [box] = result.to(list[Box])
    assert box.x == 1.0
    np.testing.assert_array_equal(box.corners, np.eye(2))
    with pytest.raises(DecodeError, match="a result of detector is not a dict"):
        result.to(dict[str, float])


def test_an_invalid_payload_raises_for_its_reader(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.result("detector")
    until_subscribed(proxy, drone, "results/detector")
    Sender(proxy).send(1, payload=b"\xc1")
    drone.wait(lambda _: drone.result("detector") is not None, WAIT_S)
    result = drone.result("detector")
    assert result is not None
    with pytest.raises(DecodeError):
        _ = result.value
