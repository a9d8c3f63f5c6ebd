"""Controllers that receive processors' results."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from skyloop.client import Drone, Result
from skyloop.control import Controller, RunSummary
from skyloop.errors import UsageError
from skyloop.messages import Feedback
from skyloop.transport.base import RESULTS, results
from tests.support.scripted_proxy import WAIT_S, ScriptedProxy, Sender, background, flown, scripted


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy) as drone:
        yield drone


class Noting(Controller):
    """Records the results; ``then`` is called with each."""

    def __init__(self, drone: Drone, then: Callable[[Result], object] = lambda _: None) -> None:
        super().__init__(drone)
        self.got: list[tuple[str, int]] = []
        self.then = then

    def on_result(self, result: Result) -> None:
        self.got.append((result.processor, result.seq))
        self.then(result)


def run(
    proxy: ScriptedProxy, controller: Controller, topic: str, *steps: Callable[[], object], until: Callable[[], bool]
) -> RunSummary:
    """Run it while a thread takes the steps, the first one once the controller listens."""
    drone = controller.drone
    thread = background(lambda: drone.wait(lambda _: proxy.server.subscribers(topic) == 1, WAIT_S), *steps)
    summary = controller.run(WAIT_S, until)
    thread.join(WAIT_S)
    assert summary.reason == "until"
    drone.wait(lambda _: proxy.server.subscribers(topic) == 0, WAIT_S)
    return summary


def test_results_of_all_processors_arrive(proxy: ScriptedProxy, drone: Drone) -> None:
    controller = Noting(drone)
    one, two = Sender(proxy), Sender(proxy, "finder")
    summary = run(
        proxy, controller, RESULTS, lambda: (one.send(1), two.send(2)), until=lambda: len(controller.got) == 2
    )
    assert sorted(controller.got) == [("detector", 1), ("finder", 2)]
    assert (summary.results, summary.results_dropped, summary.results_expired, summary.feedback) == (2, 0, 0, 0)
    assert "2 results (0 dropped, 0 too old)" in str(summary)


def test_only_the_named_processors(proxy: ScriptedProxy, drone: Drone) -> None:
    controller = Noting(drone)
    controller.processors = ("finder",)
    one, two = Sender(proxy), Sender(proxy, "finder")
    run(proxy, controller, results("finder"), lambda: (one.send(1), two.send(2)), until=lambda: bool(controller.got))
    assert controller.got == [("finder", 2)]
    controller.processors = ("a b",)
    with pytest.raises(UsageError, match="name of a processor"):
        controller.run(0.0)


def test_one_slot_per_processor_and_the_newest_wins(proxy: ScriptedProxy, drone: Drone) -> None:
    one, two = Sender(proxy), Sender(proxy, "finder")

    def busy(result: Result) -> None:
        if result.seq == 1:
            for seq in (2, 3, 4):
                one.send(seq)
            two.send(5)
            two.send(6)
            newest = drone._state.results.channel("finder")
            drone.wait(lambda _: newest.newest is not None and newest.newest.seq == 6, WAIT_S)

    controller = Noting(drone, busy)
    summary = run(proxy, controller, RESULTS, lambda: one.send(1), until=lambda: len(controller.got) == 3)
    assert controller.got == [("detector", 1), ("detector", 4), ("finder", 6)]
    assert (summary.results, summary.results_dropped, summary.overruns) == (3, 3, 1)


def test_old_and_overtaken_results_are_not_flown_by(proxy: ScriptedProxy, drone: Drone) -> None:
    sender = Sender(proxy)

    def late(result: Result) -> None:
        if result.seq == 2:
            sender.send(1, age_s=0.5)  # of an earlier frame
            sender.send(3, age_s=-0.1)

    controller = Noting(drone, late)
    steps = (lambda: sender.send(0, age_s=2.0), lambda: sender.send(2))
    summary = run(proxy, controller, RESULTS, *steps, until=lambda: ("detector", 3) in controller.got)
    assert controller.got == [("detector", 2), ("detector", 3)]
    assert summary.results_expired + summary.results_dropped == 1  # the first one, depending on timing
    assert drone.stats["results/detector"].dropped == 1  # the overtaken one; the other was this controller's own limit


def test_a_controller_for_results_and_feedback(proxy: ScriptedProxy, drone: Drone) -> None:
    class Both(Noting):
        samples = 0

        def on_feedback(self, feedback: Feedback) -> None:
            self.samples += 1

    controller = Both(drone)
    sender = Sender(proxy)
    summary = run(
        proxy,
        controller,
        RESULTS,
        lambda: sender.send(1),
        until=lambda: bool(controller.got) and controller.samples > 2,
    )
    assert (summary.results, summary.feedback) == (1, controller.samples)
    began = time.monotonic()
    assert controller.run(0.05).reason == "time"
    assert time.monotonic() - began >= 0.05
