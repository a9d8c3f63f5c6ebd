"""ROS 2 from its wheels: programs without Skyloop fly its drones, and Skyloop's programs fly a ROS 2 robot.

``SKYLOOP_ROS_PYTHON`` is an interpreter with rclpy and Skyloop. The program that flies runs with
``SKYLOOP_ROS_PROGRAM_PYTHON``, in an environment without Skyloop, if that is set. Everything stays on loopback, in a
domain of this test alone.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from skyloop.vehicles.ros2.node import LOOPBACK_PROFILE, OLD_PROFILES_VARIABLE, PROFILES_VARIABLE
from tests.integration.third_party.conftest import HERE, absent

SECONDS = 30.0
IN_VIEW = 0.9

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]


@pytest.fixture
def sockets() -> Iterator[Path]:
    """A directory with a short path, as socket paths require."""
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        yield Path(folder) / "run"


@pytest.fixture
def python(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, sockets: Path) -> str:
    """The interpreter, with an environment that keeps ROS 2 on loopback, in a domain of this process alone."""
    python = os.environ.get("SKYLOOP_ROS_PYTHON")
    if not python:
        absent("SKYLOOP_ROS_PYTHON names no interpreter with rclpy and Skyloop: scripts/third-party.sh makes one")
    profile = tmp_path / "loopback.xml"
    profile.write_text(LOOPBACK_PROFILE)
    for variable in (PROFILES_VARIABLE, OLD_PROFILES_VARIABLE):  # whichever version of Fast DDS is installed
        monkeypatch.setenv(variable, str(profile))
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(sockets))
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("PYTHONPATH", str(HERE.parents[2] / "src"))
    return python


@pytest.fixture
def start(python: str) -> Iterator[Any]:
    children: list[subprocess.Popen[str]] = []

    def run(*arguments: str, interpreter: str = python, ready: str = "") -> subprocess.Popen[str]:
        child = subprocess.Popen([interpreter, *arguments], stdout=subprocess.PIPE, text=True)
        children.append(child)
        assert child.stdout is not None
        while ready:
            line = child.stdout.readline()
            assert line, f"{arguments} ended before it said {ready!r}"
            if line.startswith(ready):
                break
        return child

    yield run
    for child in reversed(children):
        if child.poll() is None:
            child.send_signal(signal.SIGCONT)
            child.send_signal(signal.SIGINT)
            try:
                child.wait(25)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait(10)
        if child.stdout is not None:
            child.stdout.close()


def outcome(child: subprocess.Popen[str], timeout_s: float) -> Any:
    out, _ = child.communicate(timeout=timeout_s)
    assert child.returncode == 0, out
    return json.loads(out.splitlines()[-1])


def test_a_ros_program_follows_the_marker_and_a_bag_reads_back(start: Any, python: str, tmp_path: Path) -> None:
    start("-m", "skyloop", "proxy", "sim://?world=room&seed=0", "--name", "alpha", ready="ready alpha")
    start("-m", "skyloop", "ros", "--drone", "alpha", "--map", "map", ready="ready /alpha")
    program = os.environ.get("SKYLOOP_ROS_PROGRAM_PYTHON", python)
    flight = start(str(HERE / "fly_rclpy.py"), "/alpha", str(SECONDS), interpreter=program)
    bag = outcome(start(str(HERE / "ros2_bag.py"), "/alpha", str(tmp_path / "bag")), 60)
    flown = outcome(flight, 90)
    assert flown["share_in_view"] >= IN_VIEW, flown
    assert flown["frames"] > SECONDS * 10

    assert bag["/alpha/odom"]["frame"] == "alpha/odom"
    assert bag["/alpha/imu/data"]["frame"] == "alpha/base_link"
    assert bag["/alpha/front/image_raw"]["frame"] == "alpha/front_optical_frame"
    height, width, encoding, size = bag["/alpha/front/image_raw"]["image"]
    assert (encoding, size) == ("bgr8", 3 * height * width)
    assert bag["/alpha/front/image_raw/compressed"]["count"] >= 10
    assert bag["/tf"]["children"] == ["alpha/base_link"]
    assert bag["/tf"]["type"] == bag["/tf_static"]["type"] == "tf2_msgs/msg/TFMessage"
    assert set(bag["/tf_static"]["children"]) >= {"alpha/front_optical_frame", "alpha/odom"}
    for rotation in (*bag["/tf"]["rotations"], *bag["/tf_static"]["rotations"]):
        assert math.hypot(*rotation) == pytest.approx(1.0)
    assert bag["/tf_static"]["count"] >= 1
    for topic, read in bag.items():
        assert topic == "/tf_static" or 0.0 < read["age_s"] < 2.0, (topic, read)


def test_a_ros_robot_passes_the_driver_suite(start: Any) -> None:
    robot = start(str(HERE / "ros2_robot.py"), "/robot", ready="ready")
    address = "ros2://robot?takeoff=takeoff&land=land&width=320&height=240&fps=15"
    outcomes = outcome(start(str(HERE / "ros2_suite.py"), address, str(robot.pid)), 120)
    failed = {name: text for name, text in outcomes.items() if text and not text.startswith("skipped")}
    assert not failed, "\n".join(failed.values())
    skipped = {name for name, text in outcomes.items() if text.startswith("skipped")}
    assert skipped <= {
        "test_emergency_stop_and_reset",  # the robot has none
        "test_pictures_as_they_come",  # it has no encoded stream
        "test_parameters_round_trip",
    }
    assert outcomes["test_flight"] == ""
