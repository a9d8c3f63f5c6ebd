"""People and cars: their files, motion, solidity, pictures and labels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import FileFormatError, UsageError
from skyloop.messages import Takeoff, Velocity
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim import OccurrenceKind, Simulation, load_world, parse_world
from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.labels import Labeller, pictures
from skyloop.sim.render import PlanarRenderer, Scene, SceneState
from skyloop.sim.render.compiled import Compiler, load_kernels
from skyloop.sim.render.planar import dimmed
from skyloop.sim.world import FigureTarget, Light, StillPath, World
from tests.sim.helpers import IDEAL, steps

OUTSIDE = '[room]\nsize = [12, 12, 6]\nfloor = "concrete"\nenclosed = false\n[[spawn]]\nposition = [-3, 0, 0]\n'
PERSON = """[[target]]
name = "anna"
kind = "figure"
path = { kind = "still", position = [1, 0, 0] }
yaw = { mode = "fixed", yaw_deg = 180 }
"""
WALKER = """[[target]]
name = "anna"
kind = "figure"
path = { kind = "waypoints", points = [[0, -3, 0], [0, 3, 0]], speed = 1.5 }
"""
MODEL = CameraModel("test", 160, 120, 30.0, 120.0, 120.0, 79.5, 59.5)


def state(world: World, time_s: float = 0.0, light: float = 1.0) -> SceneState:
    targets = Simulation(world).target_states(time_s)
    return SceneState(np.zeros((0, 3)), np.zeros((0, 3, 3)), targets, light)


def camera(x: float, y: float, z: float, yaw_deg: float = 0.0) -> CameraPose:
    return MODEL.pose(np.array([x, y, z]), rotation_from_euler(0.0, 0.0, math.radians(yaw_deg)))


def test_a_figure_is_read_with_its_shape_size_look_and_colour() -> None:
    (anna,) = parse_world(OUTSIDE + PERSON).targets
    assert isinstance(anna, FigureTarget)
    assert (anna.shape, anna.size_m, anna.look, anna.colour) == ("person", (0.42, 0.56, 1.76), 0, None)
    assert anna.path == StillPath((1, 0, 0))
    given_all = PERSON + 'shape = "car"\nsize = [2, 1, 1]\nlook = 4\ncolour = "#102030"\n'
    (car,) = parse_world(OUTSIDE + given_all).targets
    assert isinstance(car, FigureTarget)
    assert (car.shape, car.size_m, car.look, car.colour) == ("car", (2, 1, 1), 4, (16, 32, 48))


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ('shape = "dog"', "shape"),
        ("look = -1", "look"),
        ("look = 1.5", "look"),
        ('colour = "red"', "colour"),
        ("size = [1, nan, 1]", "size"),
        ("marker_size = 0.2", "marker_size"),
    ],
)
def test_invalid_figures_are_refused(line: str, wrong: str) -> None:
    with pytest.raises(FileFormatError, match=wrong):
        parse_world(OUTSIDE + PERSON + line + "\n")


def test_a_path_out_of_the_world_and_light_out_of_range_are_refused() -> None:
    with pytest.raises(FileFormatError, match="outside the room"):
        parse_world(OUTSIDE + PERSON.replace("[1, 0, 0]", "[9, 0, 0]"))
    with pytest.raises(FileFormatError, match="amplitude"):
        parse_world(OUTSIDE + "[light]\namplitude = 1.5\n")


def test_the_distance_walked_grows_with_the_speed_and_not_at_rest() -> None:
    walking, standing = (parse_world(OUTSIDE + text) for text in (WALKER, PERSON))
    assert Simulation(walking).target_states(3.0)[0].walked_m == pytest.approx(4.5, abs=0.05)
    assert Simulation(standing).target_states(3.0)[0].walked_m == 0.0


def test_legs_move_with_the_distance_walked() -> None:
    scene = Scene(parse_world(OUTSIDE + PERSON), 0)
    still = state(scene.world)
    (anna,) = still.targets
    mid_step = replace(still, targets=(replace(anna, walked_m=0.375),))
    legs = [scene.posed(s).quads.corners[scene.target_of == 0] for s in (still, mid_step)]
    assert np.ptp(legs[1][..., 0]) > np.ptp(legs[0][..., 0]) + 0.4  # feet apart along x


def test_a_walking_person_is_solid_and_a_drone_that_hits_it_is_reported() -> None:
    simulation = Simulation(parse_world(OUTSIDE + PERSON), parameters=IDEAL)
    simulation.command(0, Takeoff())
    simulation.step(steps(4))
    simulation.command(0, Velocity(forward=1.0))
    simulation.step(steps(5))
    assert OccurrenceKind.COLLISION in {o.kind for o in simulation.take_occurrences()}
    assert simulation.truth(0).position_m[0] < 1.0 - 0.2


def test_look_alikes_are_the_same_picture_and_others_differ() -> None:
    def picture(text: str) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        world = parse_world(OUTSIDE + PERSON + text)
        return PlanarRenderer(Scene(world, 0)).render(state(world), camera(-2, 0, 1.0), MODEL)

    first = picture("look = 3\n")
    assert (first == picture("look = 3\n")).all()
    assert (first != picture("look = 4\n")).any()
    assert (first != picture('look = 3\ncolour = "#00ff00"\n')).any()


@given(st.floats(0, 0.9), st.floats(1, 3600), st.floats(0, 1e5), st.integers(0, 1000))
def test_light_stays_between_its_bounds(amplitude: float, period: float, time_s: float, seed: int) -> None:
    light = Light(amplitude, period).at(time_s, seed)
    assert 1.0 - amplitude - 1e-12 <= light <= 1.0 + 1e-12
    assert light == Light(amplitude, period).at(time_s, seed)
    assert Light(0.0, period).at(time_s, seed) == 1.0


def test_light_dims_the_whole_picture_and_full_light_changes_no_bit() -> None:
    world = parse_world(OUTSIDE + PERSON)
    renderer = PlanarRenderer(Scene(world, 0))
    full, dim = (renderer.render(state(world, light=n), camera(-2, 0, 1.0), MODEL) for n in (1.0, 0.5))
    assert (dim == np.rint(full * 0.5)).all()
    assert (dimmed(full.copy(), 1.0) == full).all()


def test_compiled_people_and_changing_light_are_the_same_bit_by_bit() -> None:
    pytest.importorskip("numba")
    compiler = Compiler(load_kernels)
    compiler.start().join()
    world = load_world("yard")
    scene = Scene(world, 0)
    plain = PlanarRenderer(scene, compiler=None)
    compiled = PlanarRenderer(scene, compiler=compiler)
    for time_s in (0.0, 7.0):
        now = state(world, time_s, world.light.at(time_s, world.seed))
        assert now.light < 1.0
        pose = camera(-7, 0, 1.5, 10 * time_s)
        assert (plain.render(now, pose, MODEL) == compiled.render(now, pose, MODEL)).all()


def test_boxes_give_a_persons_position_and_visible_share() -> None:
    def label(crates: str) -> dict[str, object]:
        world = parse_world(OUTSIDE + PERSON + crates)
        found = Labeller(Scene(world, 0)).boxes(state(world), camera(-3, 0, 0.9), MODEL)
        return {box.name: box for box in found}

    (free,) = label("").values()
    x, y, width, height = free.box  # type: ignore[attr-defined]
    assert (free.class_name, free.visible, free.cut) == ("person", 1.0, False)  # type: ignore[attr-defined]
    # 1.76 m at 3.8 m to its front, 120 pixels of focal length; the eye is at half its height
    assert height == pytest.approx(1.76 * 120 / 3.9, abs=3)
    assert x + width / 2 == pytest.approx(80, abs=2)
    assert y + height / 2 == pytest.approx(60, abs=2)
    half = label('[[box]]\nname = "crate"\nstands_at = [0, 0]\nsize = [0.4, 2, 0.9]\n')
    assert half["anna"].box == free.box  # type: ignore[attr-defined]
    assert 0.3 < half["anna"].visible < 0.7  # type: ignore[attr-defined]
    assert half["crate"].class_name == "box"  # type: ignore[attr-defined]
    hidden = label('[[box]]\nname = "wall"\nstands_at = [0, 0]\nsize = [0.4, 4, 3]\ntexture = "brick"\n')
    assert hidden["anna"].visible == 0.0  # type: ignore[attr-defined]
    assert "wall" not in hidden


def test_training_pictures_are_labelled_and_repeatable() -> None:
    world = load_world("yard")
    first, again = (list(pictures(world, 5, 4, (80, 60))) for _ in range(2))
    assert len(first) == 4
    for (image, labels), (other, same) in zip(first, again, strict=True):
        assert image.shape == (60, 80, 3)
        assert (image == other).all()
        assert labels == same
        for label in labels:
            x, y, width, height = label.box
            assert 0 <= x < x + width <= 80
            assert 0 <= y < y + height <= 60
            assert 0.0 <= label.visible <= 1.0
    assert any(labels for _, labels in first)
    with pytest.raises(UsageError, match="count"):
        next(pictures(world, 5, -1))


@pytest.mark.parametrize("name", ["street", "yard"])
def test_people_and_cars_of_shipped_worlds_meet_no_wall(name: str) -> None:
    world = load_world(name)
    simulation = Simulation(world)
    figures = [(n, t) for n, t in enumerate(world.targets) if isinstance(t, FigureTarget)]
    assert {t.shape for _, t in figures} == {"person", "car"}
    looks = [(t.shape, t.look, t.colour) for _, t in figures]
    assert len(set(looks)) == len(looks) - 1  # one look-alike
    for time_s in np.arange(0.0, 60.0, 0.5):
        states = simulation.target_states(float(time_s))
        for n, target in figures:
            x, y, _ = states[n].position_m
            reach = target.size_m[1] / 2
            for box in world.boxes:
                c, s = math.cos(box.yaw_rad), math.sin(box.yaw_rad)
                dx, dy = x - box.position_m[0], y - box.position_m[1]
                away = max(abs(c * dx + s * dy) - box.size_m[0] / 2, abs(c * dy - s * dx) - box.size_m[1] / 2)
                low = box.position_m[2] - box.size_m[2] / 2
                assert away > reach - 0.05 or low > target.size_m[2] - 0.1, (target.name, box.name, time_s)
