"""Events for the state bits: one per change, with the reasons."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import EventKind, Severity
from skyloop.vehicles.ardrone.telemetry import ArdroneHealth, emergency_reason
from skyloop.vehicles.ardrone.wire.navdata import State

BITS = st.integers(0, 2**32 - 1).map(State)
EVERY = State(0xFFFFFFFF)


@pytest.mark.parametrize(
    ("bits", "reason"),
    [
        (State.CUTOUT, "cutout"),
        (State.ANGLES_OUT_OF_RANGE, "angles"),
        (State.MOTORS_PROBLEM, "motors"),
        (State.USER_EMERGENCY, "user"),
        (State.ULTRASOUND_DEAF, "ultrasound"),
        (State.BATTERY_LOW, "battery"),
        (State.ANGLES_OUT_OF_RANGE | State.CUTOUT, "angles,cutout"),
        (State(0), "unknown"),
    ],
)
def test_an_emergency_and_its_reason(bits: State, reason: str) -> None:
    health = ArdroneHealth()
    health.changes(State.FLYING)
    first = health.changes(State.EMERGENCY | bits)[0]
    assert (first.kind, first.severity, first.data) == (EventKind.EMERGENCY, Severity.ERROR, {"reason": reason})
    assert reason in first.text
    assert emergency_reason(bits) == reason


def test_the_end_of_an_emergency() -> None:
    health = ArdroneHealth()
    health.changes(State.EMERGENCY)
    (notice,) = health.changes(State(0))
    assert (notice.kind, notice.data) == (EventKind.VEHICLE_MESSAGE, {"reason": "reset"})


@pytest.mark.parametrize(
    ("bit", "reason"),
    [
        (State.COMMUNICATION_LOST, "communication_lost"),
        (State.BATTERY_LOW, "battery_low"),
        (State.ULTRASOUND_DEAF, "ultrasound"),
        (State.MOTORS_PROBLEM, "motors"),
        (State.CUTOUT, "cutout"),
    ],
)
def test_a_condition_begins_and_ends(bit: State, reason: str) -> None:
    health = ArdroneHealth()
    (begun,) = health.changes(bit)
    assert begun.severity is not Severity.INFO
    assert begun.data == {"reason": reason, "active": True}
    assert health.changes(bit) == []
    (ended,) = health.changes(State(0))
    assert (ended.severity, ended.data) == (Severity.INFO, {"reason": reason, "active": False})


def test_a_healthy_flight_emits_no_events() -> None:
    health = ArdroneHealth()
    for state in (State.BOOTSTRAP, State.DEMO, State.DEMO | State.FLYING, State.COMMUNICATION_WATCHDOG, State(0)):
        assert health.changes(state) == []


@given(st.lists(BITS, max_size=10))
def test_each_change_is_reported_once(states: list[State]) -> None:
    health = ArdroneHealth()
    active: set[object] = set()
    for state in states:
        for notice in health.changes(state):
            if "active" in notice.data:
                reason = notice.data["reason"]
                assert (reason in active) is not notice.data["active"]
                active ^= {reason}
        assert health.changes(state) == []


def test_every_bit_may_be_set() -> None:
    assert len(ArdroneHealth().changes(EVERY)) > 5
