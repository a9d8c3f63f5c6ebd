"""A drone's surroundings on maps: the world as a parameter, and as sent to pages."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from skyloop.cockpit.world import view_values, way_values, world_values
from skyloop.messages import CameraInfo, Capabilities, Feedback, Intrinsics, Parameter, ParameterType, Value
from skyloop.messages.parameter import MAX_WORLD_TEXT, WORLD, Solid, WorldGeometry, decode_world, encode_world
from skyloop.sim.world import geometry_of
from skyloop.sim.world_file import load_world, shipped_worlds
from tests.support.cockpit import FakeDrone, cockpit, fake_fleet


def drone_with(**values: Value) -> Any:
    """A drone with these parameters, written with two underscores for a dot."""
    found = [
        Parameter(name.replace("__", "."), ParameterType.TEXT if isinstance(value, str) else ParameterType.FLOAT, value)
        for name, value in values.items()
    ]
    feedback = Feedback(captured_ns=1, position_m=(0.0, 0.0, 1.0), altitude_m=1.0, yaw_rad=0.0)
    return SimpleNamespace(
        config=SimpleNamespace(parameters=lambda: found),
        uri="sim://",
        capabilities=Capabilities("test"),
        feedback=lambda max_hz: feedback,
        now_ns=2,
    )


@pytest.mark.parametrize("name", shipped_worlds())
def test_a_world_survives_its_text(name: str) -> None:
    world = geometry_of(load_world(name))
    text = encode_world(world)
    assert len(text) <= MAX_WORLD_TEXT
    assert decode_world(text) == world


def test_a_replay_shows_the_surroundings_of_the_recorded_flight() -> None:
    """Its map was empty: recorded parameters have a prefix, and those without belong to the replay's own proxy."""
    world = geometry_of(load_world("gates"))
    drone = drone_with(
        recorded__world__geometry=encode_world(world),
        recorded__safety__zones="box 0 0 0 1 1 2",
        recorded__limits__speed=2.0,
        limits__speed=9.0,
        safety__zones="",
    )
    assert world_values(drone, None)["source"] is None, "one that flies has recorded nothing"
    drone.uri = "replay:///flights/one.mcap"
    values = world_values(drone, None)
    assert (values["name"], values["source"]) == ("gates", "vehicle")
    assert [zone["kind"] for zone in values["zones"]] == ["box"]
    assert values["limits"]["speed"] == 2.0


def test_a_truncated_world_names_the_missing_parts() -> None:
    solids = tuple(Solid(f"crate {number}", (1.0, 2.0, 0.5), (1.0, 1.0, 1.0)) for number in range(250))
    fitted = decode_world(encode_world(WorldGeometry("large", solids=solids)))
    assert 0 < len(fitted.solids) < 250
    assert len(fitted.solids) + fitted.left_out == 250


@pytest.mark.parametrize("text", ["", "[]", "{", '{"solids": [["a", [1, 2], [1, 1, 1]]]}', '{"low": [1e999, 0, 0]}'])
def test_an_invalid_world_is_refused(text: str) -> None:
    with pytest.raises(msgspec.DecodeError):
        decode_world(text)
    assert world_values(drone_with(world__geometry=text), None)["source"] is None


def test_pages_get_the_world_and_where_it_may_fly() -> None:
    world = geometry_of(load_world("gates"))
    text = "box 0 0 0 1 1 2; cylinder 2 0 0.5 0 3"
    drone = drone_with(
        world__geometry=encode_world(world), safety__zones=text, safety__box__x_low=-4.0, limits__speed=2.0
    )
    values = world_values(drone, WorldGeometry("another"))
    assert (values["name"], values["source"]) == ("gates", "vehicle")
    assert values["room"]["low"][2] == 0.0
    assert len(values["gates"]) == len(world.gates)
    assert values["box"] == {"low": [-4.0, None, None], "high": [None, None, None]}
    assert [zone["kind"] for zone in values["zones"]] == ["box", "cylinder"]
    assert values["zones"][1] == {"kind": "cylinder", "centre": [2.0, 0.0], "radius": 0.5, "low": 0.0, "high": 3.0}
    assert values["limits"] == {"speed": 2.0, "climb": None, "altitude": None}
    assert msgspec.json.encode(values)


def test_the_cockpits_world_is_for_drones_without_one() -> None:
    assert world_values(drone_with(), WorldGeometry("hall"))["source"] == "file"
    nothing = world_values(drone_with(safety__zones="a driver's own notion"), None)
    assert (nothing["source"], nothing["room"], nothing["zones"], nothing["box"]) == (None, None, [], None)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ((1.0, 0.0, 1.0), ""),
        ((0.0, 5.0, 1.0), "outside the safety box"),
        ((2.0, 0.0, 1.0), "in a no-fly zone"),
        ((3.0, 0.0, 1.0), "blocks the straight line"),
        ((0.0, 0.0, 9.0), "limits.altitude"),
    ],
)
def test_reasons_against_a_place(place: tuple[float, float, float], words: str) -> None:
    drone = drone_with(safety__zones="cylinder 2 0 0.5 0 3", safety__box__y_high=4.0, limits__altitude=5.0)
    problem = way_values(drone, place)["problem"]
    assert words in problem
    assert bool(problem) == bool(words)


def test_where_a_camera_looks() -> None:
    forward = (0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
    lens = Intrinsics(160.0, 160.0, 160.0, 120.0)
    view = view_values(CameraInfo("front", 320, 240, 30.0, intrinsics=lens, rotation=forward))
    first = view["rays"][0]  # of the upper left corner
    assert first[0] > 0
    assert first[1] > 0
    assert first[2] > 0
    assert math.hypot(*first) == pytest.approx(1.0, abs=1e-6)
    assert view_values(CameraInfo("front", 320, 240, 30.0))["rays"] is None


@pytest.mark.parametrize("to", ["", "1,2", "1,2,x", "1,2,nan", "1,2,3,4", "inf,0,0"])
def test_an_invalid_place_is_refused(to: str) -> None:
    with cockpit(fake_fleet({"alpha": FakeDrone()})) as client:
        answer = client.get(f"/api/drones/alpha/way?to={to}")
        assert answer.status_code == 400
        assert "three finite numbers" in answer.json()["error"]
        assert client.get("/api/drones/nobody/world").status_code == 404


def test_the_simulator_lists_its_world() -> None:
    from skyloop.drivers.registry import make_driver

    found = {parameter.name: parameter for parameter in make_driver("sim://?world=pillars").parameters()}
    assert found[WORLD].read_only
    text = found[WORLD].value
    assert isinstance(text, str)
    assert decode_world(text).name == "pillars"
