"""Behaviours flown by all of Skyloop in simulated time, with one or two seeds each; the script flies all seeds."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import msgspec
import numpy as np
import pytest
from see_and_avoid import SeeAndAvoid

from skyloop.control import (
    RACE_TRACK,
    FlowHover,
    FlyThroughGates,
    GateKind,
    ImageServo,
    LandOnMarker,
    course_in,
)
from skyloop.control.course_law import CourseSettings
from skyloop.control.gate_law import GatePhase, GateSettings
from skyloop.control.landing_law import LandingPhase, LandingSettings
from skyloop.errors import AuthorityError, UnknownNameError, UsageError
from skyloop.messages import (
    Annotation,
    Attitude,
    Feedback,
    FlightState,
    Hover,
    Land,
    LinkState,
    Severity,
    Velocity,
)
from skyloop.sim.camera import BOTTOM_CAMERA
from skyloop.sim.world import geometry_of
from skyloop.sim.world_file import load_world
from skyloop.stepping.rehearsal import Radio, rehearse
from tests.support.scripted_proxy import WAIT_S, flown, scripted


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    """The measuring script."""
    path = Path(__file__).parents[2] / "scripts" / "behaviours.py"
    spec = importlib.util.spec_from_file_location("behaviours", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(path.parent))  # it imports modules beside it
        spec.loader.exec_module(module)
        yield module


def test_a_landing_taken_over_restarts_when_control_returns() -> None:
    """The law stayed in phase DOWN and landed the vehicle from any height, wherever it was."""
    with rehearse("sim://?world=empty&cameras=bottom&fps=10") as drone:
        drone.takeoff()
        pilot = LandOnMarker(drone)
        pilot._landing_law.phase = LandingPhase.DOWN
        drone.release_authority()
        with suppress(AuthorityError):
            pilot.run(seconds=0.5)
        assert pilot.phase is LandingPhase.SEARCHING
        drone.request_authority()
        pilot.run(seconds=1.0)
        assert not pilot.landed
        assert drone.feedback().state is FlightState.FLYING
        drone.land()
        assert pilot.run(seconds=5.0).reason == "stopped", "another client landed it"
        assert not pilot.landed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed", "gust"),
    [
        ("gates", 0, 0.0),
        ("gates", 3, 1.0),
        ("race-0", 1, 0.0),
        ("race-2", 1, 0.0),
        ("race-3", 1, 0.0),
        ("landing", 0, 0.0),
        ("landing", 3, 1.0),
        ("landing-1-turning", 0, 1.0),
        ("landing-3-straight", 0, 0.0),
        ("approach", 1, 1.0),
    ],
)
def test_reaches_its_goal(script: ModuleType, name: str, seed: int, gust: float) -> None:
    flight = script.GOALS[name].fly(seed, gust)
    assert flight.good, flight.note
    assert flight.seconds > 5.0


def test_follows_in_gusts(script: ModuleType) -> None:
    flight = script.follow(2, 1.0, seconds=20.0)
    assert flight.error_m <= script.FOLLOW_RMS_M


@pytest.mark.slow
@pytest.mark.parametrize("name", ["servo", "orbit", "avoid", "flow"])
def test_reaches_its_goal_in_calm_air(script: ModuleType, name: str) -> None:
    flight = script.GOALS[name].fly(1, 0.0)
    assert flight.good, flight.note


@pytest.mark.slow
def test_two_flights_with_the_same_seed_are_the_same(script: ModuleType) -> None:
    first, second = (script.avoid(4, 0.5) for _ in range(2))
    assert first == second


def test_summary_lists_what_was_missed(script: ModuleType) -> None:
    good, bad = script.Flight(True, 0.1, 10.0), script.Flight(False, math.nan, 90.0, "lost")
    text = script.summary(script.GOALS["landing"], 0.0, [good] * 17 + [bad] * 3)
    assert "17 of 20" in text
    assert text.endswith("missed")
    assert script.summary(script.GOALS["landing"], 0.0, [good] * 18 + [bad] * 2).endswith("met")


def test_how_a_landing_ended_is_judged_by_the_truth(script: ModuleType) -> None:
    def end(*places: tuple[FlightState, float, float, float]) -> str:
        return str(script.unsafe_end([script.Place(0, *place) for place in places]))

    flying, landed = FlightState.FLYING, FlightState.LANDED
    assert end((flying, 0.0, 0.1, 0.3), (landed, 0.1, 0.06, 0.26)) == ""
    assert end((flying, 3.0, 0.3, 0.5), (landed, 3.0, -0.14, 0.06)) == "", "on the floor"
    assert end((FlightState.HOVERING, 20.0, 2.4, 2.6)) == ""
    assert end((flying, 0.4, 0.2, 0.4)) == "still flies at 0.4 m"
    assert end((landed, 0.1, 0.3, 0.5), (landed, 2.0, -0.14, 0.06)) == "stopped its motors in the air"
    assert end((landed, 0.5, 0.06, 0.26), (landed, 0.9, -0.14, 0.06)) == "fell off the platform"
    assert end((FlightState.EMERGENCY, 0.5, 0.06, 0.26), (landed, 0.5, 0.06, 0.26)) == "crashed"


def test_a_landing_that_finds_nothing_ends_hovering_high_and_warns(tmp_path: Path) -> None:
    world = tmp_path / "empty.toml"
    world.write_text("[room]\nsize = [20, 20, 6]\n[[spawn]]\nposition = [0, 0, 0]\n")
    with rehearse(f"sim://?world={world}&cameras=bottom&fps=5") as drone:
        drone.takeoff()
        told: list[tuple[str, Severity]] = []
        drone.on_event(lambda event: told.append((event.text, event.severity)))
        landing = LandOnMarker(drone, settings=LandingSettings(give_up_s=4.0))
        landing.run(seconds=15.0)
        assert landing.done
        assert not landing.landed
        assert landing.phase is LandingPhase.GIVEN_UP
        assert ("landing: gave up: hovering at a safe height", Severity.WARNING) in told
        assert (drone.feedback().altitude_m or 0.0) > 2.2


def test_a_missing_gate_is_searched_for_but_not_flown_to(script: ModuleType) -> None:
    nowhere = GateKind("none", (0, 255, 255))
    with rehearse("sim://?world=gates&cameras=front&fps=15&wind=0") as drone:
        drone.takeoff()
        told: list[str] = []
        drawn: list[Annotation] = []
        drone.on_event(lambda event: told.append(event.text))
        drone.on_annotation(drawn.append)
        pilot = FlyThroughGates(drone, [nowhere])
        before = script.truth(drone.feedback())
        pilot.run(seconds=8.0)
        after = script.truth(drone.feedback())
        assert pilot.phase is GatePhase.SEARCHING
        assert pilot.passed == 0
        assert not pilot.done
        assert math.dist(after[:2], before[:2]) < 0.3, "it turns on the spot"
        assert "gates: searching for the gate" in told
        assert drawn
        assert drawn[-1].source == "gates"


@pytest.mark.slow
def test_when_frames_stop_it_hovers_and_reports_it() -> None:
    with rehearse("sim://?world=gates&cameras=front&fps=15&wind=0", radio=Radio(drop=0.0)) as drone:
        drone.takeoff()
        told: list[tuple[str, Severity]] = []
        drone.on_event(lambda event: told.append((event.text, event.severity)))
        pilot = FlyThroughGates(drone)
        pilot.run(seconds=2.0)
        drone.config["camera.front.fps"] = 0.1
        pilot.run(seconds=4.0)
        assert pilot.blind
        assert ("gates: no frames arrive: hovering", Severity.WARNING) in told
        assert drone.feedback().state == "hovering"
        drone.config["camera.front.fps"] = 15.0
        pilot.run(seconds=12.0)
        assert not pilot.blind
        assert ("gates: frames arrive again", Severity.INFO) in told


def test_a_landing_continues_after_a_short_loss_of_the_link() -> None:
    with scripted() as proxy, flown(proxy) as drone:
        proxy.state = FlightState.FLYING
        landing = LandOnMarker(drone)
        landing._landing_law.phase = LandingPhase.DOWN
        proxy.stop()
        until = time.monotonic() + WAIT_S
        while drone.link.application is not LinkState.LOST:
            assert time.monotonic() < until
            time.sleep(0.005)
        landing.steer(Velocity())
        proxy.start()
        drone.wait(lambda _: drone.authority.state == "held", WAIT_S)
        landing.steer(Velocity())
        proxy.until_commanded(Land())
        proxy.state = FlightState.LANDED


def test_flow_hover_hovers_while_the_ground_is_out_of_view() -> None:
    """It went level and kept its speed, although the vehicle can brake."""
    with ExitStack() as stack:
        proxy = stack.enter_context(scripted())
        proxy.capabilities = msgspec.structs.replace(proxy.capabilities, cameras=(BOTTOM_CAMERA.info(),))
        drone = stack.enter_context(flown(proxy))
        proxy.state = FlightState.FLYING
        drone.wait(lambda feedback: feedback.state is FlightState.FLYING, WAIT_S)
        hold = FlowHover(drone)
        now_ns = 1_000_000_000
        seen = Feedback(
            captured_ns=now_ns, state=FlightState.FLYING, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0, altitude_m=1.0
        )
        hold._flow_law.feedback(seen)
        hold.fly(now_ns)
        proxy.until_commanded(Hover())
        hold._flow_law.see(np.zeros(2), now_ns)
        hold.fly(now_ns)
        proxy.until(lambda: isinstance(proxy.actions()[-1], Attitude), "it flies by what it sees")
        after = len(proxy.commands)
        hold._flow_law.feedback(msgspec.structs.replace(seen, captured_ns=now_ns + 400_000_000))
        hold.fly(now_ns + 400_000_000)
        proxy.until_commanded(Hover(), after)
        warnings = [event.text for event in drone.recent_events() if event.severity is Severity.WARNING]
        assert "flow hover: lost the ground: hovering" in warnings


def test_invalid_arguments_are_refused() -> None:
    with rehearse("sim://?world=empty&cameras=front&native=velocity,hover,takeoff,land") as drone:
        with pytest.raises(UsageError, match="no gate"):
            FlyThroughGates(drone, [])
        with pytest.raises(UsageError, match="too grey"):
            FlyThroughGates(drone, [GateKind("grey", (100, 100, 100))])
        with pytest.raises(UsageError, match="give a Course"):
            FlyThroughGates(drone, settings=CourseSettings())
        with pytest.raises(UsageError, match="not GateSettings"):
            FlyThroughGates(drone, RACE_TRACK, settings=GateSettings())
        with pytest.raises(UnknownNameError, match="bottom"):
            LandOnMarker(drone)
        with pytest.raises(UsageError, match="distance_m"):
            SeeAndAvoid(drone, math.nan)
        with pytest.raises(UsageError, match="distance_m"):
            ImageServo(drone, 7, distance_m=0.0)
    with rehearse("sim://?world=empty&cameras=bottom") as drone:
        with pytest.raises(UsageError, match="does not face forward"):
            ImageServo(drone, 7, camera="bottom")
        assert FlowHover(drone).off_m is None


def test_a_course_is_built_from_a_world_by_gate_names() -> None:
    course = course_in(geometry_of(load_world("race0")))
    assert course.gates == RACE_TRACK.gates
    assert np.array(course.places) == pytest.approx(np.array(RACE_TRACK.places), abs=0.002)
    assert np.array(course.poles) == pytest.approx(np.array(RACE_TRACK.poles))
    assert course.start == RACE_TRACK.start
    with pytest.raises(UsageError, match="has no gate 1, gate 2"):
        course_in(geometry_of(load_world("empty")))
    with pytest.raises(UsageError, match="each gate needs one place"):
        replace(RACE_TRACK, places=RACE_TRACK.places[:1])
    with pytest.raises(UsageError, match="has no start"):
        course_in(msgspec.structs.replace(geometry_of(load_world("race0")), starts=()))


@pytest.mark.slow
def test_a_course_without_visible_gates_ends_with_a_warning() -> None:
    with rehearse("sim://?world=empty&cameras=fpv&fps=15&wind=0") as drone:
        told: list[tuple[str, Severity]] = []
        drone.takeoff()
        pilot = FlyThroughGates(drone, replace(RACE_TRACK, start=(-1.0, 2.0), poles=()))
        with drone.on_event(lambda event: told.append((event.text, event.severity))):
            pilot.run(seconds=90.0)
        assert ("gates: the gate is not seen where it should be", Severity.WARNING) in told
        assert pilot.passed == 0
