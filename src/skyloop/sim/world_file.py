"""Reading worlds from TOML files.

Lengths are metres, speeds metres a second, angles **degrees** (their keys end in ``_deg``): people write these files,
and this is the one place where degrees become radians. The files in ``worlds/`` show every table.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path as FilePath
from typing import TypeVar, cast

from skyloop.errors import UnknownNameError, UsageError
from skyloop.sim.toml_table import TomlTable, parse_toml, read_toml
from skyloop.sim.world import (
    MARKER_DICTIONARIES,
    TEXTURES,
    AlongYaw,
    BoardTarget,
    Box,
    CirclePath,
    FacePose,
    FixedYaw,
    Gate,
    LissajousPath,
    Marker,
    MarkerPattern,
    Panel,
    Path,
    PlatformTarget,
    Rgb,
    RingWalkPath,
    Room,
    Spawn,
    Target,
    TowardsYaw,
    Vec2,
    Vec3,
    WalkPath,
    WaypointPath,
    Wind,
    World,
    Yaw,
)

T = TypeVar("T")

_SMALLEST_M = 0.01
_LARGEST_M = 1000.0
_FASTEST_M_S = 20.0
_WALL_GAP_M = 0.004  # posters and markers hang this far off their wall, so that no renderer has to choose
_MOUNTS = ("north", "south", "east", "west", "floor", "ceiling")


def shipped_worlds() -> tuple[str, ...]:
    """Return the names of the worlds that come with Skyloop, in order."""
    folder = resources.files("skyloop.sim") / "worlds"
    return tuple(sorted(e.name.removesuffix(".toml") for e in folder.iterdir() if e.name.endswith(".toml")))


def load_world(name_or_path: str | FilePath, seed: int = 0) -> World:
    """Load a world.

    Args:
        name_or_path: A shipped world's name, or a file (anything that ends in ``.toml`` or has a separator).
        seed: Of what is random in the world.

    Raises:
        UnknownNameError: No world of that name is shipped.
        FileFormatError: The file can't be read or understood.
        UsageError: The seed is not a whole number of at least 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise UsageError(f"seed must be a whole number of at least 0, not {seed!r}")
    text = str(name_or_path)
    if isinstance(name_or_path, FilePath) or text.endswith(".toml") or "/" in text:
        table, name = read_toml(FilePath(text)), FilePath(text).stem
    elif text in shipped_worlds():
        file = resources.files("skyloop.sim") / "worlds" / f"{text}.toml"
        table, name = parse_toml(file.read_text(encoding="utf-8"), f"{text}.toml"), text
    else:
        raise UnknownNameError("world", text, shipped_worlds())
    return dataclasses.replace(_read_world(table, name), seed=seed)


def parse_world(text: str, name: str = "world") -> World:
    """Parse a world from the text of a world file.

    Raises:
        FileFormatError: The text is no valid world.
    """
    return _read_world(parse_toml(text, f"{name}.toml"), name)


def _read_world(table: TomlTable, name: str) -> World:
    room = _read_room(table.table("room"))
    names: set[str] = set()

    def read_all(key: str, read: Callable[[TomlTable, str, Room], T]) -> tuple[T, ...]:
        found = []
        for number, item in enumerate(table.tables(key), 1):
            item_name = item.text("name", f"{key} {number}")
            if item_name in names:
                raise item.error("name", f"{item_name!r} is used twice in this file; names must differ")
            names.add(item_name)
            found.append(read(item, item_name, room))
            item.finish()
        return tuple(found)

    world = World(
        name=name,
        room=room,
        boxes=read_all("box", _read_box),
        gates=read_all("gate", _read_gate),
        panels=read_all("panel", _read_panel),
        markers=read_all("marker", _read_marker),
        targets=read_all("target", _read_target),
        spawns=read_all("spawn", _read_spawn),
        wind=_read_wind(table.table("wind")) if table.has("wind") else Wind(),
    )
    table.finish()
    return world


def _read_room(table: TomlTable) -> Room:
    room = Room(
        size_m=_vec3(table.vector("size", 3, low=0.5, high=_LARGEST_M)),
        floor=table.choice("floor", TEXTURES, "parquet"),
        walls=table.choice("walls", TEXTURES, "plaster"),
        ceiling=table.choice("ceiling", TEXTURES, "plaster"),
        enclosed=table.flag("enclosed", True),
    )
    table.finish()
    return room


def _read_wind(table: TomlTable) -> Wind:
    wind = Wind(
        mean_m_s=_vec3(table.vector("mean", 3, (0.0, 0.0, 0.0), low=-_FASTEST_M_S, high=_FASTEST_M_S)),
        gust_m_s=table.number("gust", 0.0, low=0.0, high=_FASTEST_M_S),
        time_constant_s=table.number("time_constant", 1.0, low=0.05, high=1000.0),
    )
    table.finish()
    return wind


def _read_box(table: TomlTable, name: str, room: Room) -> Box:
    size = _vec3(table.vector("size", 3, low=_SMALLEST_M, high=_LARGEST_M))
    if table.has("stands_at"):  # on the floor, the usual case
        x, y = table.vector("stands_at", 2)
        position = (x, y, size[2] / 2)
    else:
        position = _vec3(table.vector("position", 3))
    _require_inside(table, "stands_at" if table.has("stands_at") else "position", position, room)
    return Box(
        name=name,
        position_m=position,
        size_m=size,
        yaw_rad=_angle(table, "yaw_deg"),
        texture=table.choice("texture", TEXTURES, "crate"),
        colour=_colour(table) if table.has("colour") else None,
    )


def _read_gate(table: TomlTable, name: str, room: Room) -> Gate:
    position = _vec3(table.vector("position", 3))
    _require_inside(table, "position", position, room)
    gate = Gate(
        name=name,
        position_m=position,
        inner_size_m=_vec2(table.vector("inner_size", 2, low=0.1, high=_LARGEST_M)),
        yaw_rad=_angle(table, "yaw_deg"),
        frame_m=table.number("frame", 0.08, low=_SMALLEST_M, high=1.0),
        colour=_colour(table) if table.has("colour") else (235, 110, 20),
    )
    if position[2] - gate.inner_size_m[1] / 2 < 0:
        raise table.error(
            "position", f"the opening reaches below the floor; z must be at least {gate.inner_size_m[1] / 2:g}"
        )
    return gate


def _read_panel(table: TomlTable, name: str, room: Room) -> Panel:
    return Panel(
        name=name,
        pose=_read_face(table, room),
        size_m=_vec2(table.vector("size", 2, low=_SMALLEST_M, high=_LARGEST_M)),
        texture=table.choice("texture", TEXTURES),
    )


def _read_marker(table: TomlTable, name: str, room: Room) -> Marker:
    return Marker(name=name, pose=_read_face(table, room), pattern=_read_pattern(table))


def _read_pattern(table: TomlTable) -> MarkerPattern:
    dictionary = table.choice("dictionary", MARKER_DICTIONARIES, "DICT_4X4_50")
    size = table.number("marker_size", low=_SMALLEST_M, high=10.0)
    return MarkerPattern(
        dictionary=dictionary,
        marker_id=table.whole("id", 0, MARKER_DICTIONARIES[dictionary] - 1),
        size_m=size,
        margin_m=table.number("margin", size / 6, low=0.0, high=10.0),
    )


def _read_face(table: TomlTable, room: Room) -> FacePose:
    turn = _angle(table, "turn_deg")
    if not table.has("on"):
        position = _vec3(table.vector("position", 3))
        _require_inside(table, "position", position, room)
        return FacePose(position, _angle(table, "yaw_deg"), _angle(table, "elevation_deg"), turn)
    along, other = table.vector("at", 2)
    pose = _mounted(table.choice("on", _MOUNTS), along, other, turn, room)
    _require_inside(table, "at", pose.position_m, room)
    return pose


def _mounted(mount: str, along: float, other: float, turn_rad: float, room: Room) -> FacePose:
    """Return the pose of something that is mounted on a face of the room.

    On a wall, ``along`` is x (north, south) or y (east, west) and ``other`` the height; on floor and ceiling they are x
    and y, and the image's up points east.
    """
    half_x, half_y, height = room.size_m[0] / 2, room.size_m[1] / 2, room.size_m[2]
    gap = _WALL_GAP_M
    if mount == "east":
        return FacePose((half_x - gap, along, other), math.pi, 0.0, turn_rad)
    if mount == "west":
        return FacePose((-half_x + gap, along, other), 0.0, 0.0, turn_rad)
    if mount == "north":
        return FacePose((along, half_y - gap, other), -math.pi / 2, 0.0, turn_rad)
    if mount == "south":
        return FacePose((along, -half_y + gap, other), math.pi / 2, 0.0, turn_rad)
    if mount == "floor":
        return FacePose((along, other, gap), math.pi, math.pi / 2, turn_rad)
    return FacePose((along, other, height - gap), 0.0, -math.pi / 2, turn_rad)


def _read_target(table: TomlTable, name: str, room: Room) -> Target:
    kind = table.choice("kind", ("board", "platform"), "board")
    pattern = _read_pattern(table)
    path = _read_path(table.table("path"), room)
    yaw = _read_yaw(table.table("yaw")) if table.has("yaw") else FixedYaw(0.0)
    if kind == "board":
        return BoardTarget(name, pattern, path, yaw)
    size = _vec3(table.vector("size", 3, low=_SMALLEST_M, high=_LARGEST_M))
    if pattern.card_size_m > min(size[:2]):
        raise table.error(
            "size", f"the marker's card is {pattern.card_size_m:g} m wide and does not fit on the platform"
        )
    return PlatformTarget(name, pattern, path, yaw, size, table.choice("texture", TEXTURES, "wood"))


def _read_path(table: TomlTable, room: Room) -> Path:
    kind = table.choice("kind", ("waypoints", "circle", "lissajous", "walk", "ring_walk"))
    path = {
        "waypoints": _read_waypoints,
        "circle": _read_circle,
        "lissajous": _read_lissajous,
        "walk": _read_walk,
        "ring_walk": _read_ring_walk,
    }[kind](table, room)
    table.finish()
    return path


def _read_waypoints(table: TomlTable, room: Room) -> Path:
    points = [_vec3(point) for point in table.vectors("points", 3, 2)]
    for point in points:
        _require_inside(table, "points", point, room)
    if len(set(points)) < len(points):
        raise table.error("points", "a point stands twice in the list; each must differ from the others")
    closed = table.flag("closed", True)
    for one, other in itertools.pairwise([*points, points[0]] if closed else points):
        if math.dist(one, other) < _SMALLEST_M:
            raise table.error("points", f"{list(one)} and {list(other)} are less than {_SMALLEST_M:g} m apart")
    return WaypointPath(tuple(points), _speed(table), closed)


def _read_circle(table: TomlTable, room: Room) -> Path:
    centre = _vec3(table.vector("centre", 3))
    radius = table.number("radius", low=0.05, high=_LARGEST_M)
    _require_box_inside(table, "radius", centre, (radius, radius, 0.0), room)
    return CirclePath(centre, radius, _speed(table), _angle(table, "start_deg"), table.flag("clockwise", False))


def _read_lissajous(table: TomlTable, room: Room) -> Path:
    centre = _vec3(table.vector("centre", 3))
    amplitude = _vec3(table.vector("amplitude", 3, low=0.0, high=_LARGEST_M))
    _require_box_inside(table, "amplitude", centre, amplitude, room)
    return LissajousPath(
        centre,
        amplitude,
        cycles=_vec3(table.vector("cycles", 3, (1.0, 2.0, 1.0), low=0.0, high=20.0)),
        phase_rad=_vec3(tuple(math.radians(p) for p in table.vector("phase_deg", 3, (0.0, 0.0, 0.0)))),
        period_s=table.number("period", low=1.0, high=3600.0),
    )


def _read_walk(table: TomlTable, room: Room) -> Path:
    low, high = _vec3(table.vector("low", 3)), _vec3(table.vector("high", 3))
    _require_inside(table, "low", low, room)
    _require_inside(table, "high", high, room)
    if any(a > b for a, b in zip(low, high, strict=True)) or low == high:
        raise table.error("high", f"{list(high)} must be greater than 'low' {list(low)} in some axis and less in none")
    return WalkPath(low, high, _speeds(table), _acceleration(table))


def _read_ring_walk(table: TomlTable, room: Room) -> Path:
    centre = _vec2(table.vector("centre", 2, (0.0, 0.0)))
    radius, height = table.range("radius", low=0.1), table.range("height", low=0.0)
    _require_box_inside(table, "radius", (*centre, sum(height) / 2), (radius[1], radius[1], 0.0), room)
    _require_inside(table, "height", (*centre, height[1]), room)
    return RingWalkPath(centre, radius, height, _speeds(table), _acceleration(table))


def _read_yaw(table: TomlTable) -> Yaw:
    mode = table.choice("mode", ("fixed", "along", "towards"))
    if mode == "fixed":
        yaw: Yaw = FixedYaw(_angle(table, "yaw_deg"))
    else:
        rate = math.radians(table.number("turn_rate_deg_s", 40.0, low=1.0, high=720.0))
        if mode == "along":
            yaw = AlongYaw(_angle(table, "offset_deg"), rate)
        else:
            yaw = TowardsYaw(_vec2(table.vector("point", 2, (0.0, 0.0))), rate)
    table.finish()
    return yaw


def _read_spawn(table: TomlTable, name: str, room: Room) -> Spawn:
    x, y, z = table.vector("position", 3)
    _require_inside(table, "position", (x, y, z), room)
    return Spawn(name, (x, y, z), _angle(table, "yaw_deg"))


def _require_inside(table: TomlTable, key: str, point: Vec3, room: Room) -> None:
    _require_box_inside(table, key, point, (0.0, 0.0, 0.0), room)


def _require_box_inside(table: TomlTable, key: str, centre: Vec3, reach: Vec3, room: Room) -> None:
    lows, highs = (
        (-room.size_m[0] / 2, -room.size_m[1] / 2, 0.0),
        (room.size_m[0] / 2, room.size_m[1] / 2, room.size_m[2]),
    )
    for axis, c, r, low, high in zip("xyz", centre, reach, lows, highs, strict=True):
        if c - r < low - 1e-9 or c + r > high + 1e-9:
            reached = f"{c - r:g} to {c + r:g}" if r else f"{c:g}"
            raise table.error(
                key, f"{axis} = {reached} is outside of the room, where {axis} goes from {low:g} to {high:g}"
            )


def _speed(table: TomlTable) -> float:
    return table.number("speed", low=0.01, high=_FASTEST_M_S)


def _speeds(table: TomlTable) -> Vec2:
    return table.range("speed", low=0.01, high=_FASTEST_M_S)


def _acceleration(table: TomlTable) -> float:
    return table.number("acceleration", 0.5, low=0.05, high=20.0)


def _angle(table: TomlTable, key: str) -> float:
    return math.radians(table.number(key, 0.0, low=-360.0, high=360.0))


def _colour(table: TomlTable) -> Rgb:
    text = table.text("colour")
    digits = text.removeprefix("#")
    if len(digits) != 6 or not text.startswith("#") or any(d not in "0123456789abcdefABCDEF" for d in digits):
        raise table.error("colour", f"{text!r} is not a colour; write red, green and blue as in '#eb6e14'")
    return (int(digits[0:2], 16), int(digits[2:4], 16), int(digits[4:6], 16))


def _vec2(values: Sequence[float]) -> Vec2:
    return cast(Vec2, tuple(values))


def _vec3(values: Sequence[float]) -> Vec3:
    return cast(Vec3, tuple(values))
