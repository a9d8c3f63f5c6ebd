"""The software autopilot with a point mass; its signs, states and gaps as tables."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.messages import Attitude, Feedback, FlightState, Hover, Land, Position, Takeoff, Velocity
from skyloop.messages.geometry import wrap_angle
from skyloop.proxy.core.autopilot import PERIOD_S, AutopilotSettings, SoftwareAutopilot, software_actions

ATTITUDE = frozenset({"attitude"})
GRAVITY = 9.81
STEP_NS = round(PERIOD_S * NS_PER_S)


@dataclass
class PointMass:
    """A vehicle with attitude and climb rate: first-order tilt and climb, drag, wind. Body axes; yaw turns."""

    position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])  # east, north, up [m]
    velocity: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])  # east, north, up [m/s]
    yaw: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    wind: tuple[float, float] = (0.0, 0.0)
    now_ns: int = NS_PER_S

    def step(self, told: Attitude) -> None:
        lag = PERIOD_S / 0.15
        self.roll += (told.roll - self.roll) * lag
        self.pitch += (told.pitch - self.pitch) * lag
        self.yaw += told.yaw_rate * PERIOD_S
        forward, left = GRAVITY * math.tan(self.pitch), -GRAVITY * math.tan(self.roll)
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        push = (cos * forward - sin * left, sin * forward + cos * left)
        for axis in (0, 1):
            drag = 0.3 * (self.velocity[axis] - self.wind[axis])
            self.velocity[axis] += (push[axis] - drag) * PERIOD_S
        self.velocity[2] += (told.climb - self.velocity[2]) * PERIOD_S / 0.2
        for axis in range(3):
            self.position[axis] += self.velocity[axis] * PERIOD_S
        if self.position[2] <= 0.0:
            self.position[2], self.velocity[2] = 0.0, max(0.0, self.velocity[2])
        self.now_ns += STEP_NS

    def feedback(self, *, position: bool = True) -> Feedback:
        east, north, up = self.velocity
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return Feedback(
            captured_ns=self.now_ns,
            yaw_rad=self.yaw,
            altitude_m=self.position[2],
            velocity_m_s=(cos * east + sin * north, cos * north - sin * east, up),
            position_m=(self.position[0], self.position[1], self.position[2]) if position else None,
        )


def fly(autopilot: SoftwareAutopilot, mass: PointMass, seconds: float, *, position: bool = True) -> None:
    for _ in range(round(seconds / PERIOD_S)):
        told = autopilot.step(mass.now_ns, mass.feedback(position=position))
        assert told is None or isinstance(told, Attitude)
        mass.step(told or Attitude(climb=-1.0))


def taken_off(mass: PointMass) -> SoftwareAutopilot:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Takeoff(), mass.now_ns, mass.feedback())
    fly(autopilot, mass, 6.0)
    return autopilot


@pytest.mark.parametrize(
    ("native", "added"),
    [
        ({"attitude"}, {"takeoff", "hover", "land", "velocity", "position", "return_to_start"}),
        ({"velocity"}, {"takeoff", "hover", "land", "position", "return_to_start"}),
        ({"takeoff", "land", "hover", "attitude"}, {"velocity", "position", "return_to_start"}),
        ({"takeoff", "land", "hover", "velocity", "position"}, {"return_to_start"}),
        ({"takeoff", "land"}, set()),
        (set(), set()),
    ],
)
def test_it_adds_actions_that_set_points_can_emulate(native: set[str], added: set[str]) -> None:
    assert software_actions(frozenset(native)) == added


@pytest.mark.parametrize(
    ("wanted", "roll_sign", "pitch_sign"),
    [(Velocity(1.0), 0, 1), (Velocity(-1.0), 0, -1), (Velocity(left=1.0), -1, 0), (Velocity(left=-1.0), 1, 0)],
)
def test_signs_follow_rep_103(wanted: Velocity, roll_sign: int, pitch_sign: int) -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    still = Feedback(captured_ns=0, velocity_m_s=(0.0, 0.0, 0.0))
    autopilot.start(wanted, 0, still)
    told = autopilot.step(0, still)
    assert isinstance(told, Attitude)
    assert (told.roll > 0) - (told.roll < 0) == roll_sign
    assert (told.pitch > 0) - (told.pitch < 0) == pitch_sign


def test_take_off_hover_and_landing() -> None:
    mass = PointMass()
    autopilot = SoftwareAutopilot(ATTITUDE)
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDED
    autopilot.start(Takeoff(), mass.now_ns, mass.feedback())
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.TAKING_OFF
    fly(autopilot, mass, 6.0)
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.HOVERING
    assert mass.position[2] == pytest.approx(1.0, abs=0.05)
    autopilot.start(Land(), mass.now_ns, mass.feedback())
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDING
    fly(autopilot, mass, 6.0)
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDED
    assert mass.position[2] == pytest.approx(0.0, abs=0.01)
    assert autopilot.step(mass.now_ns, mass.feedback()) is None


@pytest.mark.parametrize("wanted", [Velocity(1.0), Velocity(left=-0.8), Velocity(0.6, 0.6, 0.2, 0.3)])
def test_a_velocity_is_reached_and_held(wanted: Velocity) -> None:
    mass = PointMass()
    autopilot = taken_off(mass)
    autopilot.start(wanted, mass.now_ns, mass.feedback())
    fly(autopilot, mass, 8.0)
    velocity = mass.feedback().velocity_m_s
    assert velocity is not None
    assert velocity == pytest.approx((wanted.forward, wanted.left, wanted.up), abs=0.12)
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.FLYING


@pytest.mark.parametrize("yaw", [0.0, 2.0, -1.2])
def test_hover_brakes_and_holds_the_position_in_wind(yaw: float) -> None:
    mass = PointMass(yaw=yaw)
    autopilot = taken_off(mass)
    autopilot.start(Velocity(1.0), mass.now_ns, mass.feedback())
    fly(autopilot, mass, 4.0)
    mass.wind = (1.0, -1.0)
    autopilot.start(Hover(), mass.now_ns, mass.feedback())
    fly(autopilot, mass, 15.0)
    place = list(mass.position)
    fly(autopilot, mass, 10.0)
    assert math.dist(place, mass.position) < 0.1
    assert math.hypot(*mass.velocity) < 0.05


def test_hover_without_a_position_stays_level() -> None:
    mass = PointMass(wind=(1.0, 0.0))
    autopilot = taken_off(mass)
    autopilot.start(Hover(), mass.now_ns, mass.feedback(position=False))
    fly(autopilot, mass, 20.0, position=False)
    assert math.hypot(*mass.velocity) < 0.05


def test_a_vehicle_with_velocities_gets_velocities() -> None:
    autopilot = SoftwareAutopilot(frozenset({"velocity"}))
    feedback = Feedback(captured_ns=0, altitude_m=0.0)
    autopilot.start(Takeoff(), 0, feedback)
    assert autopilot.step(0, feedback) == Velocity(up=0.5)
    high = Feedback(captured_ns=STEP_NS, altitude_m=0.95)
    assert autopilot.step(STEP_NS, high) == Velocity()
    assert autopilot.step(2 * STEP_NS, high) == Velocity(up=pytest.approx(0.05))  # type: ignore[arg-type]


def test_without_data_it_stays_level_and_uses_time() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Takeoff(), 0, None)
    assert autopilot.step(0, None) == Attitude(climb=0.5)
    assert autopilot.step(2 * NS_PER_S, None) == Attitude()
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.HOVERING
    autopilot.start(Velocity(1.0, 0.0, 0.2, 0.1), 2 * NS_PER_S, None)
    assert autopilot.step(3 * NS_PER_S, None) == Attitude(0.0, 0.0, 0.2, 0.1)
    autopilot.start(Land(), 3 * NS_PER_S, None)
    assert autopilot.step(17 * NS_PER_S, None) == Attitude(climb=-0.4)
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDING
    assert autopilot.step(60 * NS_PER_S, None) == Attitude(climb=-0.4)
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDING, "time alone shows nothing"


def test_the_result_of_a_landing_without_an_altimeter_is_unknown() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Land(), 0, None)
    heard = 0
    while autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDING:
        heard += STEP_NS
        assert autopilot.step(heard, Feedback(captured_ns=heard)) == Attitude(climb=-0.4)
    assert 15.0 <= heard / NS_PER_S <= 15.1
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.UNKNOWN
    assert autopilot.flight.state(FlightState.FLYING) is FlightState.FLYING


@pytest.mark.parametrize("shown", [FlightState.UNKNOWN, FlightState.FLYING])
def test_a_gap_in_the_feedback_ends_no_landing(shown: FlightState) -> None:
    """Late in a long landing, nothing is received for 0.6 s, or for a minute."""
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Land(), 0, None)
    now = 0
    for gap_s in (0.6, 60.0):
        for _ in range(20 * 50):
            now += STEP_NS
            last = Feedback(captured_ns=now, altitude_m=20.0 - 0.4 * now / NS_PER_S % 10)
            autopilot.step(now, last, shown)
        for _ in range(round(gap_s * 50)):
            now += STEP_NS
            assert autopilot.step(now, last, shown) == Attitude(climb=-0.4)
            assert autopilot.flight.state(shown) is FlightState.LANDING
    assert autopilot.step(now + STEP_NS, Feedback(captured_ns=now + STEP_NS, altitude_m=0.4), shown) is not None
    assert autopilot.flight.state(shown) is FlightState.LANDING, "a second without headway counts while it is received"


def test_a_landing_over_lower_ground_ends_when_the_vehicle_reports_it() -> None:
    """Its altimeter counts from where it took off, 2 m higher."""
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Land(), 0, None)
    now = 0
    for below in range(100):
        now += STEP_NS
        seen(autopilot, FlightState.FLYING, now, 0.0 - 0.02 * below)
        assert autopilot.flight.state(FlightState.FLYING) is FlightState.LANDING
    for _ in range(100):  # it makes no headway either, and still reports to fly
        now += STEP_NS
        assert seen(autopilot, FlightState.FLYING, now, -2.0) == Attitude(climb=-0.4)
    assert seen(autopilot, FlightState.LANDED, now + STEP_NS, -2.0) == Attitude(climb=-0.4), (
        "the set-point stays in force"
    )
    assert autopilot.flight.state(FlightState.LANDED) is FlightState.LANDED
    assert seen(autopilot, FlightState.LANDED, now + 2 * STEP_NS, -2.0) is None


def test_reports_from_before_do_not_end_a_landing_right_after_a_take_off() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Takeoff(), 0, None)
    seen(autopilot, FlightState.LANDED, STEP_NS, 0.0)
    autopilot.start(Land(), 2 * STEP_NS, None)
    seen(autopilot, FlightState.LANDED, 3 * STEP_NS, 0.0)
    assert autopilot.flight.state(FlightState.LANDED) is FlightState.LANDING
    seen(autopilot, FlightState.LANDED, 60 * STEP_NS, 0.0)
    assert autopilot.flight.state(FlightState.LANDED) is FlightState.LANDED


@pytest.mark.parametrize("position", [True, False])
def test_a_take_off_ends_without_the_altimeter(position: bool) -> None:
    """It is stuck at zero: the position shows the height, otherwise the time."""
    autopilot = SoftwareAutopilot(frozenset({"velocity"}))
    autopilot.start(Takeoff(), 0, None)
    height, now = 0.0, 0
    while autopilot.flight.state(FlightState.UNKNOWN) is FlightState.TAKING_OFF:
        now += STEP_NS
        place = (0.0, 0.0, height) if position else None
        told = autopilot.step(now, Feedback(captured_ns=now, altitude_m=0.0, position_m=place, yaw_rad=0.0))
        assert isinstance(told, Velocity)
        height += told.up * PERIOD_S
        assert height < 5.0
    assert height == pytest.approx(1.0 if position else 3.0, abs=0.05)
    told = autopilot.step(now + STEP_NS, Feedback(captured_ns=now + STEP_NS, altitude_m=0.0))
    assert told == Velocity(), "it does not climb to where the altimeter should be"


def test_a_take_off_that_has_not_risen_in_time_lands() -> None:
    """Seen with a real Betaflight short of computing time: it was reported as hovering, at 0.04 m."""
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Takeoff(), 0, None)
    now = 0
    while autopilot.flight.state(FlightState.FLYING) is FlightState.TAKING_OFF:
        now += STEP_NS
        told = seen(autopilot, FlightState.FLYING, now, 0.04 + 0.01 * (now // STEP_NS % 3))
        assert now < 10 * NS_PER_S
    assert autopilot.flight.state(FlightState.FLYING) is FlightState.LANDING
    assert told == Attitude(climb=-0.4)
    seen(autopilot, FlightState.LANDED, now + 2 * NS_PER_S, 0.04)
    assert autopilot.flight.state(FlightState.LANDED) is FlightState.LANDED


def test_a_vehicle_that_reports_to_stand_has_not_taken_off_whatever_its_altimeter() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Takeoff(), 0, None)
    for step in range(1, 400):
        assert seen(autopilot, FlightState.LANDED, step * STEP_NS, 1.2) == Attitude(climb=0.5)
    assert autopilot.flight.state(FlightState.LANDED) is FlightState.TAKING_OFF
    seen(autopilot, FlightState.FLYING, 400 * STEP_NS, 1.2)
    assert autopilot.flight.state(FlightState.FLYING) is FlightState.HOVERING


def test_a_vehicle_found_on_the_ground_after_a_gap_stays_there() -> None:
    """A flight controller stalled for a while, and its vehicle fell."""
    autopilot = SoftwareAutopilot(ATTITUDE)
    now = 0
    autopilot.start(Hover(), now, Feedback(captured_ns=0, altitude_m=1.0))
    heard = Feedback(captured_ns=0, altitude_m=1.0)
    for _ in range(100):
        now += STEP_NS
        told = autopilot.step(now, heard, FlightState.FLYING)
    autopilot.start(Hover(), now, heard)
    for _ in range(50):
        now += STEP_NS
        told = seen(autopilot, FlightState.FLYING, now, 0.02)
        assert told == Attitude()


def test_stale_feedback_is_not_used() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    old = Feedback(captured_ns=0, velocity_m_s=(3.0, 3.0, 0.0))
    autopilot.start(Hover(), 0, old)
    assert autopilot.step(NS_PER_S // 2, old) != Attitude()
    assert autopilot.step(NS_PER_S // 2 + 1, old) == Attitude()


def test_an_altimeter_that_never_reads_zero_still_ends_the_landing() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    for step in range(200):
        now = step * STEP_NS
        feedback = Feedback(captured_ns=now, altitude_m=max(0.25, 1.0 - 0.4 * step * PERIOD_S))
        if step == 0:
            autopilot.start(Land(), now, feedback)
        autopilot.step(now, feedback)
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDED


@pytest.mark.parametrize(
    ("native", "mode", "told", "expected"),
    [
        ({"takeoff", "land", "hover", "attitude"}, Velocity(), FlightState.FLYING, FlightState.FLYING),
        ({"takeoff", "land", "attitude"}, Hover(), FlightState.FLYING, FlightState.HOVERING),
        ({"takeoff", "land", "attitude"}, Hover(), FlightState.LANDED, FlightState.LANDED),
        ({"takeoff", "attitude"}, Land(), FlightState.FLYING, FlightState.LANDING),
        ({"takeoff", "attitude"}, Land(), FlightState.LANDED, FlightState.LANDED),
        ({"attitude"}, Takeoff(), FlightState.UNKNOWN, FlightState.TAKING_OFF),
        ({"attitude"}, Takeoff(), FlightState.EMERGENCY, FlightState.EMERGENCY),
    ],
)
def test_the_vehicles_own_report_counts_if_it_has_one(
    native: set[str], mode: Takeoff | Hover | Land | Velocity, told: FlightState, expected: FlightState
) -> None:
    autopilot = SoftwareAutopilot(frozenset(native))
    autopilot.start(mode, 0, None)
    assert autopilot.flight.state(told) is expected


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ("attitude", FlightState.FLYING),
        ("hover", FlightState.HOVERING),
        ("emergency_stop", FlightState.EMERGENCY),
        ("reset_emergency", FlightState.LANDED),
    ],
)
def test_the_vehicles_own_actions_stop_the_autopilot(action: str, expected: FlightState) -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Hover(), 0, None)
    autopilot.stop(action)
    assert autopilot.step(0, None) is None
    assert autopilot.flight.state(FlightState.UNKNOWN) is expected


def test_an_attitude_on_the_ground_is_not_a_flight() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.stop("attitude")
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDED


def test_a_vehicle_first_seen_in_the_air_is_flying() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.flight.observe(FlightState.UNKNOWN, "", 0, Feedback(captured_ns=0, altitude_m=0.1))
    autopilot.flight.observe(FlightState.UNKNOWN, "", 0, Feedback(captured_ns=0, altitude_m=1.0))
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDED, "it drifts"
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.flight.observe(FlightState.LANDED, "", 0, Feedback(captured_ns=0, altitude_m=1.0))
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.LANDED
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.flight.observe(FlightState.UNKNOWN, "", 0, Feedback(captured_ns=0))
    autopilot.flight.observe(FlightState.UNKNOWN, "", 0, Feedback(captured_ns=0, altitude_m=1.0))
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.FLYING


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([Takeoff(), Hover(), Land(), Velocity(50.0, -50.0, 0.1, 0.2)]),
            st.none() | st.floats(-5, 50),
            st.none() | st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-5, 5)),
            st.none() | st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.just(1.0)),
        ),
        max_size=50,
    )
)
def test_it_never_tilts_beyond_the_limit_whatever_the_feedback(
    heard: list[
        tuple[
            Takeoff | Hover | Land | Velocity,
            float | None,
            tuple[float, float, float] | None,
            tuple[float, float, float] | None,
        ]
    ],
) -> None:
    autopilot = SoftwareAutopilot(ATTITUDE, AutopilotSettings(tilt=0.2))
    now = 0
    for action, altitude, velocity, position in heard:
        now += STEP_NS
        feedback = Feedback(
            captured_ns=now, altitude_m=altitude, velocity_m_s=velocity, position_m=position, yaw_rad=0.3
        )
        autopilot.start(action, now, feedback)
        told = autopilot.step(now, feedback)
        assert told is None or isinstance(told, Attitude)
        if told is not None:
            assert math.hypot(told.roll, told.pitch) <= 0.2 * (1 + 1e-9)
            assert abs(told.climb) <= 0.5


# To a place ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [0.0, 2.0, -3.0])
@pytest.mark.parametrize("wind", [(0.0, 0.0), (0.8, -0.5)])
def test_a_target_is_reached_and_held(yaw: float, wind: tuple[float, float]) -> None:
    mass = PointMass(yaw=yaw, wind=wind)
    autopilot = taken_off(mass)
    autopilot.start(Position(3.0, -2.0, 2.0, yaw=-1.0), mass.now_ns, mass.feedback())
    assert autopilot.flight.state(FlightState.UNKNOWN) is FlightState.FLYING
    fly(autopilot, mass, 30.0)
    assert math.dist(mass.position, (3.0, -2.0, 2.0)) < 0.15
    assert math.hypot(*mass.velocity) < 0.1
    assert wrap_angle(mass.yaw + 1.0) == pytest.approx(0.0, abs=0.05)


def test_the_heading_is_kept_if_none_is_requested() -> None:
    mass = PointMass(yaw=0.5)
    autopilot = taken_off(mass)
    autopilot.start(Position(1.0, 1.0, 1.0), mass.now_ns, mass.feedback())
    fly(autopilot, mass, 1.0)
    mass.yaw = 0.8  # a gust turns it
    fly(autopilot, mass, 9.0)
    assert mass.yaw == pytest.approx(0.5, abs=0.05)
    autopilot.start(Position(1.0, 1.0, 1.0, yaw=2.0), mass.now_ns, mass.feedback())
    fly(autopilot, mass, 8.0)
    autopilot.start(Position(0.0, 1.0, 1.0), mass.now_ns, mass.feedback())
    fly(autopilot, mass, 8.0)
    assert mass.yaw == pytest.approx(2.0, abs=0.05), "it keeps the heading that it was turned to, not the earlier one"


PLACES = st.floats(-50.0, 50.0)


@given(
    st.tuples(PLACES, PLACES, PLACES),
    st.tuples(PLACES, PLACES, PLACES),
    st.floats(-math.pi, math.pi),
    st.none() | st.floats(-10.0, 10.0),
    st.floats(0.05, 10.0),
    st.floats(0.05, 3.0),
)
def test_the_path_is_straight_and_within_its_speeds(
    place: tuple[float, float, float],
    target: tuple[float, float, float],
    heading: float,
    yaw: float | None,
    speed: float,
    yaw_rate: float,
) -> None:
    autopilot = SoftwareAutopilot(frozenset({"velocity"}))
    feedback = Feedback(captured_ns=0, yaw_rad=heading, position_m=place)
    autopilot.start(Position(*target, yaw, speed, yaw_rate), 0, feedback)
    told = autopilot.step(0, feedback)
    assert isinstance(told, Velocity)
    cos, sin = math.cos(heading), math.sin(heading)
    world = (cos * told.forward - sin * told.left, sin * told.forward + cos * told.left, told.up)
    pace, away = math.hypot(*world), math.dist(place, target)
    assert pace <= min(speed, away) + 1e-9
    assert pace**2 / 2 <= 0.6 * away + 1e-6, "it can still stop there"
    assert math.dist([one * away for one in world], [(b - a) * pace for a, b in zip(place, target, strict=True)]) < 1e-6
    assert abs(told.yaw_rate) <= yaw_rate
    turn = 0.0 if yaw is None else wrap_angle(yaw - heading)
    assert told.yaw_rate * turn >= 0.0


@pytest.mark.parametrize(
    "lacking",
    [{"position_m": None}, {"yaw_rad": None}, {"captured_ns": -NS_PER_S}],
    ids=["no position", "no yaw", "old"],
)
def test_it_stops_while_its_position_is_unknown(lacking: dict[str, object]) -> None:
    autopilot = SoftwareAutopilot(frozenset({"velocity"}))
    known: dict[str, object] = {"captured_ns": 0, "yaw_rad": 0.0, "position_m": (0.0, 0.0, 1.0)}
    autopilot.start(Position(5.0, 0.0, 1.0), 0, Feedback(**known))  # type: ignore[arg-type]
    assert autopilot.step(0, Feedback(**known)) == Velocity(forward=1.0)  # type: ignore[arg-type]
    assert autopilot.step(0, Feedback(**(known | lacking))) == Velocity()  # type: ignore[arg-type]
    assert autopilot.step(0, None) == Velocity()


def test_forbidden_velocities_are_not_flown() -> None:
    autopilot = SoftwareAutopilot(frozenset({"velocity"}))
    autopilot.guard = lambda wanted, _feedback, _now_ns: Velocity(up=wanted.up)
    feedback = Feedback(captured_ns=0, yaw_rad=0.0, position_m=(0.0, 0.0, 1.0))
    autopilot.start(Position(5.0, 0.0, 1.1), 0, feedback)
    told = autopilot.step(0, feedback)
    assert isinstance(told, Velocity)
    assert (told.forward, told.left) == (0.0, 0.0)
    assert told.up > 0.0


# A vehicle that reports whether it is on the ground -------------------------------------------------------------------


def seen(
    autopilot: SoftwareAutopilot, state: FlightState, now_ns: int, altitude_m: float
) -> Attitude | Velocity | None:
    return autopilot.step(now_ns, Feedback(captured_ns=now_ns, altitude_m=altitude_m), state)


def test_a_vehicle_disarmed_in_the_air_is_no_longer_flown() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Takeoff(), 0, None)
    assert seen(autopilot, FlightState.LANDED, STEP_NS, 0.0) is not None, "it is about to rise"
    seen(autopilot, FlightState.FLYING, 2 * STEP_NS, 1.0)
    assert autopilot.flight.state(FlightState.FLYING) is FlightState.HOVERING
    assert seen(autopilot, FlightState.LANDED, 3 * STEP_NS, 0.1) == Attitude(), "no climb stays in force"
    assert seen(autopilot, FlightState.LANDED, 4 * STEP_NS, 0.1) is None
    assert autopilot.flight.state(FlightState.LANDED) is FlightState.LANDED


def test_a_take_off_that_never_leaves_the_ground_ends() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Takeoff(), 0, None)
    assert seen(autopilot, FlightState.LANDED, 14 * NS_PER_S, 0.0) is not None
    assert seen(autopilot, FlightState.LANDED, 15 * NS_PER_S, 0.0) == Attitude(), "no climb stays in force"
    assert seen(autopilot, FlightState.LANDED, 15 * NS_PER_S + STEP_NS, 0.0) is None
    assert autopilot.flight.state(FlightState.LANDED) is FlightState.LANDED


@pytest.mark.parametrize("action", [Hover(), Velocity(0.5)])
def test_steering_on_the_ground_without_a_take_off_ends(action: Hover | Velocity) -> None:
    """It was disarmed when the software started to steer it: an upward velocity would arm it again."""
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(action, 0, None)
    seen(autopilot, FlightState.LANDED, STEP_NS, 0.0)
    assert autopilot.flight.state(FlightState.LANDED).airborne, "its driver may not know yet"
    for step in range(2, 60):
        seen(autopilot, FlightState.LANDED, step * STEP_NS, 0.0)
    assert autopilot.flight.state(FlightState.LANDED) is FlightState.LANDED


def test_a_refusal_ends_a_take_off_but_no_flight() -> None:
    autopilot = SoftwareAutopilot(ATTITUDE)
    autopilot.start(Takeoff(), 0, None)
    autopilot.refused(FlightState.UNKNOWN)
    autopilot.refused(FlightState.FLYING)
    assert autopilot.flight.state(FlightState.FLYING) is FlightState.TAKING_OFF
    autopilot.refused(FlightState.LANDED)
    assert autopilot.step(STEP_NS, None) is None
    assert autopilot.flight.state(FlightState.LANDED) is FlightState.LANDED
