"""The following law, in a small world with lag and noise: distances, sides, circles, losses, limits."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from skyloop.clock import nanoseconds, seconds
from skyloop.control.airframe import Motion
from skyloop.control.chase_law import LOSSES, ChaseLaw, ChaseSettings, FollowMode, TargetPhase
from skyloop.control.target_estimate import TargetEstimator, TargetState
from skyloop.errors import UsageError
from skyloop.messages import Attitude, Value, Velocity
from skyloop.messages.geometry import wrap_angle
from tests.support.target_world import PERIOD_S, PERSON, ChaseWorld, Path, camera_at, view_of, walk

PER_S = round(1 / PERIOD_S)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def ring(radius: float, speed: float) -> Path:
    return lambda t: (4.0 + radius * math.sin(speed * t / radius), radius * (1 - math.cos(speed * t / radius)))


def after(hidden_at: float) -> Callable[[float], bool]:
    return lambda t: t >= hidden_at


def settled(values: list[float], seconds: float) -> list[float]:
    return values[round(seconds * PER_S) :]


def still_law(*, at_s: float = 1.0, away: tuple[float, float] = (4.0, 0.0)) -> tuple[ChaseLaw, TargetEstimator]:
    estimator, camera = TargetEstimator(PERSON), camera_at()
    for n in range(15):
        view = view_of(camera, np.array([*away, 0.0]))
        if n == 0:
            estimator.start(view, camera, nanoseconds(at_s - 1), ground=True)
        estimator.update(view, camera, nanoseconds(at_s - 1 + n * PERIOD_S))
    return ChaseLaw(), estimator


def motion(at_s: float = 1.0, **values: Any) -> Motion:
    known: dict[str, Any] = {"position": np.zeros(3), "velocity": np.zeros(3), "yaw": 0.0, "yaw_rate": 0.0}
    return Motion(nanoseconds(at_s), **(known | values))


# Following ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [walk(4.0, 0.0), walk(6.5, 0.5), walk(4.0, 0.0, 1.5), walk(4.0, 0.0, 0.8, 0.8), ring(3.0, 1.3)],
    ids=["stands", "stands further off", "goes away", "goes across", "goes round"],
)
@pytest.mark.parametrize("relative", [False, True], ids=["velocity", "attitude"])
def test_the_distance_is_kept(path: Path, relative: bool) -> None:
    world = ChaseWorld(path, relative=relative)
    world.run(16.0)
    errors = [one - 4.0 for one in settled(world.ranges, 6.0)]
    assert rms(errors) < (0.8 if relative else 0.5)
    assert rms(settled(world.azimuths, 4.0)) < 0.2, "the target stays in the middle of the image"
    assert set(world.phases[1:]) == {TargetPhase.FOLLOWING}
    kinds = {type(one) for one in world.commands}
    assert kinds == {Attitude if relative else Velocity}


@pytest.mark.parametrize("distance_m", [3.0, 5.0, 7.0])
def test_the_distance_is_the_configured_one(distance_m: float) -> None:
    world = ChaseWorld(walk(5.0, 0.0, 0.0, 0.3), settings=ChaseSettings(distance_m=distance_m))
    world.run(14.0)
    assert rms([one - distance_m for one in settled(world.ranges, 9.0)]) < 0.5
    assert world.law.off_m is not None
    assert abs(world.law.off_m) < 0.6


@pytest.mark.parametrize("bearing_deg", [180, 90, -90, 135, 0])
def test_it_moves_around_to_a_bearing(bearing_deg: int) -> None:
    bearing = math.radians(bearing_deg)
    world = ChaseWorld(walk(4.0, 0.0, 0.4, 0.8), settings=ChaseSettings(bearing_rad=bearing))
    world.run(25.0)
    heading = math.atan2(0.8, 0.4)
    off = [wrap_angle(one - heading - bearing) for one in settled(world.bearings, 18.0)]
    assert rms(off) < 0.3
    assert rms([one - 4.0 for one in settled(world.ranges, 18.0)]) < 0.6
    assert min(world.ranges) > 2.0


def test_a_standing_target_has_no_side() -> None:
    world = ChaseWorld(walk(4.0, 0.0), settings=ChaseSettings(bearing_rad=math.pi), seed=None)
    world.run(8.0)
    assert world.places[-1][:2] == pytest.approx([0.0, 0.0], abs=0.3)


@pytest.mark.parametrize("orbit_m_s", [0.8, -0.8], ids=["counter-clockwise", "clockwise"])
@pytest.mark.parametrize("path", [walk(4.0, 0.0), walk(4.0, 0.0, 0.5, 0.0)], ids=["stands", "walks"])
def test_an_orbit_circles_at_the_distance(orbit_m_s: float, path: Path) -> None:
    world = ChaseWorld(path, mode=FollowMode.ORBIT, settings=ChaseSettings(orbit_m_s=orbit_m_s))
    world.run(24.0)
    assert rms([one - 4.0 for one in settled(world.ranges, 6.0)]) < 0.5
    turned = np.unwrap(settled(world.bearings, 6.0))
    assert (turned[-1] - turned[0]) / 18.0 == pytest.approx(orbit_m_s / 4.0, rel=0.25)
    assert world.phases[-1] is TargetPhase.ORBITING


def test_an_orbit_by_attitude_circles_too() -> None:
    world = ChaseWorld(walk(4.0, 0.0), mode=FollowMode.ORBIT, relative=True)
    world.run(24.0)
    assert rms([one - 4.0 for one in settled(world.ranges, 6.0)]) < 1.0
    turned = np.unwrap(settled(world.bearings, 6.0))
    assert turned[-1] - turned[0] > 1.0, "counter-clockwise"


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("aside", [0.0, 0.5])
def test_it_never_comes_too_near_to_an_approaching_target(seed: int, aside: float) -> None:
    world = ChaseWorld(walk(7.0, aside, -1.5, 0.0), seed=seed)
    world.run(10.0)
    assert min(world.ranges) > 2.0 - 0.3


def test_it_never_flies_into_a_target_that_stops_suddenly() -> None:
    world = ChaseWorld(lambda t: (4.0 + 2.0 * min(t, 6.0), 0.0))
    world.run(12.0)
    assert min(world.ranges) > 1.4, "from 2 m/s at once; the filter needs a moment"
    assert rms([one - 4.0 for one in settled(world.ranges, 10.0)]) < 0.4


@pytest.mark.parametrize("aside", [0.4, -0.4])
def test_it_makes_way_for_a_passing_target(aside: float) -> None:
    law, estimator = still_law()
    coming = replace(estimator.at(nanoseconds(1.0)), velocity=np.array([-1.5, 0.0]))

    class Coming(TargetEstimator):
        def at(self, at_ns: int) -> Any:
            return coming

    for n in range(10):
        at = motion(1.0 + n * PERIOD_S, position=np.array([0.0, aside, 0.0]))
        command = law.step(at.at_ns, at, 1.2, Coming(PERSON), at.at_ns)
    assert isinstance(command, Velocity)
    assert command.forward < -0.5
    assert command.left * aside > 0.0
    assert abs(command.left) > 0.2


def pushed(place: tuple[float, float], velocity: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
    """Return the change of forward and left speed after a second, caused by a person at a place."""
    found = []
    for beside in (False, True):
        law, estimator = still_law()
        other = replace(
            estimator.at(nanoseconds(1.0)), foot=np.array([*place, 0.0]), velocity=np.array(velocity, np.float64)
        )
        for n in range(15):
            at = motion(1.0 + n * PERIOD_S)
            command = law.step(at.at_ns, at, 1.2, estimator, at.at_ns, [other] if beside else [])
        assert isinstance(command, Velocity)
        found.append(command)
    return found[1].forward - found[0].forward, found[1].left - found[0].left


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_keeps_clear_of_others(side: float) -> None:
    assert pushed((0.0, side))[1] * side < -0.1, "a person standing beside it"
    assert pushed((2.0, 0.3 * side), (-1.5, 0.0))[1] * side < -0.1, "an approaching person"
    assert pushed((-1.0, 0.0))[0] > 0.1, "a person standing behind it"
    assert pushed((0.0, 5.0 * side)) == pytest.approx((0.0, 0.0), abs=1e-6), "a distant person"
    assert pushed((-2.0, side), (-1.5, 0.0)) == pytest.approx((0.0, 0.0), abs=0.05), "a departing person"
    assert math.isfinite(sum(pushed((0.0, 0.0)))), "a person at its own place"


def test_it_stays_further_from_a_person_at_an_uncertain_place() -> None:
    """A person out of view may have turned or stopped."""
    law, estimator = still_law(away=(8.0, 0.0))
    other = replace(estimator.at(nanoseconds(1.0)), foot=np.array([2.0, 1.9, 0.0]))
    found = []
    for place_m in (0.2, 1.2):
        law = ChaseLaw()
        for n in range(20):
            at = motion(1.0 + n * PERIOD_S)
            gone = replace(other, velocity=np.array([1.5, 0.0]), place_m=place_m)
            command = law.step(at.at_ns, at, 1.2, estimator, at.at_ns, [gone])
        assert isinstance(command, Velocity)
        found.append(command.left)
    assert found[1] < found[0] - 0.1


def test_it_keeps_its_side_of_a_person_who_comes_head_on() -> None:
    law, estimator = still_law(away=(8.0, 0.0))
    sides = []
    for n in range(20):
        at = motion(1.0 + n * PERIOD_S)
        aside = 0.3 if n < 3 else 0.15 * (-1.0) ** n  # alternating, as noise would
        other = still_law(at_s=at.at_ns / 1e9, away=(3.0 - n * 0.1, 0.0))[1].at(at.at_ns)
        other = replace(other, foot=np.array([3.0 - n * 0.1, -aside, 0.0]), velocity=np.array([-1.5, 0.0]))
        command = law.step(at.at_ns, at, 1.2, estimator, at.at_ns, [other])
        assert isinstance(command, Velocity)
        sides.append(command.left)
    assert min(sides[3:]) > 0.1


def test_the_first_set_point_starts_from_the_vehicles_velocity() -> None:
    for speed in (0.0, 1.0):
        law, estimator = still_law(away=(8.0, 0.0))
        at = motion(velocity=np.array([speed, 0.0, 0.0]))
        command = law.step(at.at_ns, at, 1.2, estimator, at.at_ns)
        assert isinstance(command, Velocity)
        assert command.forward == pytest.approx(speed, abs=0.05)


def test_limits_can_change_in_flight_without_a_step() -> None:
    world = ChaseWorld(walk(4.0, 0.0, 1.5))
    world.run(5.0)
    world.law.settings = replace(world.law.settings, acceleration_m_s2=1.0)
    world.run(0.3)
    fast = [one.forward for one in world.commands[-6:] if isinstance(one, Velocity)]
    assert max(abs(a - b) for a, b in itertools.pairwise(fast)) < 4 * 3.0 * PERIOD_S + 0.01


@pytest.mark.parametrize("leash_m", [1.0, 3.0])
def test_it_stays_within_a_leash(leash_m: float) -> None:
    world = ChaseWorld(walk(4.0, 0.0, 0.6, 0.3), settings=ChaseSettings(leash_m=leash_m))
    world.run(14.0)
    out = [float(np.hypot(*place[:2])) for place in world.places]
    assert max(out) < leash_m + 0.4
    assert out[-1] > leash_m - 0.4
    assert world.law.constraint == "leash"
    assert abs(world.azimuths[-1]) < 0.2, "it keeps turning to the target"
    free = ChaseWorld(walk(4.0, 0.0), settings=ChaseSettings(leash_m=leash_m))
    free.run(4.0)
    assert free.law.constraint == ""


def test_a_leash_uses_the_position_if_known() -> None:
    """A velocity error of 5 cm/s led it 8 m away on a leash of 5 m."""
    world = ChaseWorld(walk(8.0, 0.0), settings=ChaseSettings(leash_m=2.0), drift_m_s=-0.1)
    world.run(40.0)
    assert max(float(np.hypot(*place[:2])) for place in world.places) < 2.4
    assert world.law.constraint == "leash"


def test_it_stays_within_a_leash_when_making_way() -> None:
    """A person walking up from behind pushed it beyond the leash."""

    def behind(now_ns: int) -> list[TargetState]:
        time_s = seconds(now_ns) - 1.0
        x, speed = (-2.5 + 0.5 * time_s, 0.5) if time_s < 8.6 else (1.8, 0.0)  # stops beside the end of the leash
        return [TargetState(now_ns, np.array([x, 0.0, 0.0]), np.array([speed, 0.0]), 1.75, 0.1, 5.0, 0.1)]

    world = ChaseWorld(walk(8.0, 0.0), settings=ChaseSettings(leash_m=2.0), others=behind)
    world.run(14.0)
    assert max(float(np.hypot(*place[:2])) for place in world.places) < 2.2


def test_look_mode_stays_and_turns() -> None:
    world = ChaseWorld(walk(3.0, -2.0, 0.0, 0.7), mode=FollowMode.LOOK)
    world.run(8.0)
    assert world.places[-1][:2] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert all(one.forward == 0.0 == one.left for one in world.commands if isinstance(one, Velocity))
    assert rms(settled(world.azimuths, 2.0)) < 0.15
    assert world.phases[-1].value == TargetPhase.WATCHING.value


def test_look_mode_by_attitude_stays_level() -> None:
    world = ChaseWorld(walk(3.0, -1.0, 0.0, 0.4), mode=FollowMode.LOOK, relative=True)
    world.run(4.0)
    assert all(one.roll == 0.0 == one.pitch for one in world.commands if isinstance(one, Attitude))
    assert rms(settled(world.azimuths, 2.0)) < 0.15


def test_the_mode_can_change_in_flight() -> None:
    world = ChaseWorld(walk(4.0, 0.0))
    world.run(2.0)
    world.law.mode = FollowMode.ORBIT
    world.run(6.0)
    assert abs(world.bearings[-1] - world.bearings[0]) > 0.5
    world.law.mode = FollowMode.LOOK
    world.run(3.0)
    assert [phase for phase in dict.fromkeys(world.phases) if phase is not TargetPhase.LOOKING] == [
        TargetPhase.FOLLOWING,
        TargetPhase.ORBITING,
        TargetPhase.WATCHING,
    ]
    world.law.settings = replace(world.law.settings, distance_m=3.0)
    world.law.mode = FollowMode.FOLLOW
    world.run(8.0)
    assert world.ranges[-1] == pytest.approx(3.0, abs=0.4)


def test_set_points_are_within_the_limits() -> None:
    settings = ChaseSettings(speed_m_s=1.5, climb_m_s=0.3, turn_rad_s=0.9, acceleration_m_s2=2.0, height_m=2.5)
    world = ChaseWorld(walk(7.0, 3.0, 1.8, 0.6), settings=settings)
    world.run(5.0)
    commands = [one for one in world.commands if isinstance(one, Velocity)]
    assert max(math.hypot(one.forward, one.left) for one in commands) <= 1.5 + 1e-9
    assert max(abs(one.up) for one in commands) <= 0.3 + 1e-9
    assert max(abs(one.yaw_rate) for one in commands) <= 0.9 + 1e-9
    steps = [math.hypot(b.forward - a.forward, b.left - a.left) for a, b in itertools.pairwise(commands)]
    assert max(steps) <= 4 * 2.0 * PERIOD_S + 1e-6  # set-points lead the velocity in order to change it


def test_the_tilt_is_within_the_limit() -> None:
    settings = ChaseSettings(tilt_rad=0.1)
    world = ChaseWorld(walk(8.0, 1.0, 1.5), settings=settings, relative=True)
    world.run(5.0)
    tilts = [math.hypot(one.roll, one.pitch) for one in world.commands if isinstance(one, Attitude)]
    assert 0.08 < max(tilts) < 0.102


# Losses ------------------------------------------------------------------------------------------------------------


def first(world: ChaseWorld, phase: TargetPhase) -> float:
    return world.phases.index(phase) * PERIOD_S


@pytest.mark.parametrize("relative", [False, True], ids=["velocity", "attitude"])
def test_a_lost_target_is_awaited_searched_for_and_given_up(relative: bool) -> None:
    settings = ChaseSettings(predict_s=2.0, hover_s=3.0, give_up_s=12.0)
    world = ChaseWorld(walk(4.0, 0.0, 0.0, 1.0), settings=settings, hidden=after(5.0), relative=relative)
    world.run(20.0)
    order = list(dict.fromkeys(world.phases))
    assert order[-5:] == [
        TargetPhase.FOLLOWING,
        TargetPhase.PREDICTING,
        TargetPhase.HOVERING,
        TargetPhase.SEARCHING,
        TargetPhase.GIVEN_UP,
    ]
    assert set(order[-4:]) == LOSSES
    lost_s = 5.0 + settings.seen_s
    assert first(world, TargetPhase.PREDICTING) == pytest.approx(lost_s, abs=0.15)
    assert first(world, TargetPhase.HOVERING) == pytest.approx(lost_s + 2.0, abs=0.15)
    assert first(world, TargetPhase.SEARCHING) == pytest.approx(lost_s + 5.0, abs=0.15)
    assert first(world, TargetPhase.GIVEN_UP) == pytest.approx(17.0, abs=0.15)
    assert world.law.off_m is None
    for phase, command in zip(world.phases, world.commands, strict=True):
        if phase is TargetPhase.SEARCHING:
            assert abs(turn(command)) == pytest.approx(settings.search_rad_s)
            assert turn(command) > 0.0, "it went out of sight on the left"
        if phase is TargetPhase.GIVEN_UP:
            assert turn(command) == 0.0
        if phase in LOSSES - {TargetPhase.PREDICTING} and isinstance(command, Attitude):
            assert math.hypot(command.roll, command.pitch) < 0.05, "only what brings it to rest"
    assert translation(world.commands[-1]) < 0.01


def test_while_hovering_it_looks_to_both_sides_of_the_expected_place() -> None:
    settings = ChaseSettings(predict_s=1.0, hover_s=6.0, search_rad_s=0.7, sweep_rad=0.6)
    world = ChaseWorld(walk(4.0, 0.0), settings=settings, hidden=after(3.0), seed=None)
    world.run(9.0)
    azimuths = [-one for one, phase in zip(world.azimuths, world.phases, strict=True) if phase is TargetPhase.HOVERING]
    assert max(map(abs, azimuths)) == pytest.approx(0.6, abs=0.12)
    assert min(max(azimuths), -min(azimuths)) == pytest.approx(0.24, abs=0.1), "a smaller angle to the other side"
    passed = [n for n, (a, b) in enumerate(itertools.pairwise(azimuths)) if a * b < 0.0]
    assert len(passed) >= 3, "back and forth"


def test_it_turns_to_a_possible_match_of_the_lost_target() -> None:
    law, estimator = still_law()
    other = still_law(away=(4.0, 2.5))[1]
    for hover_s, phase in ((10.0, TargetPhase.HOVERING), (0.1, TargetPhase.SEARCHING)):
        law.settings = replace(law.settings, hover_s=hover_s)
        for at_s in (4.0, 4.1):
            at = motion(at_s)
            seen = other.at(at.at_ns)
            command = law.step(at.at_ns, at, 1.2, estimator, nanoseconds(1.0), candidate=seen)
        assert law.phase is phase
        assert turn(command) == pytest.approx(2.2 * math.atan2(2.5, 4.0), abs=0.2)


def turn(command: object) -> float:
    assert isinstance(command, Velocity | Attitude)
    return command.yaw_rate


def translation(command: object) -> float:
    if isinstance(command, Attitude):
        return math.hypot(command.roll, command.pitch)
    assert isinstance(command, Velocity)
    return math.hypot(command.forward, command.left)


@pytest.mark.parametrize("speed", [0.5, 1.5])
def test_it_does_not_fly_towards_a_hidden_target(speed: float) -> None:
    """The occluder may be in the way: the set-point has no component towards it, and fades."""
    world = ChaseWorld(walk(4.0, 0.0, speed, 0.5), hidden=after(5.0))
    world.run(9.0)
    lost = [n for n, phase in enumerate(world.phases) if phase is TargetPhase.PREDICTING]
    towards = [command.forward for n in lost[10:] if isinstance(command := world.commands[n], Velocity)]
    assert max(towards) < 0.1, "once the acceleration limit lets it brake"
    sizes = [translation(world.commands[n]) for n in lost]
    assert sizes[-1] < 0.25 * sizes[0] + 0.05
    hovering = [n for n, phase in enumerate(world.phases) if phase is TargetPhase.HOVERING]
    assert all(translation(world.commands[n]) < 1e-6 for n in hovering[PER_S // 2 :])


def test_a_returning_target_is_followed_again() -> None:
    world = ChaseWorld(walk(4.0, 0.0, 0.0, 0.5), hidden=lambda t: 5.0 <= t < 7.0)
    world.run(14.0)
    assert TargetPhase.PREDICTING in world.phases
    assert world.phases[-1] is TargetPhase.FOLLOWING
    assert world.ranges[-1] == pytest.approx(4.0, abs=0.5)


def test_an_unseen_target_is_searched_for_on_the_spot() -> None:
    world = ChaseWorld(walk(-4.0, 0.0), hidden=lambda t: True)
    world.run(4.0)
    assert set(world.phases) == {TargetPhase.LOOKING}
    assert all(turn(one) == pytest.approx(0.7) for one in world.commands)
    assert world.places[-1][:2].tolist() == [0.0, 0.0]
    world.run(25.0)
    assert world.phases[-1] is TargetPhase.GIVEN_UP


# Heights -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "height"),
    [
        ({}, 1.2),
        ({"height_m": 1.6}, 1.6),
        ({"height_m": 0.9}, 0.9),
        ({"lowest_m": 1.5}, 1.5),
        ({"highest_m": 1.0}, 1.0),
    ],
)
@pytest.mark.parametrize("relative", [False, True], ids=["velocity", "attitude"])
def test_the_height_is_kept(given: dict[str, float], height: float, relative: bool) -> None:
    world = ChaseWorld(walk(4.0, 0.0), settings=ChaseSettings(**given), relative=relative)
    world.run(8.0)
    assert world.places[-1][2] == pytest.approx(height, abs=0.12)


def test_it_does_not_climb_out_of_sight_of_the_target() -> None:
    settings = ChaseSettings(height_m=4.0, steep_rad=0.25)
    world = ChaseWorld(walk(4.0, 0.0), settings=settings)
    world.run(10.0)
    assert 1.5 < world.places[-1][2] < 0.86 + 4.4 * math.tan(0.25) + 0.1


def test_without_a_height_above_the_ground_the_height_is_left_alone() -> None:
    world = ChaseWorld(walk(4.0, 0.0, 0.3), altitude=False, settings=ChaseSettings(height_m=2.0))
    world.run(4.0)
    assert all(one.up == 0.0 for one in world.commands if isinstance(one, Velocity))


# Hostile times and settings ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("later_s", [-0.5, 0.0, 0.02, 3.0, 1000.0])
def test_any_time_gives_a_finite_set_point(later_s: float) -> None:
    for relative in (False, True):
        law, estimator = still_law()
        law.step(nanoseconds(1.0), motion(), 1.2, estimator, estimator.seen_ns, relative=relative)
        command = law.step(nanoseconds(1.0 + later_s), motion(), 1.2, estimator, estimator.seen_ns, relative=relative)
        parts = [getattr(command, name) for name in command.__struct_fields__]
        assert np.isfinite([one for one in parts if isinstance(one, float)]).all()


def test_a_target_at_its_own_place_gives_a_finite_set_point() -> None:
    for relative in (False, True):
        for mode in FollowMode:
            law, estimator = still_law()
            law.mode = mode
            at = motion(position=np.array([*estimator.at(nanoseconds(1.15)).foot[:2], 0.0]))
            command = law.step(at.at_ns, at, 1.2, estimator, at.at_ns, relative=relative)
            assert math.isfinite(translation(command) + turn(command))


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"distance_m": 2.0}, r"distance_m is 2 and must be above nearest_m, which is 2"),
        ({"distance_m": 0.0}, r"distance_m is 0\.0 and must be above 0"),
        ({"distance_m": math.nan}, "distance_m is nan and must be a finite number"),
        ({"distance_m": math.inf}, "distance_m is inf and must be a finite number"),
        ({"distance_m": "4"}, "distance_m is '4' and must be a finite number"),
        ({"distance_m": None}, "distance_m is None and must be a finite number"),
        ({"nearest_m": -1.0}, r"nearest_m is -1\.0 and must be above 0"),
        ({"bearing_rad": math.nan}, "bearing_rad is nan"),
        ({"leash_m": 0.0}, "leash_m is 0.0 and must be above 0"),
        ({"leash_m": -2}, "leash_m is -2 and must be above 0"),
        ({"height_m": -1.0}, "height_m is -1.0 and must be above 0"),
        ({"orbit_m_s": math.inf}, "orbit_m_s is inf"),
        ({"lowest_m": 5.0}, "lowest_m is 5 and must be at most highest_m, 4"),
        ({"range_gain": 0.0}, "range_gain is 0.0 and must be above 0"),
        ({"speed_m_s": True}, "speed_m_s is True and must be a finite number"),
        ({"give_up_s": -1.0}, "give_up_s is -1.0"),
    ],
)
def test_invalid_settings_are_refused(given: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        ChaseSettings(**given)


@pytest.mark.parametrize(
    "given", [{"bearing_rad": -3.0}, {"bearing_rad": 0}, {"orbit_m_s": -1.0}, {"velocity_gain": 0.0}, {"leash_m": 5}]
)
def test_valid_settings_are_accepted(given: dict[str, Any]) -> None:
    settings = ChaseSettings(**given)
    assert all(getattr(settings, name) == value for name, value in given.items())


def test_settings_are_clamped_to_the_drones_limits() -> None:
    limits = {"limits.speed": 1.5, "limits.climb": 0.3, "limits.yaw_rate": 0.9, "limits.altitude": 0.7}
    found = ChaseSettings().within(limits | {"limits.tilt": 0.21, "autopilot.kind": "sim"})
    assert (found.speed_m_s, found.climb_m_s, found.turn_rad_s) == (1.5, 0.3, 0.9)
    assert (found.lowest_m, found.highest_m) == (0.7, 0.7)
    assert (found.tilt_rad, found.lean_rad) == (0.21, 0.21)
    wide: dict[str, Value] = {**dict.fromkeys(limits, 100.0), "limits.tilt": True, "limits.speed": "fast"}
    assert ChaseSettings().within(wide) == ChaseSettings().within({}) == ChaseSettings()


def test_the_model_knows_a_smaller_lean_limit() -> None:
    """Otherwise the weak response counts as a trim of its loop, and it overshoots for seconds."""
    for lean_rad, most in ((0.5, 0.5), (0.21, 0.21)):
        assert ChaseLaw(ChaseSettings(lean_rad=lean_rad))._response.settings.tilt_rad == most
