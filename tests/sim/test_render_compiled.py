"""Compiled drawing compared with plain drawing, and the behaviour without a compiler."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA, CameraModel, CameraPose
from skyloop.sim.render import PlanarRenderer, Quality, Scene, SceneState, planar
from skyloop.sim.render.compiled import Compiler, Kernels, load_kernels
from tests.sim.furnished_room import WORLD, state_at

STRONG = replace(FRONT_CAMERA, name="strong", distortion=(-0.3, 0.1, 0.01, -0.01, 0.0))


def ready(functions: Kernels) -> Compiler:
    """Return a compiler that is done."""
    compiler = Compiler(lambda: functions)
    compiler.start().join()
    assert compiler.kernels is not None, compiler.problem
    return compiler


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(WORLD, drones=3)


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planar, "WORTH_COMPILING", 0)


def random_view(rng: np.random.Generator, model: CameraModel) -> tuple[SceneState, CameraPose]:
    """Return drones low over the floor, above one another and in front of the camera, which looks anywhere."""
    size = np.array(WORLD.room.size_m)
    places = rng.uniform(-0.45, 0.45, (3, 3)) * size + (0.0, 0.0, size[2] / 2)
    places[1, 2] = rng.uniform(0.05, 0.3)
    places[2] = places[0] + rng.uniform(-0.6, 0.6, 3)
    turns = np.array([rotation_from_euler(*rng.uniform((-0.4, -0.4, -3.1), (0.4, 0.4, 3.1))) for _ in range(3)])
    state = replace(state_at([(0.0, 0.0, 1.0)] * 3), drone_positions_m=places, drone_rotations=turns)
    return state, model.pose(places[0], turns[0], 0)


def assert_the_same(
    scene: Scene,
    functions: Kernels,
    model: CameraModel,
    quality: Quality,
    views: int,
    seed: int,
    detail: float = 1.0,
) -> None:
    plain, compiled = (PlanarRenderer(scene, quality, compiler=way) for way in (None, ready(functions)))
    rng = np.random.default_rng(seed)
    for number in range(views):
        state, pose = random_view(rng, model)
        expected = plain.render(state, pose, model)
        assert np.array_equal(compiled.render(state, pose, model), expected), f"view {number}"
        assert expected.std() >= detail


@pytest.mark.parametrize("quality", list(Quality))
@pytest.mark.parametrize("model", [FRONT_CAMERA, BOTTOM_CAMERA, STRONG], ids=lambda model: model.name)
def test_compiled_pictures_equal_the_plain_ones_bit_by_bit(scene: Scene, model: CameraModel, quality: Quality) -> None:
    pytest.importorskip("numba")
    assert_the_same(scene, load_kernels(), model.scaled(0.5), quality, views=12, seed=1)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (40, 1), (7, 5), (84, 84), (1100, 3)])
def test_compiled_pictures_of_any_size_equal_the_plain_ones(scene: Scene, width: int, height: int) -> None:
    """Narrower and wider than the kernels' batches."""
    pytest.importorskip("numba")
    focal = 1.0 * max(width, height)
    model = CameraModel("odd", width, height, 30.0, focal, focal, width / 2 - 0.5, height / 2 - 0.5, (-0.2, 0, 0, 0, 0))
    assert_the_same(scene, load_kernels(), model, Quality.SMOOTH, views=4, seed=6, detail=0.0)


@pytest.mark.parametrize("model", [FRONT_CAMERA, BOTTOM_CAMERA], ids=lambda model: model.name)
def test_uncompiled_kernels_draw_the_same(scene: Scene, model: CameraModel) -> None:
    with np.errstate(over="ignore"):
        assert_the_same(scene, Kernels(), model.scaled(0.08), Quality.SMOOTH, views=2, seed=2)


def test_a_picture_within_a_larger_one_is_drawn(scene: Scene) -> None:
    state, pose = random_view(np.random.default_rng(3), FRONT_CAMERA)
    renderer = PlanarRenderer(scene, compiler=None)
    twice = np.zeros((240, 640, 3), np.uint8)
    renderer.render(state, pose, FRONT_CAMERA, twice[:, 320:])
    assert np.array_equal(twice[:, 320:], renderer.render(state, pose, FRONT_CAMERA))
    assert not twice[:, :320].any()


def test_it_draws_plainly_until_the_kernels_are_compiled(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planar, "WORTH_COMPILING", 2)
    loads: list[int] = []

    def load() -> Kernels:
        loads.append(1)
        return Kernels()

    compiler = Compiler(load)
    model = BOTTOM_CAMERA.scaled(0.05)
    renderer = PlanarRenderer(scene, compiler=compiler)
    state, pose = random_view(np.random.default_rng(4), model)
    first = renderer.render(state, pose, model)
    renderer.render(state, pose, model)
    assert not loads, "too few pictures for a compilation"
    with np.errstate(over="ignore"):  # intended wrap-around
        renderer.render(state, pose, model)
        compiler.start().join()
        assert np.array_equal(renderer.render(state, pose, model), first)
    assert loads == [1]
    assert compiler.problem == ""


def test_an_ending_process_compiles_no_further_function(monkeypatch: pytest.MonkeyPatch) -> None:
    at_exit: list[Callable[[], object]] = []
    monkeypatch.setattr("atexit.register", at_exit.append)
    called, going = [], threading.Event()

    def prepare(*_: object) -> int:
        called.append("prepare")
        return 0

    def load() -> Kernels:
        going.wait(30)
        return Kernels(prepare=prepare)

    compiler = Compiler(load)
    thread = compiler.start()
    assert thread.daemon, "otherwise the process would wait for it"
    at_exit[0]()
    going.set()
    thread.join(0.1)
    assert thread.is_alive()
    assert not called
    assert compiler.kernels is None


@pytest.mark.parametrize(
    ("error", "problem", "told"),
    [
        (ImportError("No module named 'numba'"), "Numba is not installed: No module named 'numba'", 0),
        (RuntimeError("cannot cache function\nmore"), "Numba can't compile here: cannot cache function", 1),
        (ValueError(), "Numba can't compile here: ValueError()", 1),
    ],
)
def test_without_a_compiler_it_warns_once_and_draws_plainly(
    scene: Scene, caplog: pytest.LogCaptureFixture, error: Exception, problem: str, told: int
) -> None:
    def load() -> Kernels:
        raise error

    compiler = Compiler(load)
    renderer = PlanarRenderer(scene, compiler=compiler)
    model = BOTTOM_CAMERA.scaled(0.1)
    state, pose = random_view(np.random.default_rng(5), model)
    with caplog.at_level(logging.WARNING):
        pictures = []
        for _ in range(3):
            pictures.append(renderer.render(state, pose, model))
            compiler.start().join()
    assert compiler.problem == problem
    assert len([record for record in caplog.records if problem in record.getMessage()]) == told
    assert all(np.array_equal(picture, pictures[0]) for picture in pictures)
