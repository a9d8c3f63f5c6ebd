"""npm's @foxglove/ws-protocol 0.8.0 and protobufjs, both independent, read what ``skyloop view --foxglove`` serves.

While a simulated drone flies, every topic is decoded by the schema that the server sends for it.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import skyloop
from skyloop.extend import join_processor
from skyloop.messages import Polyline
from tests.integration.third_party.conftest import HERE, PATIENCE_S, absent, node_modules
from tests.support.processes import Process

pytestmark = pytest.mark.process
SIM = "sim://?world=room&seed=1&cameras=front"
TOPICS = {
    "/alpha/annotations": "skyloop.Annotation",
    "/alpha/camera/front/annotations": "foxglove.ImageAnnotations",
    "/alpha/camera/front/calibration": "foxglove.CameraCalibration",
    "/alpha/camera/front/image": "foxglove.CompressedImage",
    "/alpha/commands": "skyloop.Applied",
    "/alpha/events": "skyloop.Event",
    "/alpha/feedback": "skyloop.Feedback",
    "/alpha/frames/front": "skyloop.FrameRecord",
    "/alpha/logs": "skyloop.LogEntry",
    "/alpha/mocap": "foxglove.PoseInFrame",
    "/alpha/parameters": "skyloop.Parameter",
    "/alpha/path": "foxglove.PosesInFrame",
    "/alpha/pose": "foxglove.PoseInFrame",
    "/alpha/results": "skyloop.ResultRecord",
    "/log": "foxglove.Log",
    "/tf": "foxglove.FrameTransform",
}


@pytest.fixture
def modules() -> Path:
    pytest.importorskip("foxglove")
    found = node_modules("@foxglove/ws-protocol", "0.8.0")
    if not (found / "protobufjs").exists() or not (found / "ws").exists():
        absent("npm's protobufjs or ws is not installed (run scripts/third-party.sh)")
    return found


@pytest.fixture
def proxy(monkeypatch: pytest.MonkeyPatch) -> Iterator[Process]:
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        process = Process("-m", "skyloop", "proxy", SIM, "--name", "alpha")
        process.until("ready")
        yield process
        process.end()


def test_every_topic_is_decoded_while_a_drone_flies(modules: Path, proxy: Process) -> None:
    view = Process("-m", "skyloop", "view", "alpha", "--foxglove", "--write", "--port", "0")
    try:
        view.until("\n")
        url = re.search(r"ws://\S+", view.text)
        assert url is not None
        seen = flown_and_seen(modules, url[0])
    finally:
        view.end()
    assert seen["errors"] == []
    assert {topic: found["schema"] for topic, found in seen["topics"].items()} == TOPICS
    first = {topic: found["first"] for topic, found in seen["topics"].items()}
    assert first["/alpha/camera/front/image"]["format"] == "jpeg"
    assert first["/alpha/camera/front/image"]["data"].startswith("/9j/")  # a JPEG, in base64
    assert first["/alpha/results"]["value"] == {"score": 0.5}
    assert first["/alpha/camera/front/annotations"]["points"]
    assert first["/alpha/feedback"]["battery"] > 0.5
    # Parameters: read, and refused while another application flies.
    assert "alpha/limits.tilt" in seen["parameters"]
    (refused,) = seen["status"]
    assert "alpha/limits.tilt was not written" in refused
    assert "pilot" in refused
    assert seen["answers"]["set"][0]["value"] == seen["parameters"]["alpha/limits.tilt"]


def flown_and_seen(modules: Path, url: str) -> dict[str, Any]:
    """Fly, draw and log until the viewer has seen everything; return the viewer's report."""
    order = {
        "url": url,
        "wanted": sorted(TOPICS),
        "set": {"name": "alpha/limits.tilt", "value": 0.1},
        "timeout_s": PATIENCE_S / 2,
    }
    with skyloop.connect("alpha", name="pilot") as drone:
        drone.takeoff()
        environment = {**os.environ, "NODE_PATH": str(modules)}
        node = ["node", str(HERE / "look_foxglove.js"), json.dumps(order)]
        with subprocess.Popen(node, stdout=subprocess.PIPE, text=True, env=environment) as viewer:
            worker = join_processor(drone, "detector", code="Detector 1")
            for threshold in itertools.cycle((0.1, 0.2)):
                if viewer.poll() is not None:
                    break
                drone.velocity(yaw_rate=0.3)
                drone.config["alarms.battery_critical"] = threshold  # it causes an event
                frame = drone.next_frame(timeout_s=10.0)
                drone.annotate(frame, [Polyline(((1.0, 1.0), (5.0, 5.0)))], source="tracker")
                worker.publish(frame, {"score": 0.5})
                drone.log.text("looking around")
                drone.log.array("mocap", [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
            assert viewer.stdout is not None
            seen: dict[str, Any] = json.loads(viewer.stdout.read())
        drone.land()
    return seen
