"""Poles in images of a race track by the racer's camera, which is tilted up."""

from __future__ import annotations

import math

import numpy as np
import pytest

from skyloop.control import RACE_TRACK
from skyloop.control.gates import RACE_POLES
from skyloop.errors import UsageError
from skyloop.messages.geometry import rotation_from_euler, wrap_angle
from skyloop.sim.camera import FPV_CAMERA
from skyloop.sim.render import PlanarRenderer, Scene, SceneState, SensorEffects
from skyloop.sim.world_file import load_world
from skyloop.vision import GateDetector, PoleDetector


def test_tops_of_poles_and_gates_are_found_at_any_tilt() -> None:
    world = load_world("race0")
    renderer, effects = PlanarRenderer(Scene(world, drones=1)), SensorEffects(FPV_CAMERA, 3)
    camera, rng = FPV_CAMERA.info(), np.random.default_rng(2)
    poles = gates = right = 0
    for number in range(24):
        position = np.array([*rng.uniform((-6.5, -3.5), (-4.8, 1.5)), rng.uniform(1.0, 1.6)])
        roll, pitch = rng.normal(0.0, 0.08, 2).tolist()
        turn = rotation_from_euler(roll, pitch, rng.uniform(-0.5, 0.2))
        picture = effects.apply(
            renderer.render(SceneState(position[None], turn[None], ()), FPV_CAMERA.pose(position, turn, 0), FPV_CAMERA),
            number,
        )
        eye = position + turn @ np.array(FPV_CAMERA.position_m)
        tops = [np.array([pole.x_m, pole.y_m, pole.height_m]) - eye for pole in RACE_TRACK.poles]
        for seen in PoleDetector(RACE_POLES).detect(picture, FPV_CAMERA.intrinsics()):
            ray = turn @ seen.ray_in_body(camera)
            off = [math.hypot(*np.subtract(_angles(ray), _angles(top))) for top in tops]
            right += min(off) < 0.03  # (another pole may hide a top)
            poles += 1
        gate = world.gates[0]
        for one in GateDetector(gate.colour).detect(picture, FPV_CAMERA.intrinsics())[:1]:
            place = position + turn @ one.position_in_body(camera)
            assert math.dist(place, gate.position_m) < 0.12 * math.dist(eye, gate.position_m)
            gates += 1
    assert poles > 20
    assert right > 0.9 * poles
    assert gates > 10


def _angles(ray: np.ndarray) -> tuple[float, float]:
    return wrap_angle(math.atan2(ray[1], ray[0])), math.atan2(ray[2], math.hypot(ray[0], ray[1]))


def test_other_things_are_not_poles() -> None:
    picture = np.full((240, 320, 3), 90, np.uint8)
    picture[100:160, 100:180] = RACE_POLES[::-1]  # too wide
    picture[100:110, 200:203] = RACE_POLES[::-1]  # too low
    picture[0:120, 250:255] = RACE_POLES[::-1]  # its top is out of view
    picture[20:200, 315:320] = RACE_POLES[::-1]  # not entirely visible
    assert PoleDetector(RACE_POLES).detect(picture, FPV_CAMERA.intrinsics()) == []


def test_a_grey_pole_is_refused() -> None:
    with pytest.raises(UsageError, match="grey"):
        PoleDetector((90, 90, 90))
