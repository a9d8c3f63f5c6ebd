"""The phase of flight from the drone's state alone."""

from __future__ import annotations

import pytest

from skyloop.clock import nanoseconds
from skyloop.messages import FlightState
from skyloop.vehicles.tello.options import VelocityAxes
from skyloop.vehicles.tello.telemetry import FlightWatch, height_m, velocity_m_s
from skyloop.vehicles.tello.wire import TelloState

PERIOD_S = 0.1


class Film:
    """States ten times a second, given as a table: readings and their duration."""

    def __init__(self) -> None:
        self.watch = FlightWatch()
        self._frames = 1000

    def show(self, seconds: float, *, tof: float | None = 10, h: float = 0, motors: bool = False) -> FlightState:
        for _ in range(round(seconds / PERIOD_S)):
            self._frames += 1
            self._motor_s = self._frames * PERIOD_S if motors else getattr(self, "_motor_s", 5.0)
            state = TelloState(distance_cm=tof, height_cm=h, motor_s=int(self._motor_s), speed_dm_s=(0, 0, 0))
            self.watch.update(state, nanoseconds(self._frames * PERIOD_S))
        return self.watch.phase


def test_a_landed_drone_is_recognised_at_once() -> None:
    assert Film().show(0.1) is FlightState.LANDED


def test_a_drone_found_in_the_air_is_recognised_within_two_seconds() -> None:
    film = Film()
    assert film.show(0.2, tof=90, h=80, motors=True) is FlightState.UNKNOWN
    assert film.show(1.5, tof=90, h=80, motors=True) is FlightState.HOVERING


def test_a_drone_held_in_a_hand_is_not_flying() -> None:
    film = Film()
    assert film.show(0.5, tof=120, h=0) is FlightState.UNKNOWN
    assert film.show(2.0, tof=120, h=0) is FlightState.LANDED
    film.show(2.0)
    assert film.show(3.0, tof=120, h=100) is FlightState.LANDED


def test_a_take_off_and_a_landing() -> None:
    film = Film()
    film.show(3.0)
    film.watch.rising = True
    assert film.show(1.0, motors=True) in (FlightState.LANDED, FlightState.TAKING_OFF)
    assert film.show(0.3, tof=30, h=20, motors=True) is FlightState.TAKING_OFF
    assert film.show(0.2, tof=80, h=80, motors=True) is FlightState.TAKING_OFF
    assert film.show(0.3, tof=80, h=80, motors=True) is FlightState.HOVERING
    film.watch.rising, film.watch.sinking = False, True
    assert film.show(1.0, tof=40, h=30, motors=True) is FlightState.LANDING
    assert film.show(0.5, tof=10, h=-60, motors=True) is FlightState.LANDING
    assert film.show(2.0, tof=10, h=-60) is FlightState.LANDED


def test_an_answer_reports_the_landing_before_the_motors_are_seen_to_stop() -> None:
    film = Film()
    film.show(3.0, tof=80, h=80, motors=True)
    film.watch.sinking = True
    film.show(1.0, tof=50, h=50, motors=True)
    film.watch.landing_answered = True
    assert film.show(0.2, tof=50, h=50, motors=True) is FlightState.LANDING  # an answer alone does not count
    assert film.show(0.1, tof=10, h=0, motors=True) is FlightState.LANDED
    assert film.show(2.0, tof=10, h=0) is FlightState.LANDED


def test_a_take_off_that_stays_low_ends_too() -> None:
    film = Film()
    film.show(3.0)
    film.watch.rising = True
    film.show(4.0, tof=30, h=20, motors=True)
    assert film.watch.phase is FlightState.TAKING_OFF
    assert film.show(6.0, tof=30, h=20, motors=True) is FlightState.HOVERING


def test_stopped_motors_end_the_flight() -> None:
    film = Film()
    assert film.show(3.0, tof=80, h=80, motors=True) is FlightState.HOVERING
    assert film.show(4.0, tof=None, h=80) is FlightState.LANDED


@pytest.mark.parametrize(
    ("distance", "height", "metres"),
    [
        (10, 0, 0.0),
        (10, -60, 0.0),
        (10, 10, 0.1),
        (71, 50, 0.71),
        (None, 80, 0.8),
        (None, -60, None),
        (None, None, None),
    ],
)
def test_heights(distance: float | None, height: float | None, metres: float | None) -> None:
    assert height_m(TelloState(distance_cm=distance, height_cm=height)) == metres


def test_axes_of_the_velocity() -> None:
    state = TelloState(yaw_deg=90.0, speed_dm_s=(0.0, 5.0, -2.0))  # its nose points to the right of the initial heading
    assert velocity_m_s(state, VelocityAxes.START) == pytest.approx((0.5, 0.0, 0.2))
    assert velocity_m_s(state, VelocityAxes.BODY) == pytest.approx((0.0, -0.5, 0.2))
    assert velocity_m_s(state, VelocityAxes.NONE) is None
    assert velocity_m_s(TelloState(speed_dm_s=(1.0, 0.0, 0.0)), VelocityAxes.START) is None
