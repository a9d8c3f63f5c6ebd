"""A vehicle's motion, its age and its gaps, and what laws do while it is unknown."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from see_and_avoid import AvoidLaw, AvoidPhase

from skyloop.clock import nanoseconds
from skyloop.control.airframe import DRAG_PER_S, Airframe, AirframeLaw, Part, TiltVelocity
from skyloop.control.chase_law import FollowMode
from skyloop.control.course_law import CourseLaw, GatePlace
from skyloop.control.follow import FollowLaw, FollowPhase
from skyloop.control.gate_law import GateLaw, GatePhase
from skyloop.control.image_servo import FlowLaw, FlowPhase, ImageServoLaw
from skyloop.control.landing_law import LandingLaw, LandingPhase
from skyloop.control.target_follower import TargetFollower
from skyloop.messages import Attitude, Feedback, FlightState, Velocity
from skyloop.sim.camera import FRONT_CAMERA
from skyloop.vision import BlobSighting

GRAVITY = 9.80665
STILL: dict[str, Any] = {
    "roll_rad": 0.0,
    "pitch_rad": 0.0,
    "yaw_rad": 0.0,
    "altitude_m": 1.2,
    "velocity_m_s": (0.0, 0.0, 0.0),
    "angular_velocity_rad_s": (0.0, 0.0, 0.0),
    "position_m": (0.0, 0.0, 1.2),
}


def state(at_s: float, **values: Any) -> Feedback:
    return Feedback(captured_ns=nanoseconds(at_s), state=FlightState.FLYING, **(STILL | values))


def tilted(at_s: float, *, state: FlightState = FlightState.FLYING, **angles: float | None) -> Feedback:
    given: dict[str, Any] = {"roll_rad": 0.0, "pitch_rad": 0.0, "yaw_rad": 0.0, **angles}
    return Feedback(captured_ns=nanoseconds(1.0 + at_s), state=state, **given)


def held(seconds: float, estimate: TiltVelocity | None = None, **angles: Any) -> tuple[float, float, float]:
    estimate = estimate or TiltVelocity()
    velocity = None
    for n in range(round(seconds * 40) + 1):
        velocity = estimate.step(tilted(n / 40, **angles))
    assert velocity is not None
    return velocity


def test_a_tilt_accelerates_until_drag_balances_it() -> None:
    push = GRAVITY * math.tan(0.1)
    assert held(0.1, pitch_rad=0.1)[0] == pytest.approx(0.1 * push, rel=0.05)
    for seconds in (1.0, 3.0, 20.0):
        expected = push / DRAG_PER_S * (1.0 - math.exp(-DRAG_PER_S * seconds))
        assert held(seconds, pitch_rad=0.1) == pytest.approx((expected, 0.0, 0.0), abs=1e-6)


def test_the_axes_are_those_of_feedback() -> None:
    assert held(1.0, pitch_rad=0.1)[0] > 0.5, "nose down: forward"
    forward, left, up = held(1.0, roll_rad=0.1)
    assert (forward, up) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert left < -0.5, "right side down: to the right"


def test_the_velocity_stays_where_it_was_when_the_vehicle_turns() -> None:
    estimate = TiltVelocity()
    forward, _, _ = held(1.0, estimate, pitch_rad=0.1)
    turned = estimate.step(tilted(1.0 + 1e-6, yaw_rad=math.pi / 2))
    assert turned == pytest.approx((0.0, -forward, 0.0), abs=1e-3), "it moves to the right of its nose now"


def test_a_landed_vehicle_is_at_rest() -> None:
    estimate = TiltVelocity()
    held(2.0, estimate, pitch_rad=0.2)
    assert estimate.step(tilted(2.1, state=FlightState.LANDED, pitch_rad=0.2)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("name", ["roll_rad", "pitch_rad", "yaw_rad"])
def test_nothing_is_known_without_the_attitude(name: str) -> None:
    assert TiltVelocity().step(tilted(0.0, **dict[str, Any]({name: None}))) is None


def test_neither_gaps_nor_late_samples_are_integrated_over() -> None:
    estimate = TiltVelocity()
    estimate.step(tilted(0.0, pitch_rad=0.1))
    after_gap = estimate.step(tilted(60.0, pitch_rad=0.1))
    assert after_gap is not None
    assert 0.0 < after_gap[0] < 0.6 * GRAVITY * math.tan(0.1), "as of half a second"
    late = estimate.step(tilted(59.0, pitch_rad=-0.3))
    assert late == after_gap


def test_a_vehicle_on_its_side_does_not_accelerate() -> None:
    assert np.hypot(*held(0.5, roll_rad=math.pi / 2)[:2]) < 2.0 * GRAVITY


def test_the_tilt_rate_comes_from_the_last_samples() -> None:
    tilting = Airframe()
    assert tilting.tilt_rate_rad_s == 0.0
    for n in range(5):
        tilting.add(tilted(n / 10, pitch_rad=0.1))
    assert tilting.tilt_rate_rad_s == 0.0, "it is held"
    tilting.add(tilted(0.5, pitch_rad=-0.1))
    assert tilting.tilt_rate_rad_s == pytest.approx(0.2 / 0.15)
    tilting.add(tilted(0.45, pitch_rad=1.0))
    tilting.add(tilted(0.55, pitch_rad=None))
    assert tilting.tilt_rate_rad_s == pytest.approx(0.2 / 0.15), "neither late nor unknown samples count"
    for n in range(6, 12):
        tilting.add(tilted(n / 10, pitch_rad=-0.1))
    assert tilting.tilt_rate_rad_s == 0.0, "that was long ago"


# Age and missing parts ---------------------------------------------------------------------------------------------


def test_a_part_not_reported_for_half_a_second_is_unknown() -> None:
    airframe = Airframe(Part.VELOCITY, Part.HEIGHT)
    assert airframe.missing(0) == "the vehicle's velocity and height above the ground are not known"
    airframe.add(state(1.0))
    airframe.add(state(1.3, velocity_m_s=None))
    assert airframe.missing(nanoseconds(1.4)) == ""
    assert airframe.age_s(Part.VELOCITY, nanoseconds(1.4)) == pytest.approx(0.4)
    assert airframe.missing(nanoseconds(1.6)) == "the vehicle's velocity is not known"
    assert airframe.at(nanoseconds(1.6)) is None
    assert airframe.altitude_m(nanoseconds(1.6)) == 1.2
    assert airframe.altitude_m(nanoseconds(1.9)) is None
    assert airframe.position_m(nanoseconds(1.9)) is None
    assert airframe.interruptions == 0
    airframe.add(state(1.6))
    assert (airframe.missing(nanoseconds(1.6)), airframe.interruptions) == ("", 1)


@pytest.mark.parametrize("name", sorted(STILL))
@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_values_that_are_not_finite_count_as_missing(name: str, wrong: float) -> None:
    value = STILL[name]
    airframe = Airframe()
    airframe.add(state(1.0, **dict[str, Any]({name: (0.0, wrong, 0.0) if isinstance(value, tuple) else wrong})))
    assert airframe.feedback is not None
    assert getattr(airframe.feedback, name) is None
    assert all(getattr(airframe.feedback, other) == STILL[other] for other in STILL if other != name)


def test_samples_after_one_stamped_ahead_are_not_ignored() -> None:
    airframe = Airframe(Part.VELOCITY)
    airframe.add(state(1.0, velocity_m_s=(1.0, 0.0, 0.0)))
    airframe.add(state(1.1, velocity_m_s=(1.0, 0.0, 0.0)))
    airframe.add(state(9.0))
    assert airframe.missing(nanoseconds(1.2)) == "the vehicle's velocity is not known"
    airframe.add(state(1.2))
    assert airframe.missing(nanoseconds(1.2)) == ""
    motion = airframe.at(nanoseconds(1.2))
    assert motion is not None
    assert motion.position[0] == pytest.approx(0.1, abs=0.3), "near where it was"
    assert airframe.interruptions >= 1


# Laws --------------------------------------------------------------------------------------------------------------

AHEAD = np.array([2.0, 0.3, 0.1])
BACK = np.array([-1.0, 0.0, 0.0])


def followers() -> list[AirframeLaw]:
    modes = (FollowMode.FOLLOW, FollowMode.LOOK)
    return [TargetFollower(FRONT_CAMERA.info(), box=(100.0, 100.0, 40.0, 80.0), mode=mode) for mode in modes]


def laws() -> list[AirframeLaw]:
    course = CourseLaw([GatePlace(4.0, 0.0, 1.2, 0.0)], [1.2])
    corners = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    servo = ImageServoLaw(FRONT_CAMERA.info(), corners, 1.5)
    return [FollowLaw(), GateLaw(), course, LandingLaw(), AvoidLaw(5.0), FlowLaw(), servo, *followers()]


def see(law: AirframeLaw, seen: Feedback, place: Any) -> None:
    """Show a law its target, if it has one, at a place in body axes."""
    if isinstance(law, FollowLaw | GateLaw | CourseLaw):
        law.see(place, BACK, seen, seen.captured_ns)
    elif isinstance(law, LandingLaw):
        law.see(place - np.array([2.0, 0.3, 2.0]), seen, seen.captured_ns)
    elif isinstance(law, FlowLaw):
        law.see(place[:2] * 0.01, seen.captured_ns)
    elif isinstance(law, ImageServoLaw):
        corners = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
        with np.errstate(invalid="ignore"):
            corners = corners * place[0] / 2 + place[1] / 10
        law.see(corners, seen, seen.captured_ns)


def step(law: Any, at_s: float) -> Velocity | Attitude:
    setpoint = law.step(nanoseconds(at_s))
    assert isinstance(setpoint, Velocity | Attitude)
    return setpoint


@pytest.mark.parametrize("number", range(len(laws())))
def test_without_feedback_each_law_holds_the_vehicle_and_says_why(number: int) -> None:
    law = laws()[number]
    for k in range(40):
        sample = state(1.0 + 0.05 * k, velocity_m_s=(0.4, 0.1, 0.0))
        law.feedback(sample)
        see(law, sample, AHEAD)
        step(law, 1.0 + 0.05 * k)
        assert law.problem == ""
    for late_s in (0.51, 1.0, 5.0):
        assert step(law, 2.95 + late_s) in (Velocity(), Attitude())
        assert "not known" in law.problem
    law.feedback(state(9.0))
    step(law, 9.0)
    assert law.problem == "", "it continues once the motion is known again"


@pytest.mark.parametrize("number", [0, 1, 3, 4])
def test_a_velocity_that_goes_missing_ends_flight_and_turn(number: int) -> None:
    """Attitude, height and frames continue. Laws used to turn away from a visible marker, or fly off."""
    law = laws()[number]
    setpoint: Velocity | Attitude = Velocity()
    for k in range(200):
        at_s = 1.0 + 0.05 * k
        sample = state(at_s, velocity_m_s=(0.5, 0.2, 0.0) if k < 60 else None)
        law.feedback(sample)
        see(law, sample, AHEAD)
        setpoint = step(law, at_s + 0.02)
        if k >= 72:
            assert setpoint == Velocity()
            assert law.problem == "the vehicle's velocity is not known"
    law.feedback(state(11.0))
    step(law, 11.0)
    assert law.problem == ""


@pytest.mark.parametrize("gone_s", [2.0, 3.0, 4.0, 5.0])
def test_a_landing_is_not_declared_in_the_air_where_the_velocity_goes_missing(gone_s: float) -> None:
    """It was declared at 1.01 m: the marker seemed to rise while the vehicle's own motion was frozen."""
    law, place, velocity = LandingLaw(), np.array([0.5, 0.0, 2.6]), np.zeros(3)
    for k in range(1200):
        at_s = 1.0 + k / 40
        x, y, z = velocity.tolist()
        known = (x, y, z) if at_s < gone_s or at_s > 12.0 else None
        sample = state(at_s, altitude_m=float(place[2]), velocity_m_s=known)
        law.feedback(sample)
        if np.hypot(*place[:2]) < 0.45 * place[2]:
            law.see(-place, sample, sample.captured_ns)
        wanted = law.step(sample.captured_ns + 20_000_000)
        velocity = velocity + (np.array([wanted.forward, wanted.left, wanted.up]) - velocity) / 16
        place = place + velocity / 40
        if law.phase is LandingPhase.DOWN:
            break
    assert law.phase is LandingPhase.DOWN, "it lands once it knows its velocity again"
    assert place[2] < 0.25
    assert np.hypot(*place[:2]) < 0.2


def test_a_target_seen_before_a_gap_is_not_flown_to_after_it() -> None:
    """The vehicle's position after the gap is unknown, so the marker's direction is unknown, too."""
    follow, gate, landing = FollowLaw(), GateLaw(), LandingLaw()
    for law in (follow, gate, landing):
        for at_s in (1.0, 1.1, 1.2, 3.0):
            law.feedback(state(at_s))
            if at_s < 2.0:
                see(law, state(at_s), AHEAD)
            law.step(nanoseconds(at_s))
    assert (follow.mode, gate.phase, landing.phase) == (
        FollowPhase.SEARCHING,
        GatePhase.SEARCHING,
        LandingPhase.SEARCHING,
    )


@pytest.mark.parametrize("number", [0, 1, 4])
def test_after_a_pause_set_points_start_from_rest(number: int) -> None:
    """Frames had stopped and the vehicle hovered: the old set-point is not its motion."""
    law, fastest = laws()[number], 0.0
    for k in range(80):
        at_s = 1.0 + 0.05 * k
        sample = state(at_s)
        law.feedback(sample)
        see(law, sample, AHEAD + np.array([1.0, 0.0, 0.0]))
        if k < 40 or k > 60:
            setpoint = step(law, at_s)
            assert isinstance(setpoint, Velocity)
            if k < 40:
                fastest = max(fastest, setpoint.forward)
            elif k == 61:
                assert (setpoint.forward, setpoint.left) == (0.0, 0.0)
    assert fastest > 0.3


ANY = st.one_of(st.floats(-3.0, 3.0), st.sampled_from([math.nan, math.inf, -math.inf]))
SAMPLES = st.fixed_dictionaries(
    {
        name: st.one_of(st.none(), st.just(value), st.tuples(ANY, ANY, ANY) if isinstance(value, tuple) else ANY)
        for name, value in STILL.items()
    }
)


@settings(deadline=None)
@given(
    number=st.integers(0, len(laws()) - 1),
    samples=st.lists(st.tuples(SAMPLES, st.lists(ANY, min_size=3, max_size=3), st.floats(0.0, 0.8)), max_size=12),
)
def test_nan_anywhere_yields_no_set_point_that_is_not_finite_or_grows(
    number: int, samples: list[tuple[dict[str, Any], list[float], float]]
) -> None:
    law, at_s = laws()[number], 1.0
    for values, place, dt_s in [*samples, *[(STILL, AHEAD.tolist(), 0.05)] * 3]:
        at_s += dt_s
        sample = state(at_s, **values)
        law.feedback(sample)
        see(law, sample, np.array(place))
        setpoint = step(law, at_s + 0.01)
        assert setpoint.finite
        if isinstance(setpoint, Velocity):
            assert max(map(abs, (setpoint.forward, setpoint.left, setpoint.up, setpoint.yaw_rate))) < 9.0
        else:
            assert max(map(abs, (setpoint.roll, setpoint.pitch, setpoint.climb))) < 1.0


def test_a_landing_holds_if_attitude_and_velocity_are_never_known_together() -> None:
    law = LandingLaw()
    for k in range(6):
        wrong = {"velocity_m_s": None} if k % 2 else {"roll_rad": math.nan}
        law.feedback(state(1.0 + 0.05 * k, **dict[str, Any](wrong)))
    assert law.step(nanoseconds(1.3)) == Velocity()
    assert "never known at the same time" in law.problem
    turning = state(1.4, angular_velocity_rad_s=(math.inf, math.nan, 0.0))
    law.feedback(turning)
    law.see(np.array([0.1, 0.0, -1.0]), turning, turning.captured_ns + 20_000_000)
    assert law.step(nanoseconds(1.42)).finite
    assert law.problem == ""


def test_positions_stamped_ahead_do_not_tilt_it_until_then() -> None:
    law = FlowLaw()
    for at_s, x in ((9.0, 0.0), (9.05, 0.1), (9.1, 0.2)):
        law.feedback(state(at_s))
        law.see(np.array([x, 0.0]), nanoseconds(at_s))
    assert step(law, 9.1) != Attitude()
    for at_s in np.arange(1.0, 4.0, 0.05).tolist():
        law.feedback(state(at_s))
        setpoint = step(law, at_s)
    assert (setpoint, law.phase) == (Attitude(), FlowPhase.LOST)
    law.see(np.array([5.0, 0.0]), nanoseconds(at_s))
    step(law, at_s)
    assert law.phase is FlowPhase.HOLDING
    assert law.off_m == pytest.approx(0.0, abs=0.01), "held at its current place"


def test_an_obstacle_with_an_edge_outside_the_lens_model_counts_as_close() -> None:
    """It ended the flight with an error about a fuzzy variable."""
    law = AvoidLaw(9.0)
    law.feedback(state(1.0))
    law.see([BlobSighting((0.0, 0.0, 9.0, 9.0), math.nan, 0.1)], nanoseconds(1.0))
    law.step(nanoseconds(1.0))
    assert law.phase is AvoidPhase.AVOIDING
    assert law.step(nanoseconds(1.2)).left < 0.0, "away from it"


def test_no_law_reaches_a_final_phase_while_blind() -> None:
    avoid, flow = AvoidLaw(1.0), FlowLaw()
    for law in (avoid, flow):
        law.feedback(state(1.0, velocity_m_s=(2.0, 0.0, 0.0)))
        see(law, state(1.0), AHEAD)
        step(law, 1.0)
        step(law, 9.0)
    assert avoid.phase is not AvoidPhase.ARRIVED
    assert flow.phase is FlowPhase.LOST
