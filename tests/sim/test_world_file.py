from __future__ import annotations

import itertools
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from skyloop.errors import FileFormatError, UnknownNameError, UsageError
from skyloop.sim import Simulation, load_world, parse_world, shipped_worlds
from skyloop.sim.world import BoardTarget, FacePose, Gate, PlatformTarget, RingWalkPath, TargetState
from skyloop.toml_file import _explained

ROOM = "[room]\nsize = [8, 6, 3]\n"
BOX = "[[box]]\nstands_at = [1, 1]\nsize = [1, 1, 1]\n"
FACE = "[[panel]]\nsize = [1, 1]\ntexture = 'door'\n"
BOARD = "[[target]]\nname = 'b'\nid = 1\nmarker_size = 0.2\n"


@pytest.mark.parametrize(
    "name", ["empty", "gates", "park", "pillars", "platform", "platform_fast", "room", "street", "windy", "yard"]
)
def test_drones_can_fly_in_shipped_worlds(name: str) -> None:
    assert name in shipped_worlds()
    world = load_world(name, seed=3)
    assert (world.name, world.seed) == (name, 3)
    simulation = Simulation(world, drones=2)
    simulation.step(10)
    assert len(simulation.target_states()) == len(world.targets)


def test_the_shipped_room_suits_the_demo() -> None:
    world = load_world("room")
    (board,) = world.targets
    assert isinstance(board, BoardTarget)
    assert isinstance(board.path, RingWalkPath)
    assert len(world.gates) == 1
    assert len(world.markers) >= 4
    assert len(load_world("gates").gates) == 5


def test_an_unknown_world_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'room'"):
        load_world("roam")


@pytest.mark.parametrize("seed", [-1, 1.5, True, "3"])
def test_a_seed_is_a_whole_number(seed: object) -> None:
    with pytest.raises(UsageError, match="seed"):
        load_world("room", seed=seed)  # type: ignore[arg-type]


def test_files_load_by_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(ROOM)
    assert load_world(path).name == "mine"
    assert load_world(str(path)).room.size_m == (8, 6, 3)
    with pytest.raises(FileFormatError, match=r"other\.toml can't be read"):
        load_world(tmp_path / "other.toml")
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(FileFormatError, match="not UTF-8"):
        load_world(path)


# Invalid text, and the expected message.
BAD = [
    (
        ROOM + '[[target]]\nmarker_size = 0.2\nid = 1\n[target.path]\nkind = "waypoints"\nspeed = 1\n'
        "points = [[0, 0, 1], [5e-324, 0, 1]]\n",
        "less than 0.01 m apart",
    ),
    ("", "key 'room': missing"),
    ("[room]\nsize = [8, 6", "not valid TOML"),
    ("[room]\nsize = [8, 6]\n", r"\[room\], key 'size': .* a list of 3 numbers"),
    ("[room]\nsiez = [8, 6, 3]\n", "found 'siez'; did you mean 'size'"),
    ("[room]\nsize = [8, 6, nan]\n", "'size': nan"),
    ("[room]\nsize = [8, 6, inf]\n", "'size': inf"),
    ("[room]\nsize = [8, -6, 3]\n", "'size': -6.* from 0.5 to 1000"),
    ("[room]\nsize = [8, true, 3]\n", "True .a boolean. given"),
    ("[room]\nsize = '8x6x3'\n", "'8x6x3' .a string. given"),
    ("room = 3\n", r"key 'room': 3 \(a whole number\) given, but it must be a table \[room\]"),
    (ROOM + "floor = 'parkett'\n", "'parkett' is not known here; did you mean 'parquet'"),
    (ROOM + "enclosed = 1\n", "'enclosed': 1 .a whole number. given, but it must be true or false"),
    (ROOM + "colour = 'red'\n", r"\[room\], key 'colour': unknown key"),
    (ROOM + "[[boxes]]\nsize = [1, 1, 1]\n", "key 'boxes': unknown key; did you mean 'box'"),
    (ROOM + "[box]\nsize = [1, 1, 1]\n", r"must be tables written \[\[box\]\]"),
    (ROOM + BOX + "textur = 'crate'\n", r"\[box #1\], key 'textur': unknown key; did you mean 'texture'"),
    (ROOM + BOX + "name = ''\n", "'name': '' .a string. given, but it must be a non-empty string"),
    (ROOM + BOX + "name = 'a'\n" + BOX + "name = 'a'\n", r"\[box 'a'\], key 'name': 'a' is used twice"),
    (ROOM + BOX + "colour = 'red'\n", "'red' is not a colour"),
    (ROOM + "[[box]]\nstands_at = [5, 1]\nsize = [1, 1, 1]\n", "x = 5 is outside the room"),
    (ROOM + "[[box]]\nstands_at = [1, 1]\nsize = [1, 0, 1]\n", "'size': 0 .*from 0.01"),
    (ROOM + "[[gate]]\nposition = [0, 0, 0.3]\ninner_size = [1, 1]\n", "reaches below the floor"),
    (ROOM + "[[panel]]\non = 'north'\nat = [0, 1]\nsize = [1, 1]\n", "'texture': missing; it must be one of"),
    (ROOM + "[[panel]]\non = 'nord'\nat = [0, 1]\nsize = [1, 1]\ntexture = 'door'\n", "did you mean 'north'"),
    (ROOM + "[[panel]]\non = 'north'\nat = [0, 4]\nsize = [1, 1]\ntexture = 'door'\n", "z = 4 is outside"),
    (ROOM + "[[marker]]\non = 'floor'\nat = [0, 0]\nid = 50\nmarker_size = 0.2\n", "whole number from 0 to 49"),
    (ROOM + "[[marker]]\non = 'floor'\nat = [0, 0]\nid = 1.0\nmarker_size = 0.2\n", "whole number from 0 to 49"),
    (
        ROOM + "[[marker]]\non = 'floor'\nat = [0, 0]\nid = 1\nmarker_size = 0.2\ndictionary = 'DICT_4X4_51'\n",
        "did you mean 'DICT_4X4_50'",
    ),
    (ROOM + "[[spawn]]\nposition = [0, 9, 0]\n", "y = 9 is outside"),
    (ROOM + "[wind]\ngust = -1\n", r"\[wind\], key 'gust': -1"),
    (ROOM + "[wind]\nmean = [1, 2]\n", "list of 3 numbers"),
    (ROOM + BOARD, r"\[target 'b'\], key 'path': missing"),
    (ROOM + BOARD + "path = { kind = 'spiral' }\n", r"\[target 'b'.path\], key 'kind': 'spiral' is not known"),
    (ROOM + BOARD + "path = { kind = 'circle', centre = [3, 0, 1], radius = 2, speed = 1 }\n", "x = 1 to 5 is outside"),
    (
        ROOM + BOARD + "path = { kind = 'oval', centre = [0, 0, 1], length = 6, radius = 2, speed = 1 }\n",
        "x = -5 to 5 is outside",
    ),
    (ROOM + BOARD + "path = { kind = 'circle', centre = [0, 0, 1], radius = 1, speed = 0 }\n", "'speed': 0"),
    (ROOM + BOARD + "path = { kind = 'waypoints', points = [[0, 0, 1]], speed = 1 }\n", "at least 2 lists"),
    (ROOM + BOARD + "path = { kind = 'waypoints', points = [[0,0,1],[0,0,1]], speed = 1 }\n", "listed twice"),
    (ROOM + BOARD + "path = { kind = 'walk', low = [1, 0, 1], high = [0, 1, 1], speed = [1, 2] }\n", "'high'"),
    (ROOM + BOARD + "path = { kind = 'ring_walk', radius = [2, 1], height = [1, 2], speed = [1, 2] }\n", "reversed"),
    (ROOM + BOARD + "path = { kind = 'ring_walk', radius = [1, 3.5], height = [1, 2], speed = [1, 2] }\n", "y = -3.5"),
    (
        ROOM + BOARD + "kind = 'platform'\nsize = [0.1, 1, 0.1]\n"
        "path = { kind = 'waypoints', points = [[0,0,1],[1,0,1]], speed = 1 }\n",
        "does not fit on the platform",
    ),
    (
        ROOM + BOARD + "path = { kind = 'waypoints', points = [[0,0,1],[1,0,1]], speed = 1 }\nyaw = { mode = 'on' }\n",
        r"\[target 'b'.yaw\], key 'mode'",
    ),
    ("box = [3]\n" + ROOM, r"key 'box': 3 .a whole number. given, but it must be tables written \[\[box\]\]"),
    (ROOM + "[[box]]\nsize = [1, 1, 1]\n", "'position': missing; .* or 'stands_at' a list of 2"),
    (ROOM + BOX + "position = [1, 1, 1]\n", "'position': give either this or 'stands_at', not both"),
    (ROOM + "[[box]]\nstands_at = [1, {}]\nsize = [1, 1, 1]\n", r"\[box #1\], key 'stands_at': {} .a table. given"),
    (ROOM + FACE + "on = 'north'\n", "'at': missing; it must be a list of 2 numbers"),
    (ROOM + FACE + "on = 'north'\nat = [0, 1]\nyaw_deg = 3\n", "'yaw_deg': can't be combined with 'on'"),
    (ROOM + FACE + "at = [0, 1]\n", "'at': needs 'on'"),
    (ROOM + FACE, "'position': missing; .* or 'on' and 'at'"),
    (ROOM + "[[spawn]]\nposition = [0, 0, 0]\nyaw_deg = 400\n", "'yaw_deg': 400 .* a number from -360 to 360"),
    (ROOM + BOARD + "path = { speed = 1, radius = 1 }\n", "'kind': missing; it must be one of waypoints, circle"),
    (ROOM + BOARD + "path = { knd = 'circle' }\n", "found 'knd'; did you mean 'kind'"),
    (ROOM + BOARD + "path = 3\n", r"\[target 'b'\], key 'path': 3 .* a table \[target 'b'.path\]"),
    (ROOM + BOARD + "size = [1, 1, 1]\npath = { kind = 'circle' }\n", "'size': unknown key"),
    (
        ROOM + BOARD + "path = { kind = 'ring_walk', radius = [0, 1], height = [1, 2], speed = [1, 2] }\n",
        "'radius': 0 .* a finite number of at least 0.1",
    ),
    (f"wind = {{ mean = [0, 0, {1 << 70}] }}\n" + ROOM, "'mean': a number of more than 64 bits"),
]


def test_an_unexplained_error_is_passed_on() -> None:
    found = _explained("Something else", {"room": 1}, "mine.toml", Untold)
    assert str(found) == "mine.toml: Something else"


class Untold(msgspec.Struct):
    room: int


@pytest.mark.parametrize(("text", "message"), BAD)
def test_a_bad_world_is_refused_with_the_place_and_the_remedy(text: str, message: str) -> None:
    with pytest.raises(FileFormatError, match=message) as caught:
        parse_world(text, "mine")
    assert str(caught.value).startswith("mine.toml")


def test_degrees_become_radians_and_colours_numbers() -> None:
    world = parse_world(ROOM + BOX + "yaw_deg = 90\ncolour = '#ff8000'\n")
    (box,) = world.boxes
    assert box.yaw_rad == pytest.approx(math.pi / 2)
    assert box.colour == (255, 128, 0)
    assert box.position_m == (1, 1, 0.5)


@pytest.mark.parametrize(
    ("mount", "at", "position", "normal", "up"),
    [
        ("north", "[1, 1.5]", (1, 3, 1.5), (0, -1, 0), (0, 0, 1)),
        ("south", "[1, 1.5]", (1, -3, 1.5), (0, 1, 0), (0, 0, 1)),
        ("east", "[1, 1.5]", (4, 1, 1.5), (-1, 0, 0), (0, 0, 1)),
        ("west", "[1, 1.5]", (-4, 1, 1.5), (1, 0, 0), (0, 0, 1)),
        ("floor", "[1, 1.5]", (1, 1.5, 0), (0, 0, 1), (1, 0, 0)),
        ("ceiling", "[1, 1.5]", (1, 1.5, 3), (0, 0, -1), (1, 0, 0)),
    ],
)
def test_objects_on_a_wall_face_the_room(
    mount: str, at: str, position: tuple[float, ...], normal: tuple[float, ...], up: tuple[float, ...]
) -> None:
    world = parse_world(ROOM + f"[[marker]]\non = '{mount}'\nat = {at}\nid = 1\nmarker_size = 0.2\n")
    pose = world.markers[0].pose
    rotation = pose.rotation()
    assert pose.position_m == pytest.approx(position, abs=0.01)
    assert rotation[:, 2] == pytest.approx(normal, abs=1e-12)
    assert rotation[:, 1] == pytest.approx(up, abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_a_turned_picture_turns_counter_clockwise_for_the_viewer() -> None:
    # The viewer of a face to the west stands west of it; a quarter turn moves the picture's right side to the top.
    turned = FacePose((0, 0, 0), yaw_rad=math.pi, turn_rad=math.pi / 2).rotation()
    assert turned[:, 0] == pytest.approx((0, 0, 1), abs=1e-12)


def test_a_platforms_marker_faces_up_with_its_top_ahead() -> None:
    world = load_world("windy")
    (platform,) = world.targets
    assert isinstance(platform, PlatformTarget)
    rotation = TargetState("platform", 0.0, (0, 0, 0), 0.3, (0, 0, 0)).face(platform).rotation()
    assert rotation[:, 2] == pytest.approx((0, 0, 1), abs=1e-12)
    assert rotation[:, 1] == pytest.approx((math.cos(0.3), math.sin(0.3), 0), abs=1e-12)


def test_the_bars_of_a_gate_leave_the_opening_free() -> None:
    gate = Gate("g", (1.0, 2.0, 1.5), (1.2, 0.8), yaw_rad=0.4, frame_m=0.1)
    bars = gate.bars()
    assert len(bars) == 6  # with two legs
    along = np.array([-math.sin(0.4), math.cos(0.4)])
    for bar in bars:
        local = (bar.corners()[:, :2] - gate.position_m[:2]) @ along
        height = bar.corners()[:, 2] - gate.position_m[2]
        overlaps_across = local.min() < 0.6 - 1e-9 and local.max() > -0.6 + 1e-9
        overlaps_upright = height.min() < 0.4 - 1e-9 and height.max() > -0.4 + 1e-9
        assert not (overlaps_across and overlaps_upright), bar.name
        assert bar.corners()[:, 2].min() >= -1e-9


# Placement by the seed ------------------------------------------------------------------------------------------------

VARIED = """
[room]
size = [20, 20, 5]
[vary]
apart = 2.0
[[gate]]
position = [0, 0, 1.5]
inner_size = [1, 1]
vary = [6, 6, 0.3]
vary_yaw_deg = 40
[[gate]]
position = [0, 0, 1.5]
inner_size = [1, 1]
vary = [6, 6, 0]
[[box]]
name = "pole"
stands_at = [0, 0]
size = [0.1, 0.1, 2]
vary = [6, 6, 0]
[[spawn]]
position = [9, 9, 0]
"""


def test_the_seed_places_varied_objects_within_their_ranges_and_apart(tmp_path: Path) -> None:
    path = tmp_path / "varied.toml"
    path.write_text(VARIED)
    worlds = [load_world(path, seed) for seed in range(20)]
    assert load_world(path, 3) == worlds[3]
    assert len({world.gates[0].position_m for world in worlds}) == 20
    for world in worlds:
        places = [*(gate.position_m for gate in world.gates), world.boxes[0].position_m]
        assert all(max(abs(x), abs(y)) <= 6.0 for x, y, _ in places)
        assert all(math.dist(one[:2], other[:2]) >= 2.0 for one, other in itertools.combinations(places, 2))
        assert 1.2 <= world.gates[0].position_m[2] <= 1.8
        assert abs(world.gates[0].yaw_rad) <= math.radians(40)
        assert (world.gates[1].position_m[2], world.gates[1].yaw_rad) == (1.5, 0.0)
        assert world.boxes[0].position_m[2] == 1.0
        assert world.spawns[0].position_m == (9.0, 9.0, 0.0)


def test_objects_without_room_are_reported() -> None:
    with pytest.raises(FileFormatError, match=r"\[vary\], key 'apart': no room for 3 objects at least 15 m apart"):
        parse_world(VARIED.replace("apart = 2.0", "apart = 15.0"))
    with pytest.raises(FileFormatError, match=r"position.*missing"):
        parse_world(VARIED.replace("stands_at = [0, 0]\n", ""))


@pytest.mark.parametrize("level", range(4))
def test_race_tracks_leave_room_to_fly(level: int) -> None:
    for seed in range(10):
        world = load_world(f"race{level}", seed)
        assert (len(world.gates), len(world.boxes)) == (4, 4)
        Simulation(world, 1)  # the start is free
    assert (load_world(f"race{level}", 1).spawns == load_world(f"race{level}", 2).spawns) == (level == 0)
    assert (load_world(f"race{level}", 1).gates == load_world(f"race{level}", 2).gates) == (level < 2)
