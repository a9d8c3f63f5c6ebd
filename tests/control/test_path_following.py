"""Paths and waypoints flown by all of Skyloop in simulated time, with noise, delay and loss."""

from __future__ import annotations

import importlib.util
import itertools
import math
from pathlib import Path as File
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from skyloop.client import Drone
from skyloop.control import Circle, DeadReckoning, Fix, FixedYaw, FollowPath, Polyline, Waypoint, Waypoints
from skyloop.errors import AuthorityError, UsageError
from skyloop.messages import Failsafe, Feedback
from skyloop.stepping.rehearsal import Radio, rehearse

CALM = "sim://?world=empty&cameras=none&wind=0"


def truth(feedback: Feedback) -> np.ndarray:
    assert feedback.native is not None
    return np.array([feedback.native[f"truth.{axis}"] for axis in "xyz"], dtype=np.float64)


@pytest.fixture(scope="module")
def errors() -> ModuleType:
    """The measuring script."""
    spec = importlib.util.spec_from_file_location(
        "control_errors", File(__file__).parents[2] / "scripts" / "control_errors.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("gust", "seed"), [(0.0, 0), (0.0, 1), (1.0, 0), (1.0, 4)])
def test_waypoint_square_is_flown_accurately(errors: ModuleType, gust: float, seed: int) -> None:
    result = errors.fly(errors.FLIGHTS["waypoint square of 2 m at 0.5 m/s"], seed, gust)
    assert result.done
    assert result.to_path.rms_m <= errors.TARGET_M
    assert result.across.rms_m <= result.to_path.rms_m
    assert result.to_path.samples > 500


@pytest.mark.parametrize(
    "name", ["circle of 1 m at 0.7 m/s, looking ahead", "eight of 3 m at 0.8 m/s, looking at a point"]
)
def test_curves_are_flown_accurately(errors: ModuleType, name: str) -> None:
    result = errors.fly(errors.FLIGHTS[name], 2)
    assert result.done
    assert result.to_path.rms_m < 0.1


def test_two_flights_with_the_same_seeds_are_the_same(errors: ModuleType) -> None:
    first, second = (errors.fly(lambda drone: Waypoints(drone, [(0.5, 0, 1), (0.5, 0.5, 1)]), 3, 0.5) for _ in range(2))
    assert first.to_path.rms_m == second.to_path.rms_m
    assert first.to_path.samples == second.to_path.samples


def test_waypoints_are_reached_and_held_at_their_yaw() -> None:
    with rehearse(CALM) as drone:
        drone.takeoff()
        seen: list[tuple[int, float, np.ndarray, float]] = []
        flight = Waypoints(drone, [Waypoint(0.5, 0, 1, yaw=1.0), (0.5, 0.4, 1.2)], hold_s=1.0, yaw=FixedYaw(-0.5))
        drone.on_feedback(lambda f: seen.append((flight.reached, f.captured_ns / 1e9, truth(f), f.yaw_rad or 0.0)))
        summary = flight.run(seconds=40.0)
        assert summary.reason == "stopped"
        assert flight.done
        assert flight.reached == 2
        near = [s for s in seen if s[0] == 0 and np.linalg.norm(s[2] - [0.5, 0, 1]) < 0.2 and abs(s[3] - 1.0) < 0.2]
        assert near[-1][1] - near[0][1] > 0.9, "it stayed for the wanted time"
        assert np.linalg.norm(seen[-1][2] - [0.5, 0.4, 1.2]) < 0.2
        assert seen[-1][3] == pytest.approx(-0.5, abs=0.2), "without a yaw of its own, the flight's"
        assert 0.0 < flight.error.rms_m < 0.15
        assert flight.error.largest_m >= flight.error.rms_m


def test_a_path_begins_at_its_start() -> None:
    with rehearse(CALM) as drone:
        drone.takeoff()
        flight = FollowPath(drone, Polyline([(0.8, 0.5, 1.2), (0.8, -0.3, 1.2)]))
        assert flight.run(seconds=30.0).reason == "stopped"
        assert flight.on_path
        assert np.linalg.norm(truth(drone.feedback()) - [0.8, -0.3, 1.2]) < 0.25
        assert flight.error.samples < 250, "the flight to the start does not count"
        assert drone.wait("hovering").state == "hovering"


class Capture:
    """Scripted motion capture: the true place, 30 ms old, with a gap."""

    def __init__(self, drone: Drone) -> None:
        self.blind = False
        self.frozen = False
        self._newest: Fix | None = None
        drone.on_feedback(self._take)

    def _take(self, feedback: Feedback) -> None:
        if not self.frozen:
            x, y, z = truth(feedback).tolist()
            self._newest = Fix(feedback.captured_ns, (x, y, z), feedback.yaw_rad or 0.0)

    def __call__(self) -> Fix | None:
        return None if self.blind else self._newest


@pytest.mark.parametrize("how", ["blind", "frozen"])
def test_another_source_of_positions_and_its_loss(how: str) -> None:
    with rehearse("sim://?world=empty&cameras=none&wind=0") as drone:
        drone.takeoff()
        capture = Capture(drone)
        drone.next_feedback()
        flight = FollowPath(drone, Circle((0, 0, 1), 0.5), source=capture, max_age_s=0.2)
        flight.run(seconds=6.0)
        assert flight.on_path
        assert not flight.lost
        setattr(capture, how, True)
        flight.run(seconds=1.0)
        assert flight.lost
        assert drone.feedback().state == "hovering"
        setattr(capture, how, False)
        assert flight.run(seconds=30.0).reason == "stopped"
        assert flight.done
        texts = [event.text for event in drone.recent_events()]
        assert "the position is not known: hovering" in texts
        assert "the position is known again: continuing" in texts
        assert flight.error.rms_m < 0.2


def test_a_fix_with_nan_is_ignored() -> None:
    """One NaN from a position source made the vehicle climb forever."""
    with rehearse("sim://?world=empty&cameras=none&wind=0") as drone:
        drone.takeoff()
        capture = Capture(drone)
        drone.next_feedback()

        def source() -> Fix | None:
            fix = capture()
            if fix is None or len(wrong) == 3:
                return fix
            wrong.append(fix)
            return fix._replace(yaw_rad=math.nan)

        wrong: list[Fix] = []
        flight = Waypoints(drone, [(0.5, 0, 1)], source=source)
        assert flight.run(seconds=30.0).reason == "stopped"
        assert len(wrong) == 3
        assert np.linalg.norm(truth(drone.feedback()) - [0.5, 0, 1]) < 0.25
        assert "the position is not known: hovering" in [event.text for event in drone.recent_events()]


def test_a_path_waits_without_integrating_while_another_client_flies() -> None:
    with rehearse(CALM) as drone:
        drone.takeoff()
        flight = FollowPath(drone, Polyline([(0, 0, 1), (5, 0, 1)]))
        flight.run(seconds=3.0)
        assert flight._law is not None
        taken = flight._law.time_s

        drone.release_authority()
        feedback = drone.feedback()
        for k in range(1, 400):
            later = replace(feedback, captured_ns=feedback.captured_ns + k * 25_000_000, position_m=(0.0, 0.4, 1.0))
            with pytest.raises(AuthorityError):
                flight.on_feedback(later)
        assert flight._law.time_s == taken
        assert not flight._law._loop.integral.any()


@pytest.mark.parametrize("taken", [{"others": "the pilot's switch"}, {"failsafe": Failsafe.HOVER}])
def test_a_path_waits_while_its_set_points_have_no_effect(taken: dict[str, Any]) -> None:
    """Without notice to the program: a safety pilot's mode switch leaves it the authority."""
    with rehearse(CALM) as drone:
        drone.takeoff()
        flight = FollowPath(drone, Polyline([(0, 0, 1), (5, 0, 1)]))
        flight.run(seconds=3.0)
        assert flight._law is not None
        begun, feedback = flight._law.time_s, drone.feedback()
        for k in range(1, 200):
            at_ns = feedback.captured_ns + k * 25_000_000
            flight.on_feedback(replace(feedback, captured_ns=at_ns, position_m=(0.0, 0.4, 1.0), **taken))
        assert flight._law.time_s == begun
        assert not flight._law._loop.integral.any()


def test_a_finished_flight_does_not_restart_and_run_returns() -> None:
    """The second run waited forever for an end already reached."""
    with rehearse(CALM) as drone:
        drone.takeoff()
        flight = Waypoints(drone, [(0.3, 0, 1)])
        assert flight.run(seconds=20.0).reason == "stopped"
        again = flight.run(seconds=20.0)
        assert (again.reason, again.feedback) == ("stopped", 0)


def test_a_vehicle_without_position_flies_by_its_velocity() -> None:
    with rehearse("sim://?world=empty&cameras=none&wind=0&seed=2") as drone:
        drone.takeoff()
        begin = truth(drone.feedback())
        reckoning = DeadReckoning(drone, (begin[0], begin[1]))
        drone.next_feedback()
        flight = Waypoints(drone, [(1, 0, 1), (1, 1, 1), (1, 1, 1.2)], source=reckoning, hold_s=0.2)
        assert flight.run(seconds=40.0).reason == "stopped"
        assert flight.error.rms_m < 0.1, "as it believes"
        assert np.linalg.norm(truth(drone.feedback()) - [1, 1, 1.2]) < 0.6, "it drifts by the velocity's error"
        last = reckoning()
        reckoning.close()
        drone.next_feedback()
        drone.next_feedback()
        assert reckoning() == last


def test_the_same_waypoint_twice_works() -> None:
    with rehearse(CALM) as drone:
        drone.takeoff()
        flight = Waypoints(drone, [(0.3, 0, 1), (0.3, 0, 1)], hold_s=0.3)
        assert flight.run(seconds=20.0).reason == "stopped"
        assert flight.reached == 2


def test_impossible_flights_are_refused() -> None:
    with rehearse("sim://?world=empty&cameras=none&position=none") as drone:
        with pytest.raises(UsageError, match=r"does not report its position: .*give the controller a position source"):
            FollowPath(drone, Circle((0, 0, 1), 0.5)).run(seconds=1.0)
        with pytest.raises(UsageError, match="no waypoint"):
            Waypoints(drone, [])
        with pytest.raises(UsageError, match="hold_s"):
            Waypoints(drone, [(0, 0, 1)], hold_s=-1.0)
        with pytest.raises(UsageError, match="speed_m_s"):
            Waypoints(drone, [(0, 0, 1)], speed_m_s=math.inf)
        with pytest.raises(UsageError, match="max_age_s"):
            Waypoints(drone, [(0, 0, 1)], max_age_s=0.0)


@pytest.mark.parametrize("wrong", [{"drop": 1.0}, {"command_delay_s": -0.1}, {"position_noise_m": math.nan}])
def test_invalid_radio_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        Radio(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("uri", ["sim://?speed=3", "replay://x.mcap", "nonsense"])
def test_addresses_that_cannot_be_rehearsed_are_refused(uri: str) -> None:
    with pytest.raises(UsageError), rehearse(uri):
        pass


def test_frames_arrive_in_simulated_time() -> None:
    pytest.importorskip("cv2", reason="pictures are drawn with OpenCV")
    radio = Radio(drop=0.0, picture_delay_s=0.1)
    with rehearse("sim://?cameras=front&fps=10", radio=radio) as drone:
        frames = drone.frames()
        first, second = next(frames), next(frames)
        frames.close()  # type: ignore[attr-defined]
        assert first.shape == (240, 320, 3)
        assert first.std() > 5.0, "it shows something"
        assert (second.captured_ns - first.captured_ns) / 1e9 == pytest.approx(0.1, abs=0.01)
        assert second.age_s == pytest.approx(0.13, abs=0.015), "the camera's own delay and the radio's"
        assert second.feedback is not None


def test_frames_are_lost_on_the_way() -> None:
    with rehearse("sim://?world=empty&cameras=front&fps=15", radio=Radio(drop=0.5)) as drone:
        frames = drone.frames()
        seen = [next(frames).captured_ns for _ in range(8)]
        frames.close()  # type: ignore[attr-defined]
        assert max(later - before for before, later in itertools.pairwise(seen)) > 0.1e9
