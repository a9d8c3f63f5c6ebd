"""The emergency stop that all drivers share: its pace, its end, and its reset."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import nanoseconds
from skyloop.drivers.vehicle_session import GIVE_UP_NS, PACE_NS, SETTLE_NS, MotorStop, VehicleEvent
from skyloop.errors import DriverError

TICK_NS = nanoseconds(0.02)
BEGUN_NS = nanoseconds(100.0)


class Press:
    """A stop that was just pressed, with a clock. ``sent``: times when it was sent [ns since the press]."""

    def __init__(self) -> None:
        self.events: list[VehicleEvent] = []
        self.stop = MotorStop(self.events.append)
        self.now_ns = BEGUN_NS
        self.sent: list[int] = []
        self.stop.press(self.now_ns)

    def run(self, span_ns: int, shown: bool | None = None) -> None:
        until_ns = self.now_ns + span_ns
        while self.now_ns < until_ns:
            if self.stop.step(shown, self.now_ns):
                self.sent.append(self.now_ns - BEGUN_NS)
            self.now_ns += TICK_NS


@pytest.mark.parametrize("shown", [None, False])
def test_a_stop_is_sent_at_once_and_steadily_until_it_is_abandoned(shown: bool | None) -> None:
    press = Press()
    press.run(2 * GIVE_UP_NS, shown)
    assert press.sent[0] == 0
    assert {after - before for before, after in pairwise(press.sent)} == {PACE_NS}
    assert GIVE_UP_NS - PACE_NS <= press.sent[-1] < GIVE_UP_NS
    assert not press.stop.active
    (event,) = press.events
    assert event.data["reason"] == "stop_given_up"
    assert "has not shown it for 10 s" in event.text


def test_a_shown_stop_ends_the_sending_and_lasts_until_the_reset() -> None:
    press = Press()
    press.run(SETTLE_NS)
    sent = len(press.sent)
    press.run(3 * GIVE_UP_NS, shown=True)
    press.run(3 * GIVE_UP_NS, shown=None)  # the link is lost: the vehicle's last state stays
    assert (len(press.sent), press.stop.active, press.events) == (sent, True, [])
    press.stop.reset()
    assert not press.stop.active
    press.run(GIVE_UP_NS)
    assert len(press.sent) == sent


def test_no_reset_before_it_is_shown() -> None:
    press = Press()
    for shown in (None, False):
        press.run(TICK_NS, shown)
        assert not press.stop.shown
        with pytest.raises(DriverError, match="has not shown"):
            press.stop.reset()
        assert press.stop.active
    press.run(TICK_NS, shown=True)
    assert press.stop.shown
    press.stop.reset()
    assert not press.stop.shown
    press.stop.reset()  # a reset without a stop is not an error


def test_motors_that_restart_soon_are_stopped_again_but_not_later() -> None:
    press = Press()
    press.run(nanoseconds(1.0), shown=True)
    assert not press.sent
    press.run(nanoseconds(1.0), shown=False)
    assert len(press.sent) == 10
    press.run(GIVE_UP_NS, shown=True)
    press.run(TICK_NS, shown=False)
    assert len(press.sent) == 10
    assert not press.stop.active
    assert "motors again" in press.events[0].text


def test_another_press_restarts_the_time_limit_and_keeps_the_pace() -> None:
    press = Press()
    for _ in range(30):
        press.run(nanoseconds(0.5))
        press.stop.press(press.now_ns)
    assert press.stop.active
    assert {after - before for before, after in pairwise(press.sent)} == {PACE_NS}
    press.run(GIVE_UP_NS + TICK_NS)
    assert not press.stop.active


def test_repeats_of_a_press_neither_extend_it_nor_delay_its_confirmation() -> None:
    """The library repeats the stop 32 times a second until it shows."""
    press = Press()
    while press.now_ns < BEGUN_NS + nanoseconds(8.0):
        press.run(nanoseconds(0.04))
        press.stop.press(press.now_ns)
    assert press.stop.settled(BEGUN_NS + SETTLE_NS)
    press.run(nanoseconds(2.1))
    assert not press.stop.active
    press.stop.press(press.now_ns)
    assert press.stop.step(None, press.now_ns), "an abandoned stop can be pressed again at once"


def test_reports_around_the_press_may_be_from_before_it() -> None:
    stop = Press().stop
    assert [stop.settled(BEGUN_NS + span_ns) for span_ns in (-1, 0, SETTLE_NS - 1, SETTLE_NS)] == [False] * 3 + [True]
    stop = MotorStop(lambda _: None)
    assert not stop.settled(BEGUN_NS)


@given(st.lists(st.sampled_from([None, False, True]), max_size=80))
def test_a_stop_is_never_sent_late_or_after_it_is_shown(states: list[bool | None]) -> None:
    press = Press()
    known = False
    for shown in states:
        before, known = len(press.sent), known if shown is None else shown
        press.run(nanoseconds(0.2), shown)
        assert len(press.sent) == before or not known
        assert press.stop.active is (not press.events)
    assert all(sent < GIVE_UP_NS for sent in press.sent)
