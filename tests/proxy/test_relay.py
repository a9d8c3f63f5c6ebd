"""External poses: permissions, delivery to the driver, and reports of refusals."""

from __future__ import annotations

import math

import pytest

from skyloop.drivers.base import ExternalPose
from skyloop.errors import DriverError
from skyloop.messages import EventKind, GetStatistics, Role, Statistics, VehiclePose, encode
from tests.support.proxy_bench import App, Bench

POSE = VehiclePose(3_000, (1.0, 2.0, 3.0), (0.1, 0.3, 0.5, 0.8062257748298549), 0.001, 0.01)


@pytest.fixture
def taken(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> list[ExternalPose]:
    """Record the driver's calls."""
    poses: list[ExternalPose] = []
    monkeypatch.setattr(bench.driver, "external_pose", poses.append)
    return poses


def refusals(app: App) -> list[tuple[object, str]]:
    app.sync()
    return [(event.data["reason"], event.text) for event in app.events if event.kind is EventKind.COMMAND_REFUSED]


def test_a_pilots_pose_reaches_the_driver_without_the_authority(bench: Bench, taken: list[ExternalPose]) -> None:
    app = bench.join("mocap")
    assert app.end.send(encode(POSE))
    app.sync()
    assert taken == [ExternalPose((1.0, 2.0, 3.0), (0.1, 0.3, 0.5, 0.8062257748298549), 3_000, 0.001, 0.01)]
    assert refusals(app) == []
    counts = app.ask(GetStatistics())
    assert isinstance(counts, Statistics)
    assert counts.counters["poses.told"] == 1


def test_an_observers_pose_is_refused(bench: Bench, taken: list[ExternalPose]) -> None:
    app = bench.join("onlooker", Role.OBSERVER)
    assert app.end.send(encode(POSE))
    [(reason, text)] = refusals(app)
    assert reason == "observer"
    assert "connect as a pilot" in text
    assert taken == []


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (VehiclePose(1, (math.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), "finite"),
        (VehiclePose(1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0)), "length 1"),
        (VehiclePose(1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), -1.0), "position_std_m is -1.0"),
    ],
)
def test_an_invalid_pose_is_refused(bench: Bench, taken: list[ExternalPose], pose: VehiclePose, said: str) -> None:
    app = bench.join("mocap")
    assert app.end.send(encode(pose))
    [(reason, text)] = refusals(app)
    assert reason == "non_finite"
    assert said in text
    assert taken == []


def test_a_vehicle_without_external_poses_is_reported(bench: Bench) -> None:
    app = bench.join("mocap")
    for _ in range(3):
        assert app.end.send(encode(POSE))
    [(reason, text)] = refusals(app)
    assert (reason, text) == ("unsupported", "mocap: pose refused: fake:// does not accept external poses")


def test_a_failing_driver_is_reported(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(pose: ExternalPose) -> None:
        raise DriverError("no data from the vehicle")

    monkeypatch.setattr(bench.driver, "external_pose", fail)
    app = bench.join("mocap")
    assert app.end.send(encode(POSE))
    [(reason, text)] = refusals(app)
    assert reason == "driver_failed"
    assert "no data from" in text
