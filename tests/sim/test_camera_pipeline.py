"""The rendering thread: replaced exposures, forgotten cameras, and failures."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns
from skyloop.messages.subscription import RateLimiter
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.sim.camera_pipeline import CameraPipeline, Exposure, PipelineCamera, Shutter, expose
from skyloop.sim.render import SceneState
from skyloop.sim.world_file import load_world
from skyloop.transport.testing import wait_until

MODEL = FRONT_CAMERA.scaled(0.25)
STATE = SceneState(np.array([[0.0, 0.0, 1.0]]), np.eye(3)[None], ())


class Wall:
    """A screen that records its frames."""

    def __init__(self) -> None:
        self.shown: list[int] = []
        self.failures: list[Exception] = []
        self.told = threading.Event()

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        assert pixels.shape == (model.height, model.width, 3)
        self.shown.append(captured_ns)
        self.told.set()

    def failed(self, error: Exception) -> None:
        self.failures.append(error)
        self.told.set()


def camera(screen: Wall) -> PipelineCamera:
    return PipelineCamera(MODEL, 0, screen, seed=1, shutter=Shutter())


def exposure(of: PipelineCamera, captured_ns: int) -> Exposure:
    return expose(of, STATE, np.zeros(3), captured_ns, speed=1.0)


@contextmanager
def drawing(pipeline: CameraPipeline) -> Iterator[CameraPipeline]:
    pipeline.start()
    try:
        yield pipeline
    finally:
        pipeline.stop()


def test_only_the_newest_exposure_of_a_camera_is_drawn() -> None:
    wall, pipeline = Wall(), CameraPipeline(load_world("empty"), 1, "fast")
    front, now_ns = camera(wall), monotonic_ns()
    for late_ns in range(3):
        pipeline.expose([exposure(front, now_ns - 1_000_000_000 + late_ns)])
    with drawing(pipeline):
        wait_until(lambda: wall.shown, "a picture is shown")
    assert wall.shown == [now_ns - 1_000_000_000 + 2]
    assert front.dropped == 2
    assert not wall.failures


def test_a_forgotten_camera_gets_no_more_frames() -> None:
    gone, stays = Wall(), Wall()
    left, right = camera(gone), camera(stays)
    pipeline = CameraPipeline(load_world("empty"), 1, "fast")
    pipeline.forget((left,))
    with drawing(pipeline):
        pipeline.expose([exposure(left, monotonic_ns()), exposure(right, monotonic_ns())])
        wait_until(lambda: stays.shown, "the other one is shown")
    assert not gone.shown


def test_a_renderer_that_cannot_be_created_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise RuntimeError("no scene")

    monkeypatch.setattr("skyloop.sim.camera_pipeline.make_renderer", refuse)
    wall, pipeline = Wall(), CameraPipeline(load_world("empty"), 1, "fast")
    pipeline.expose([exposure(camera(wall), monotonic_ns())])
    with drawing(pipeline):
        assert wall.told.wait(5.0)
    assert [str(error) for error in wall.failures] == ["no scene"]


def test_a_failed_frame_is_reported_and_the_next_one_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    finish, fail = PipelineCamera.finish, [True]

    def sometimes(self: PipelineCamera, *arguments: object) -> NDArray[np.uint8]:
        if fail.pop() if fail else False:
            raise RuntimeError("spilt ink")
        return finish(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(PipelineCamera, "finish", sometimes)
    wall, pipeline = Wall(), CameraPipeline(load_world("empty"), 1, "fast")
    front = camera(wall)
    with drawing(pipeline):
        pipeline.expose([exposure(front, monotonic_ns())])
        assert wall.told.wait(5.0)
        assert [str(error) for error in wall.failures] == ["spilt ink"]
        pipeline.expose([exposure(front, monotonic_ns())])
        wait_until(lambda: wall.shown, "the next one is shown")


@pytest.mark.parametrize(("fps", "rendered"), [(0.0, 0), (12.0, 15), (8.0, 10), (24.0, 30), (30.0, 30), (math.inf, 30)])
def test_no_more_is_rendered_than_is_used(fps: float, rendered: int) -> None:
    front = camera(Wall())
    assert front.model.fps == 30.0
    times_ns = [round(n * 1e9 / 30.0) for n in range(90)]
    assert sum(front.wanted(at_ns, fps) for at_ns in times_ns) == pytest.approx(3 * rendered, abs=2)


def test_a_slower_consumer_always_finds_a_frame_in_time() -> None:
    front, chosen = camera(Wall()), RateLimiter(12.0)
    times_ns = [round(n * 1e9 / 30.0) for n in range(300)]
    rendered = [at_ns for at_ns in times_ns if front.wanted(at_ns, chosen.max_hz)]
    assert len(rendered) < 160
    assert sum(chosen.in_time(at_ns) for at_ns in rendered[1:]) >= 115


def test_the_next_exposure_is_rendered_after_a_time_without_viewers() -> None:
    front = camera(Wall())
    assert front.wanted(0, 12.0)
    assert not front.wanted(1_000_000_000, 0.0)
    assert front.wanted(1_033_000_000, 12.0)
    assert front.wanted(1_066_000_000, math.inf)
