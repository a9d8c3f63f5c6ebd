"""``skyloop detect``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import skyloop
from skyloop.cli.process import DetectionProcessor
from skyloop.messages import Annotation, Polyline, Text
from skyloop.vision import Detection
from tests.support.commands import Run
from tests.support.networks import write
from tests.support.processes import Process

pytestmark = pytest.mark.process

PATIENCE_S = 40.0  # a detector imports and loads much before its first result

ONE_PERSON = """
[room]
size = [20, 20, 8]
floor = "grass"
enclosed = false

[[spawn]]
position = [-3, 0, 0]

[[target]]
name = "anna"
kind = "figure"
shape = "person"
path = { kind = "still", position = [0, 0, 0] }
yaw = { mode = "fixed", yaw_deg = 180 }
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    output = np.zeros((1, 300, 6), np.float32)
    output[0, 0] = [10, 20, 40, 44, 0.9, 1]
    output[0, 1] = [50, 20, 70, 44, 0.8, 0]
    return write(tmp_path / "my.onnx", {"output0": output}, metadata={"names": "{0: 'person', 1: 'car', 2: 'box'}"})


def test_detections_become_results_and_are_drawn() -> None:
    found = [Detection((1.0, 2.0, 3.0, 4.0), 0.9, 1, "car"), Detection((5.0, 6.0, 7.0, 8.0), 0.8, 0, "person")]

    class Detector:
        def detect(self, image: object) -> list[Detection]:
            return found * 40

    every = DetectionProcessor(Detector()).process(np.zeros((9, 9, 3), np.uint8))  # type: ignore[arg-type]
    assert len(every.value["detections"]) == 64
    assert len(every.shapes) == 128
    cars = DetectionProcessor(Detector(), ["car"]).process(np.zeros((9, 9, 3), np.uint8))  # type: ignore[arg-type]
    assert cars.value["detections"][0] == {
        "box": [1.0, 2.0, 3.0, 4.0],
        "score": 0.9,
        "class_id": 1,
        "class_name": "car",
    }
    assert {each["class_name"] for each in cars.value["detections"]} == {"car"}
    outline, text = cars.shapes[:2]
    assert outline == Polyline(((1.0, 2.0), (4.0, 2.0), (4.0, 6.0), (1.0, 6.0)), closed=True)
    assert text == Text("car 0.90", (1.0, 2.0))


def test_impossible_arguments_are_reported(run: Run, file: Path) -> None:
    for arguments, words in [
        (("nowhere.onnx", "--on", "alpha"), "there is no file nowhere.onnx"),
        ((str(file), "--on", "alpha", "--classes", "cra"), "did you mean 'car'"),
        ((str(file), "--on", "alpha", "--layout", "x"), "must be one of"),
        (("--on", "alpha", "--classes", "persn"), "no class in figures.onnx named 'persn'; did you mean 'person'"),
    ]:
        ended = run("detect", *arguments)
        assert ended.code == 2
        assert words in ended.err
        assert "Traceback" not in ended.err


@pytest.mark.daily
def test_detections_are_drawn_with_the_time_of_their_frame(sockets: Path, file: Path) -> None:
    proxy = Process("-m", "skyloop", "proxy", "sim://?world=empty&cameras=front&fps=20", "--name", "delta")
    worker = None
    try:
        proxy.until("ready")
        worker = Process("-m", "skyloop", "detect", str(file), "--on", "delta", "--classes", "car")
        with skyloop.connect("delta", access="observe") as drone:
            drawn: list[Annotation] = []
            drone.on_annotation(drawn.append)
            result = next(iter(drone.results("detections", timeout_s=PATIENCE_S)))
            assert [each["class_name"] for each in result.value["detections"]] == ["car"]
            drone.wait(lambda _: any(one.captured_ns >= result.captured_ns for one in drawn), PATIENCE_S)
            assert {one.source for one in drawn} == {"detections"}
    finally:
        for process in (worker, proxy):
            if process is not None:
                process.end()


def test_without_a_file_the_simulators_figures_are_found(sockets: Path, tmp_path: Path) -> None:
    world = tmp_path / "one.toml"
    world.write_text(ONE_PERSON, encoding="utf-8")
    proxy = Process("-m", "skyloop", "proxy", f"sim://?world={world}&cameras=front&fps=20", "--name", "epsilon")
    worker = None
    try:
        proxy.until("ready")
        worker = Process("-m", "skyloop", "detect", "--on", "epsilon")
        with skyloop.connect("epsilon", access="observe") as drone:
            for result in drone.results("detections", timeout_s=PATIENCE_S):
                found = result.value["detections"]
                if found:
                    break
            assert [each["class_name"] for each in found] == ["person"]
    finally:
        for process in (worker, proxy):
            if process is not None:
                process.end()
