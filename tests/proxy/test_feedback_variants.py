"""Feedback in the variants that subscribers request: no more than requested, encoded once, bounded in number."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from skyloop.messages import EventKind, Feedback, Role, encode
from skyloop.proxy import topics
from skyloop.proxy.topics import MAX_VARIANTS
from skyloop.transport.base import FEEDBACK
from tests.support.proxy_bench import App, Bench

SLOW = "feedback?max_hz=4"


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as bench:
        yield bench


def watcher(bench: Bench, topic: str, name: str = "watcher") -> App:
    app = bench.join(name, Role.OBSERVER)
    app.end.subscribe(FEEDBACK, False)
    app.end.subscribe(topic)
    app.sync()
    app.feedback.clear()
    return app


def fly(bench: Bench, seconds: float, hz: float = 32.0) -> None:
    for _ in range(round(seconds * hz)):
        bench.clock.advance(1.0 / hz)
        bench.driver.report()
        bench.proxy.publisher.keep_alive(bench.clock())


def test_no_more_samples_than_requested(bench: Bench) -> None:
    app, whole = watcher(bench, SLOW), bench.join("whole")
    bench.driver.report()
    before = whole.last_feedback().seq
    app.sync()
    app.feedback.clear()
    fly(bench, 5.0)
    last = whole.last_feedback()
    app.sync()
    assert last.seq - before == 160
    assert 19 <= len(app.feedback) <= 21
    assert {(sample.battery, sample.altitude_m) for sample in app.feedback} == {(0.9, 1.0)}
    assert last.altitude_m == 1.0
    assert last.skipped == 0
    for one, other in zip(app.feedback, app.feedback[1:], strict=False):
        assert other.seq - one.seq - 1 == other.skipped
        assert other.published_ns - one.published_ns >= 0.9 * 0.25e9


def test_authority_and_failsafe_come_with_every_form(bench: Bench) -> None:
    app = watcher(bench, "feedback?max_hz=10")
    pilot = bench.airborne("ann")
    fly(bench, 0.5)
    newest = app.last_feedback()
    assert (newest.owner, newest.lease) == ("ann", pilot.lease)
    assert newest.state is pilot.last_feedback().state


def test_a_silent_vehicle_is_still_reported(bench: Bench) -> None:
    app = watcher(bench, "feedback?max_hz=2")
    bench.run(3.0)
    app.sync()
    assert 5 <= len(app.feedback) <= 7


def test_a_form_is_encoded_once_for_all_its_subscribers(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    apps = [watcher(bench, SLOW, name) for name in ("a", "b", "c")]
    encoded: list[Feedback] = []

    def counted(sample: Feedback) -> bytes:
        encoded.append(sample)
        return encode(sample)

    monkeypatch.setattr(topics, "encode", counted)
    fly(bench, 1.0)
    for app in apps:
        app.sync()
    assert len(encoded) == len(apps[0].feedback) == len(apps[2].feedback) > 2
    for app in apps:
        app.end.subscribe(SLOW, False)
    encoded.clear()
    fly(bench, 1.0)
    assert not encoded, "without subscribers, nothing is encoded"


def test_native_telemetry_that_cannot_be_sent_is_left_out(bench: Bench) -> None:
    app = watcher(bench, "feedback?max_hz=10")
    bench.clock.advance(1.0)
    bench.driver.report(native={"huge": "x" * 70_000})
    assert app.last_feedback().native is None


def test_forms_are_bounded_and_released_when_unused(bench: Bench) -> None:
    app = bench.join("greedy", Role.OBSERVER)
    for number in range(1, MAX_VARIANTS + 1):
        app.end.subscribe(f"feedback?max_hz={number}")
    app.sync()
    late, one_more = bench.join("late", Role.OBSERVER), "feedback?max_hz=0.5"
    late.end.subscribe(one_more)
    late.sync()
    (told,) = late.told(EventKind.PACKET_MALFORMED)
    assert f"at most {MAX_VARIANTS} variants" in told.text
    late.end.subscribe("feedback?max_hz=3")  # a form already in use is available to all
    late.sync()
    assert len(late.told(EventKind.PACKET_MALFORMED)) == 1
    app.end.close()
    bench.apps.remove(app)
    bench.clock.advance(6.0)
    bench.driver.report()
    late.end.subscribe(one_more)
    late.sync()
    assert len(bench.proxy.publisher.variants.known) == 2
    late.feedback.clear()
    bench.clock.advance(1.0)
    bench.driver.report()
    late.sync()
    numbers = [sample.seq for sample in late.feedback]
    assert len(numbers) > len(set(numbers)), "once on the plain topic, and once in the form"


def test_a_nonsensical_request_counts_as_malformed(bench: Bench) -> None:
    app = watcher(bench, "feedback?max_hz=nan")
    (told,) = app.told(EventKind.PACKET_MALFORMED)
    assert "max_hz is nan and must be from" in told.text
    assert bench.proxy.publisher.variants.known == ()
