"""The emulated Tello's manoeuvres, driven by reports of chosen times."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from skyloop.messages import FlightState, Takeoff
from skyloop.vehicles.tello.emulator.logic import OK, RISES_WITHIN_S, SPIN_UP_S, TAKEOFF_ANSWER_S, Rising


def at(time_s: float, state: FlightState = FlightState.LANDED) -> Any:
    return SimpleNamespace(truth=SimpleNamespace(time_s=time_s, state=state))


def test_a_take_off_with_a_late_step_is_not_refused() -> None:
    rising = Rising(at(0.0))
    assert rising.step(at(SPIN_UP_S / 2)) == (None, None)
    late_s = SPIN_UP_S + 3 * RISES_WITHIN_S  # the machine was busy
    assert rising.step(at(late_s)) == (Takeoff(), None)
    assert rising.step(at(late_s + 0.02)) == (None, None), "it has had no time to rise yet"
    assert rising.step(at(late_s + 0.1, FlightState.TAKING_OFF)) == (None, None)
    assert rising.step(at(TAKEOFF_ANSWER_S, FlightState.HOVERING)) == (None, OK)


def test_a_take_off_that_stays_on_the_ground_is_an_error() -> None:
    rising = Rising(at(0.0))
    assert rising.step(at(SPIN_UP_S)) == (Takeoff(), None)
    assert rising.step(at(SPIN_UP_S + RISES_WITHIN_S)) == (None, None)
    assert rising.step(at(SPIN_UP_S + RISES_WITHIN_S + 0.01)) == (None, "error")
