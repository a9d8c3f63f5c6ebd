"""Box and zones: pure rules first, then through the proxy, then flown against in simulated time."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.errors import ParameterError
from skyloop.messages import AnyAction, Attitude, EventKind, Feedback, Hover, Refused, SetParameter, Value, Velocity
from skyloop.proxy.core.safety import MARGIN_M, Safety, check_written, safety_of
from skyloop.stepping.rehearsal import Radio, rehearse
from skyloop.zones import BOX, ROOM, ZONES, Box, Cylinder, parse_zones, space_of
from tests.proxy.fake import Bench

BOXED = Safety(Box((-2.0, -2.0, 0.0), (2.0, 2.0, 3.0)), deceleration=1.0, reaction_s=0.3)
PILLAR = Safety(None, (Cylinder(2.0, 0.0, 0.5, 0.0, 2.0),))
NOW = 10 * NS_PER_S


def at(x: float, y: float, z: float = 1.0, yaw: float = 0.0, **known: Any) -> Feedback:
    fields: dict[str, Any] = {"captured_ns": NOW, "position_m": (x, y, z), "yaw_rad": yaw} | known
    return Feedback(**fields)


def clamp(safety: Safety, action: AnyAction, feedback: Feedback) -> tuple[Any, list[str]]:
    allowed, clamps, known = safety.clamp(action, feedback, NOW)
    assert known
    return allowed, [one.limit for one in clamps]


def test_far_from_all_walls_nothing_changes() -> None:
    action = Velocity(0.5, 0.5, 0.2, 1.0)
    assert BOXED.clamp(action, at(0, 0, 1.5), NOW) == (action, (), True)
    assert BOXED.clamp(action, at(0, 0, 1.5), NOW)[0] is action
    assert BOXED.clamp(Hover(), at(5, 0), NOW)[0] == Hover()


def test_the_speed_allowed_is_the_one_that_can_be_stopped() -> None:
    for distance in (0.01, 0.5, 3.0):
        v = BOXED.allowed_speed(distance, 0.3)
        assert v * 0.3 + v * v / 2 == pytest.approx(distance)
    assert BOXED.allowed_speed(0.0, 0.3) == BOXED.allowed_speed(-1.0, 0.3) == 0.0


def test_what_runs_along_the_wall_stays() -> None:
    allowed, limits = clamp(BOXED, Velocity(2.0, 0.4, 0.1, 0.5), at(1.5, 0.0))
    assert allowed.forward == pytest.approx(BOXED.allowed_speed(0.5, 0.3))
    assert (allowed.left, allowed.up, allowed.yaw_rate) == pytest.approx((0.4, 0.1, 0.5))
    assert limits == [BOX]


def test_axes_are_the_world_s() -> None:
    allowed, _ = clamp(BOXED, Velocity(left=-2.0), at(1.9, 0.0, yaw=math.pi / 2))  # looks north, its right is the east
    assert allowed.left == pytest.approx(-BOXED.allowed_speed(0.1, 0.3))
    assert clamp(BOXED, Velocity(forward=1.0), at(1.9, 0.0, yaw=math.pi))[1] == []


def test_an_old_position_costs_way() -> None:
    late = at(1.0, 0.0, captured_ns=NOW - NS_PER_S // 5)
    assert clamp(BOXED, Velocity(2.0), late)[0].forward == pytest.approx(BOXED.allowed_speed(1.0, 0.5))


def test_who_is_too_fast_is_braked() -> None:
    most = BOXED.allowed_speed(0.2, 0.3)
    braked, _ = clamp(BOXED, Velocity(2.0), at(1.8, 0.0, velocity_m_s=(1.5, 0.0, 0.0)))
    assert braked.forward == pytest.approx(most - 0.5 * (1.5 - most))
    assert clamp(BOXED, Velocity(), at(1.8, 0.0, velocity_m_s=(1.5, 0.0, 0.0)))[1] == [], "it does not ask to go there"


def test_outside_it_may_only_come_back() -> None:
    outside = at(2.5, 0.0)
    assert clamp(BOXED, Velocity(1.0, yaw_rate=0.3), outside) == (Velocity(-0.5, yaw_rate=0.3), [BOX])
    assert clamp(BOXED, Velocity(left=1.0), outside)[0] == Velocity(), "along the wall is not back"
    assert clamp(BOXED, Velocity(-1.0, 0.5), outside) == (Velocity(-1.0, 0.5), [])
    assert clamp(BOXED, Velocity(yaw_rate=1.0), outside) == (Velocity(yaw_rate=1.0), [])
    just = at(2.0 + MARGIN_M / 2, 0.0)
    assert clamp(BOXED, Velocity(left=1.0), just) == (Velocity(left=1.0), []), "that little is noise"
    corner = at(2.5, 2.5)
    assert clamp(BOXED, Velocity(-1.0), corner) == (Velocity(-1.0), [])
    assert clamp(BOXED, Velocity(-1.0, 0.2), corner)[0] == Velocity(left=-0.5)


def test_safety_are_gone_round() -> None:
    allowed, limits = clamp(PILLAR, Velocity(2.0), at(1.3, 0.0))
    assert allowed.forward == pytest.approx(PILLAR.allowed_speed(0.2, 0.3))
    assert limits == [ZONES]
    assert clamp(PILLAR, Velocity(2.0), at(1.3, 1.0))[0].left > 0.0, "pushed aside as it passes"
    assert clamp(PILLAR, Velocity(left=1.0), at(1.3, 0.0))[1] == []
    inside = at(1.9, 0.0)
    assert clamp(PILLAR, Velocity(1.0), inside)[0].forward == pytest.approx(-0.4)
    assert clamp(PILLAR, Velocity(-1.0), inside)[0] == Velocity(-1.0)
    above = at(2.0, 0.0, 2.3)
    assert clamp(PILLAR, Velocity(up=-1.0), above)[0].up == pytest.approx(-PILLAR.allowed_speed(0.3, 0.3))
    assert clamp(PILLAR, Velocity(1.0), above)[1] == []
    table = Safety(None, (Box((1.0, -1.0, 0.0), (2.0, 1.0, 0.8)),))
    assert clamp(table, Velocity(2.0), at(0.7, 0.0, 0.5))[0].forward == pytest.approx(table.allowed_speed(0.3, 0.3))
    assert clamp(table, Velocity(1.0), at(1.2, 0.0, 0.5))[0].forward == pytest.approx(-0.2), "inside"
    assert clamp(table, Velocity(left=1.0), at(1.2, 0.0, 0.5))[0] == Velocity()
    assert clamp(table, Velocity(-1.0), at(1.2, 0.0, 0.5))[0] == Velocity(-1.0)
    assert clamp(PILLAR, Velocity(1.0, up=-1.0), at(1.4, 0.0, 2.1))[1] == [ZONES], "over the edge"


def test_a_tilt_is_turned_into_one_that_brakes() -> None:
    slow = at(0.0, 0.0, velocity_m_s=(0.2, 0.0, 0.0))
    assert clamp(BOXED, Attitude(pitch=0.2), slow)[1] == []
    fast = at(1.5, 0.0, velocity_m_s=(1.5, 0.0, 0.0))
    braked, limits = clamp(BOXED, Attitude(roll=0.1, pitch=0.2, yaw_rate=0.4), fast)
    assert limits == [BOX]
    assert braked.pitch == pytest.approx(-math.atan(1.0 / 9.80665), abs=1e-3)
    assert (braked.roll, braked.yaw_rate) == pytest.approx((0.1, 0.4))
    assert clamp(BOXED, Attitude(pitch=0.2), at(2.5, 0.0))[0].pitch < 0.0, "outside it is led back"
    assert clamp(BOXED, Attitude(climb=1.0), at(0.0, 0.0, 2.9))[0].climb == pytest.approx(BOXED.allowed_speed(0.1, 0.3))
    assert clamp(BOXED, Attitude(pitch=0.2), at(2.0, 0.0))[0].pitch == pytest.approx(0.0), "without a known speed"


@pytest.mark.parametrize(
    "feedback",
    [
        None,
        Feedback(captured_ns=NOW, yaw_rad=0.0),
        Feedback(captured_ns=NOW, position_m=(0.0, 0.0, 0.0)),
        at(5.0, 0.0, captured_ns=NOW - NS_PER_S),
    ],
)
def test_without_a_position_nothing_is_enforced(feedback: Feedback | None) -> None:
    assert BOXED.clamp(Velocity(2.0), feedback, NOW) == (Velocity(2.0), (), False)


@given(
    start=st.tuples(st.floats(-1.9, 0.7), st.floats(-1.9, 1.9), st.floats(0.2, 2.8)),
    yaw=st.floats(-4, 4),
    asked=st.lists(st.tuples(*[st.floats(-3, 3)] * 3), min_size=1, max_size=6),
)
def test_an_obedient_vehicle_never_leaves_the_box_nor_enters_the_zone(
    start: tuple[float, float, float], yaw: float, asked: list[tuple[float, float, float]]
) -> None:
    safety = Safety(BOXED.box, (Cylinder(1.4, 0.0, 0.5, 0.0, 3.0), Box((-3.0, -3.0, 0.0), (-2.5, 3.0, 3.0))))
    x, y, z = start
    for forward, left, up in asked:
        for _ in range(15):
            allowed, _ = clamp(safety, Velocity(forward, left, up), at(x, y, z, yaw))
            dt = 0.1
            x += (math.cos(yaw) * allowed.forward - math.sin(yaw) * allowed.left) * dt
            y += (math.sin(yaw) * allowed.forward + math.cos(yaw) * allowed.left) * dt
            z += allowed.up * dt
            assert -2.001 <= x <= 2.001
            assert -2.001 <= y <= 2.001
            assert -0.001 <= z <= 3.001
            assert math.hypot(x - 1.4, y) > 0.499


def test_safety_as_they_are_written() -> None:
    assert parse_zones("") == parse_zones(" ; ") == ()
    assert parse_zones(" the  old tree :cylinder 1 2 0.5 0 3") == (Cylinder(1.0, 2.0, 0.5, 0.0, 3.0, "the old tree"),)
    assert str(parse_zones("table: box 3 3 2 1 1 0")[0]) == "table: box 1 1 0 3 3 2"
    assert parse_zones("cylinder 1 2 0.5 0 3; box 3,3,2 1 1 0") == (
        Cylinder(1.0, 2.0, 0.5, 0.0, 3.0),
        Box((1.0, 1.0, 0.0), (3.0, 3.0, 2.0)),
    )


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("sphere 1 2 3", "a box or a cylinder"),
        ("box 1 2 3", "6 finite numbers, not 3"),
        ("box 1 2 3 4 5 nan", "finite"),
        ("box 1 2 3 4 5 x", "must be numbers"),
        ("box 1 2 3 1 5 6", "extent"),
        ("cylinder 0 0 0 0 1", "radius"),
        ("cylinder 0 0 1 2 1", "low end"),
        ("cylinder 0 0 1 0 1;" * 33, "at most 32"),
        ("a, b: box 1 2 3 4 5 6", "no comma"),
        (f"{'a' * 25}: box 1 2 3 4 5 6", "1 to 24 letters"),
        ("tree: bush: box 1 2 3 4 5 6", "a box or a cylinder"),
    ],
)
def test_safety_that_make_no_sense(text: str, why: str) -> None:
    with pytest.raises(ParameterError, match=why):
        parse_zones(text)


def test_walls_that_go_not_together_are_refused() -> None:
    values = {f"{BOX}.{axis}_{end}": 0.0 for axis in "xyz" for end in ("low", "high")}
    check_written(f"{BOX}.x_low", -1.0, values.__getitem__)
    with pytest.raises(ParameterError, match="below the box's other wall, 0 m"):
        check_written(f"{BOX}.x_low", 1.0, values.__getitem__)
    with pytest.raises(ParameterError, match="above"):
        check_written(f"{BOX}.z_high", -1.0, values.__getitem__)
    check_written("limits.tilt", 0.1, values.__getitem__)


def test_nothing_is_looked_at_unless_it_is_asked_for() -> None:
    values: dict[str, float] = {
        f"{BOX}.{axis}_{end}": far for axis in "xyz" for end, far in (("low", -1e4), ("high", 1e4))
    }
    values |= {"safety.deceleration": 2.0, "safety.reaction_s": 0.1}

    def safety(zones: str = "", room: str = "", **walls: float) -> Safety | None:
        number = (values | {f"{BOX}.{wall}": at for wall, at in walls.items()}).__getitem__
        return safety_of(number, space_of(number, {ZONES: zones, ROOM: room}.__getitem__))

    assert safety() is None
    assert safety(room="box -1 -1 0 1 1 2") is None, "a room refuses places and shortens nothing"
    only = safety("cylinder 0 0 1 0 1")
    assert only == Safety(None, (Cylinder(0.0, 0.0, 1.0, 0.0, 1.0),), 2.0, 0.1)
    boxed = safety(z_low=0.3)
    assert boxed is not None
    assert boxed.box == Box((-1e4, -1e4, 0.3), (1e4, 1e4, 1e4))


@pytest.mark.parametrize(
    ("text", "room"),
    [
        ("box -1 -2 0 1 2 3", Box((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0))),
        ("", None),
        ("a hall", None),
        ("cylinder 0 0 1 0 1", None),
        ("box 0 0 0 1 1 1; box 2 2 2 3 3 3", None),
    ],
)
def test_a_room_is_what_a_driver_reports_as_one_box(text: str, room: Box | None) -> None:
    assert space_of(lambda _: 1e4, {ZONES: "", ROOM: text}.__getitem__).room == room


def test_the_proxy_enforces_what_is_written_and_tells(bench: Bench) -> None:
    pilot = bench.airborne()

    def write(name: str, value: Value) -> object:
        return pilot.ask(SetParameter(name, value, pilot.lease))

    write(f"{BOX}.x_high", 2.0)
    refused = write(ZONES, "pyramid 1 2 3")
    assert isinstance(refused, Refused)
    assert "a box or a cylinder" in refused.message
    pilot.command(Velocity(1.5))
    assert bench.driver.told[-1] == Velocity(1.5), "its position is not known"
    bench.driver.report(position_m=(1.9, 0.0, 1.0), yaw_rad=0.0)
    pilot.command(Velocity(1.5))
    applied = bench.driver.told[-1]
    assert isinstance(applied, Velocity)
    assert 0.0 < applied.forward < 0.3
    pilot.command(Velocity(1.5), repeat=True)
    (event,) = pilot.told(EventKind.COMMAND_CLAMPED)
    assert event.data["limit"] == BOX
    assert event.data["asked"] == pytest.approx(1.5)
    assert event.data["applied"] == pytest.approx(applied.forward)
    texts = [event.text for event in pilot.told(EventKind.VEHICLE_MESSAGE)]
    assert texts == [
        "the safety box and zones are not enforced: the vehicle's position is not known",
        "the safety box and zones are enforced: its position is known again",
    ]
    write(f"{BOX}.x_high", 10_000.0)
    pilot.command(Velocity(1.5))
    assert bench.driver.told[-1] == Velocity(1.5)


@pytest.mark.parametrize(
    ("action", "beyond_m"),
    [
        (Velocity(2.0), 0.15),
        (Velocity(1.0, 0.5, 0.3), 0.15),
        (Attitude(pitch=0.2), 0.35),
    ],
    ids=["straight", "into a corner", "by tilt"],
)
def test_the_simulated_drone_stops_at_the_wall(action: Velocity | Attitude, beyond_m: float) -> None:
    with rehearse("sim://?world=empty&cameras=none&wind=0", radio=Radio(seed=1)) as drone:
        walls = {"x_high": 2.0, "y_high": 1.0, "z_high": 1.6}
        for name, place in walls.items():
            drone.config[f"{BOX}.{name}"] = place
        drone.takeoff()
        seen: list[list[float]] = []
        drone.on_feedback(lambda f: seen.append([float((f.native or {})[f"truth.{axis}"]) for axis in "xyz"]))  # type: ignore[arg-type]
        end_ns = drone.feedback().captured_ns + 8 * NS_PER_S
        while drone.next_feedback().captured_ns < end_ns:
            drone.command(action)
        farthest = [max(place) for place in zip(*seen, strict=True)]
        assert 1.8 < farthest[0] < 2.0 + beyond_m
        assert farthest[1] < 1.0 + beyond_m
        assert farthest[2] < 1.6 + beyond_m
