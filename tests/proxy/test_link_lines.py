"""A proxy process's lines about its vehicle link."""

from __future__ import annotations

from skyloop.clock import nanoseconds
from skyloop.errors import shortened
from skyloop.messages import EventKind, LinkState
from skyloop.proxy.serve import GRACE_NS, LinkLines
from tests.support.proxy_bench import Bench

WAITING = (LinkState.CONNECTING, "waiting for it", "plug it in")
LOST = (LinkState.LOST, "no heartbeat", "plug it in")
UP = (LinkState.UP, "", "")


def test_a_vehicle_that_answers_at_once_is_ready_without_further_lines() -> None:
    lines = LinkLines("alpha", "sim:// at here", 0)
    assert lines.first(LinkState.UP) == "ready alpha: sim:// at here"
    assert lines.changed(*UP, nanoseconds(5)) == ""


def test_an_absent_vehicle_is_not_ready_until_it_answers() -> None:
    lines = LinkLines("alpha", "tello://x at here", 0)
    assert lines.first(LinkState.CONNECTING) == "serving alpha: tello://x at here"
    assert lines.changed(*WAITING, GRACE_NS - 1) == "", "most vehicles answer within a moment"
    assert lines.changed(*WAITING, GRACE_NS) == "vehicle of alpha: connecting: waiting for it\n  → plug it in"
    assert lines.changed(*WAITING, 2 * GRACE_NS) == "", "it is printed once"
    assert lines.changed(*LOST, 2 * GRACE_NS) == "vehicle of alpha: lost: no heartbeat\n  → plug it in"
    other = (LinkState.LOST, "may not open it", "join the group")
    assert lines.changed(*other, 2 * GRACE_NS) == "vehicle of alpha: lost: may not open it\n  → join the group"
    assert lines.changed(*UP, 2 * GRACE_NS) == "ready alpha: tello://x at here"


def test_loss_and_return_are_printed() -> None:
    lines = LinkLines("alpha", "x", 0)
    lines.first(LinkState.UP)
    assert lines.changed(*LOST, 1) == "vehicle of alpha: lost: no heartbeat\n  → plug it in"
    assert lines.changed(*UP, 2) == "vehicle of alpha: up"
    assert lines.changed(LinkState.LOST, "", "", 3) == "vehicle of alpha: lost"


def test_the_reason_of_a_link_is_in_feedback_and_events_and_cut_if_long(bench: Bench) -> None:
    pilot, sink = bench.pilot(), bench.proxy.publisher
    sink.link(LinkState.LOST, "no such port", "plug it in")
    sink.link(LinkState.LOST, "no such port", "plug it in")
    sink.link(LinkState.LOST, "r" * 10_000, "m" * 10_000)
    bench.tick()
    first, second = [event for event in pilot.told(EventKind.VEHICLE_LINK) if event.data["state"] == "lost"]
    assert (first.data["reason"], first.data["remedy"]) == ("no such port", "plug it in")
    assert first.text == "link to the vehicle: up → lost (no such port): plug it in"
    assert second.text.startswith("link to the vehicle: lost (rrr")
    feedback = pilot.last_feedback()
    assert (feedback.link_reason, feedback.link_remedy) == (shortened("r" * 10_000, 300), shortened("m" * 10_000, 300))
    assert sink.link_breaks == 1, "another reason is not another loss"
    sink.link(LinkState.UP)
    bench.tick()
    assert pilot.last_feedback().link_reason == ""
