"""Worlds in TOML files: the tables with their allowed values, and functions that read them.

Lengths are in metres, speeds in metres per second and angles in **degrees** (with keys that end in ``_deg``), because
people write these files by hand; degrees are converted to radians only here. The files in ``worlds/`` use every table.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from msgspec import Meta, Struct, field

from skyloop.errors import UnknownNameError, UsageError
from skyloop.files import read_text
from skyloop.messages.fields import Finite
from skyloop.sim.streams import Purpose, stream
from skyloop.sim.world import (
    FIGURE_SIZES_M,
    MARKER_DICTIONARIES,
    TEXTURES,
    AlongYaw,
    BoardTarget,
    Box,
    CirclePath,
    FacePose,
    FigureTarget,
    FixedYaw,
    Gate,
    Light,
    LissajousPath,
    Marker,
    MarkerPattern,
    OvalPath,
    Panel,
    Path,
    PlatformTarget,
    Rgb,
    RingWalkPath,
    Room,
    Spawn,
    StillPath,
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
from skyloop.toml_file import MAX_BYTES, Place, parse_toml, read_tables

if TYPE_CHECKING:
    Texture = str
    Dictionary = str
else:
    Texture = Literal[TEXTURES]
    Dictionary = Literal[tuple(MARKER_DICTIONARIES)]
Mount = Literal["north", "south", "east", "west", "floor", "ceiling"]
Name = Annotated[str, Meta(min_length=1)]
Position = tuple[Finite, Finite, Finite]
Spot = tuple[Finite, Finite]
Length = Annotated[float, Meta(ge=0.01, le=1000.0)]
Size = tuple[Length, Length, Length]
Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]
Speed = Annotated[float, Meta(ge=0.01, le=20.0)]
Acceleration = Annotated[float, Meta(ge=0.05, le=20.0)]
Air = Annotated[float, Meta(ge=-20.0, le=20.0)]
RoomLength = Annotated[float, Meta(ge=0.5, le=1000.0)]
Opening = Annotated[float, Meta(ge=0.1, le=1000.0)]
MarkerSize = Annotated[float, Meta(ge=0.01, le=10.0)]
Margin = Annotated[float, Meta(ge=0.0, le=10.0)]
Amplitude = Annotated[float, Meta(ge=0.0, le=1000.0)]
Cycles = Annotated[float, Meta(ge=0.0, le=20.0)]
RingRadius = Annotated[float, Meta(ge=0.1)]
RingHeight = Annotated[float, Meta(ge=0.0)]
TurnRate = Annotated[float, Meta(ge=1.0, le=720.0)]
#: The ID of a marker; the dictionary determines which IDs are valid.
MarkerId = Annotated[Any, Meta(description="a whole number, the id of a marker in its dictionary")]


class _Table(Struct, forbid_unknown_fields=True):
    pass


class Named(_Table, kw_only=True):
    name: Name | None = None


class RoomTable(_Table, kw_only=True):
    size: tuple[RoomLength, RoomLength, RoomLength]
    floor: Texture = "parquet"
    walls: Texture = "plaster"
    ceiling: Texture = "plaster"
    enclosed: bool = True


class WindTable(_Table, kw_only=True):
    mean: tuple[Air, Air, Air] = (0.0, 0.0, 0.0)
    gust: Annotated[float, Meta(ge=0.0, le=20.0)] = 0.0
    time_constant: Annotated[float, Meta(ge=0.05, le=1000.0)] = 1.0


class VariedTable(Named, kw_only=True):
    """An object, and the maximum distance by which the seed may move it from its position in the file."""

    vary: tuple[Amplitude, Amplitude, Amplitude] = (0.0, 0.0, 0.0)
    vary_yaw_deg: Annotated[float, Meta(ge=0.0, le=180.0)] = 0.0


class BoxTable(VariedTable, kw_only=True):
    size: Size
    stands_at: Spot | None = None  #: position on the floor (the usual case)
    position: Position | None = None
    yaw_deg: Degrees = 0.0
    texture: Texture = "crate"
    colour: str | None = None


class GateTable(VariedTable, kw_only=True):
    position: Position
    inner_size: tuple[Opening, Opening]
    yaw_deg: Degrees = 0.0
    frame: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.08
    colour: str | None = None


class FaceTable(Named, kw_only=True):
    """A position: two coordinates on a face of the room, or a point and a heading."""

    on: Mount | None = None
    at: Spot | None = None
    position: Position | None = None
    yaw_deg: Degrees | None = None
    elevation_deg: Degrees | None = None
    turn_deg: Degrees = 0.0


class PanelTable(FaceTable, kw_only=True):
    size: tuple[Length, Length]
    texture: Texture


class MarkerTable(FaceTable, kw_only=True):
    id: MarkerId
    marker_size: MarkerSize
    dictionary: Dictionary = "DICT_4X4_50"
    margin: Margin | None = None


class WaypointsTable(_Table, kw_only=True, tag_field="kind", tag="waypoints"):
    points: Annotated[list[Position], Meta(min_length=2)]
    speed: Speed
    closed: bool = True


class CircleTable(_Table, kw_only=True, tag_field="kind", tag="circle"):
    centre: Position
    radius: Annotated[float, Meta(ge=0.05, le=1000.0)]
    speed: Speed
    start_deg: Degrees = 0.0
    clockwise: bool = False


class OvalTable(_Table, kw_only=True, tag_field="kind", tag="oval"):
    centre: Position
    length: Length
    radius: Annotated[float, Meta(ge=0.05, le=1000.0)]
    speed: Speed
    start: Annotated[float, Meta(ge=0.0, le=10_000.0)] = 0.0
    clockwise: bool = False


class LissajousTable(_Table, kw_only=True, tag_field="kind", tag="lissajous"):
    centre: Position
    amplitude: tuple[Amplitude, Amplitude, Amplitude]
    cycles: tuple[Cycles, Cycles, Cycles] = (1.0, 2.0, 1.0)
    phase_deg: Position = (0.0, 0.0, 0.0)
    period: Annotated[float, Meta(ge=1.0, le=3600.0)]


class WalkTable(_Table, kw_only=True, tag_field="kind", tag="walk"):
    low: Position
    high: Position
    speed: tuple[Speed, Speed]
    acceleration: Acceleration = 0.5


class RingWalkTable(_Table, kw_only=True, tag_field="kind", tag="ring_walk"):
    centre: Spot = (0.0, 0.0)
    radius: tuple[RingRadius, RingRadius]
    height: tuple[RingHeight, RingHeight]
    speed: tuple[Speed, Speed]
    acceleration: Acceleration = 0.5


class FixedTable(_Table, kw_only=True, tag_field="mode", tag="fixed"):
    yaw_deg: Degrees = 0.0


class AlongTable(_Table, kw_only=True, tag_field="mode", tag="along"):
    offset_deg: Degrees = 0.0
    turn_rate_deg_s: TurnRate = 40.0


class TowardsTable(_Table, kw_only=True, tag_field="mode", tag="towards"):
    point: Spot = (0.0, 0.0)
    turn_rate_deg_s: TurnRate = 40.0


class StillTable(_Table, kw_only=True, tag_field="kind", tag="still"):
    position: Position


PathTable = WaypointsTable | CircleTable | OvalTable | LissajousTable | WalkTable | RingWalkTable | StillTable
YawTable = FixedTable | AlongTable | TowardsTable


class BoardTable(Named, kw_only=True, tag_field="kind", tag="board"):
    id: MarkerId
    marker_size: MarkerSize
    dictionary: Dictionary = "DICT_4X4_50"
    margin: Margin | None = None
    path: PathTable
    yaw: YawTable = field(default_factory=FixedTable)


class PlatformTable(BoardTable, kw_only=True, tag_field="kind", tag="platform"):
    size: Size
    texture: Texture = "wood"


class FigureTable(Named, kw_only=True, tag_field="kind", tag="figure"):
    """The path is on the ground below the figure, and by default the heading follows the path."""

    shape: Literal["person", "car"] = "person"
    path: PathTable
    yaw: YawTable = field(default_factory=lambda: AlongTable(turn_rate_deg_s=120.0))
    size: Size | None = None
    look: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    colour: str | None = None


class LightTable(_Table, kw_only=True):
    amplitude: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    period: Annotated[float, Meta(ge=1.0, le=3600.0)] = 60.0


class SpawnTable(VariedTable, kw_only=True):
    position: Position
    yaw_deg: Degrees = 0.0


class VaryTable(_Table, kw_only=True):
    apart: Annotated[float, Meta(ge=0.0, le=1000.0)] = 0.0  #: minimum horizontal distance between varied objects


class WorldTable(_Table, kw_only=True):
    room: RoomTable
    vary: VaryTable = field(default_factory=VaryTable)
    box: list[BoxTable] = []
    gate: list[GateTable] = []
    panel: list[PanelTable] = []
    marker: list[MarkerTable] = []
    target: list[BoardTable | PlatformTable | FigureTable] = []
    spawn: list[SpawnTable] = []
    wind: WindTable = field(default_factory=WindTable)
    light: LightTable = field(default_factory=LightTable)


_NEAREST_M = 0.01  # minimum distance between two waypoints
_WALL_GAP_M = 0.004  # distance of posters and markers from their wall, which makes the drawing order unambiguous

N = TypeVar("N", bound=Named)
T = TypeVar("T")


def shipped_worlds() -> tuple[str, ...]:
    """Return the names of the built-in worlds in order."""
    folder = resources.files("skyloop.sim") / "worlds"
    return tuple(sorted(e.name.removesuffix(".toml") for e in folder.iterdir() if e.name.endswith(".toml")))


def load_world(name_or_path: str | FilePath, seed: int = 0) -> World:
    """Load a world.

    Args:
        name_or_path: A built-in world's name, or a file (any name that ends in ``.toml`` or contains a separator).
        seed: Seed for everything in the world that is random.

    Raises:
        UnknownNameError: No built-in world has this name.
        FileFormatError: The file can't be read or understood.
        UsageError: The seed is not an integer, or is negative.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise UsageError(f"seed must be a whole number of at least 0, not {seed!r}")
    text = str(name_or_path)
    if isinstance(name_or_path, FilePath) or text.endswith(".toml") or "/" in text:
        file = FilePath(text)
        return _read_world(read_text(file, "the world file", MAX_BYTES), str(file), file.stem, seed)
    if text not in shipped_worlds():
        raise UnknownNameError("world", text, shipped_worlds())
    shipped = resources.files("skyloop.sim") / "worlds" / f"{text}.toml"
    return _read_world(shipped.read_text(encoding="utf-8"), f"{text}.toml", text, seed)


def parse_world(text: str, name: str = "world") -> World:
    """Parse a world from the text of a world file.

    Raises:
        FileFormatError: The text is not a valid world.
    """
    return _read_world(text, f"{name}.toml", name)


def _read_world(text: str, source: str, name: str, seed: int = 0) -> World:
    values = parse_toml(text, source)
    targets = values.get("target")
    for each in targets if isinstance(targets, list) else ():
        if isinstance(each, dict):
            each.setdefault("kind", "board")
    table = read_tables(values, source, WorldTable)
    place_varied(table, seed, Place(source))
    room = Room(table.room.size, table.room.floor, table.room.walls, table.room.ceiling, table.room.enclosed)
    names: set[str] = set()

    def make_all(key: str, tables: Sequence[N], make: Callable[[N, str, Room, Place], T]) -> tuple[T, ...]:
        made = []
        for number, each in enumerate(tables, 1):
            place = Place(source).item(key, number, each.name)
            item_name = each.name or f"{key} {number}"
            if item_name in names:
                raise place.error("name", f"{item_name!r} is used twice in this file; names must differ")
            names.add(item_name)
            made.append(make(each, item_name, room, place))
        return tuple(made)

    return World(
        name=name,
        room=room,
        boxes=make_all("box", table.box, _box),
        gates=make_all("gate", table.gate, _gate),
        panels=make_all("panel", table.panel, _panel),
        markers=make_all("marker", table.marker, _marker),
        targets=make_all("target", table.target, _target),
        spawns=make_all("spawn", table.spawn, _spawn),
        wind=Wind(table.wind.mean, table.wind.gust, table.wind.time_constant),
        seed=seed,
        light=Light(table.light.amplitude, table.light.period),
    )


def _box(table: BoxTable, name: str, room: Room, place: Place) -> Box:
    if table.stands_at is not None and table.position is not None:
        raise place.error("position", "give either this or 'stands_at', not both")
    if table.stands_at is not None:
        key, position = "stands_at", (*table.stands_at, table.size[2] / 2)
    elif table.position is not None:
        key, position = "position", table.position
    else:
        raise place.error("position", "missing; it must be a list of 3 numbers, or 'stands_at' a list of 2")
    _require_inside(place, key, position, room)
    colour = None if table.colour is None else _colour(table.colour, place)
    return Box(name, position, table.size, math.radians(table.yaw_deg), table.texture, colour)


def _gate(table: GateTable, name: str, room: Room, place: Place) -> Gate:
    _require_inside(place, "position", table.position, room)
    lowest = table.inner_size[1] / 2
    if table.position[2] < lowest:
        raise place.error("position", f"the opening reaches below the floor; z must be at least {lowest:g}")
    colour = (235, 110, 20) if table.colour is None else _colour(table.colour, place)
    return Gate(name, table.position, table.inner_size, math.radians(table.yaw_deg), table.frame, colour)


def _panel(table: PanelTable, name: str, room: Room, place: Place) -> Panel:
    return Panel(name, _face(table, room, place), table.size, table.texture)


def _marker(table: MarkerTable, name: str, room: Room, place: Place) -> Marker:
    return Marker(name, _face(table, room, place), _pattern(table, place))


def _pattern(table: MarkerTable | BoardTable, place: Place) -> MarkerPattern:
    number, last = table.id, MARKER_DICTIONARIES[table.dictionary] - 1
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= last:
        raise place.wrong("id", number, f"a whole number from 0 to {last}")
    margin = table.marker_size / 6 if table.margin is None else table.margin
    return MarkerPattern(table.dictionary, number, table.marker_size, margin)


def _face(table: FaceTable, room: Room, place: Place) -> FacePose:
    turn = math.radians(table.turn_deg)
    if table.on is None:
        if table.at is not None:
            raise place.error("at", "needs 'on', the face of the room")
        if table.position is None:
            raise place.error("position", "missing; give a list of 3 numbers, or 'on' and 'at'")
        _require_inside(place, "position", table.position, room)
        yaw, elevation = math.radians(table.yaw_deg or 0.0), math.radians(table.elevation_deg or 0.0)
        return FacePose(table.position, yaw, elevation, turn)
    for key in ("position", "yaw_deg", "elevation_deg"):
        if getattr(table, key) is not None:
            raise place.error(key, "can't be combined with 'on', which fixes the object's pose")
    if table.at is None:
        raise place.error("at", "missing; it must be a list of 2 numbers")
    pose = _mounted(table.on, *table.at, turn, room)
    _require_inside(place, "at", pose.position_m, room)
    return pose


def _mounted(mount: str, along: float, other: float, turn_rad: float, room: Room) -> FacePose:
    """Return the pose of an object on one of the room's faces.

    On a wall, ``along`` is x (north, south) or y (east, west) and ``other`` is the height. On the floor and the
    ceiling, they are x and y, and the top of the image points east.
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


def _target(table: BoardTable | PlatformTable | FigureTable, name: str, room: Room, place: Place) -> Target:
    if isinstance(table, FigureTable):
        path, yaw = _path(table.path, room, place.under("path")), _yaw(table.yaw)
        size = FIGURE_SIZES_M[table.shape] if table.size is None else table.size
        colour = None if table.colour is None else _colour(table.colour, place)
        return FigureTarget(name, table.shape, path, yaw, size, table.look, colour)
    pattern, yaw = _pattern(table, place), _yaw(table.yaw)
    path = _path(table.path, room, place.under("path"))
    if not isinstance(table, PlatformTable):
        return BoardTarget(name, pattern, path, yaw)
    if pattern.card_size_m > min(table.size[:2]):
        raise place.error(
            "size", f"the marker's card is {pattern.card_size_m:g} m wide and does not fit on the platform"
        )
    return PlatformTarget(name, pattern, path, yaw, table.size, table.texture)


def _path(table: PathTable, room: Room, place: Place) -> Path:
    match table:
        case WaypointsTable():
            return _waypoints(table, room, place)
        case CircleTable():
            _require_box_inside(place, "radius", table.centre, (table.radius, table.radius, 0.0), room)
            start = math.radians(table.start_deg)
            return CirclePath(table.centre, table.radius, table.speed, start, table.clockwise)
        case OvalTable():
            _require_box_inside(place, "length", table.centre, (table.length / 2 + table.radius, 0.0, 0.0), room)
            _require_box_inside(place, "radius", table.centre, (0.0, table.radius, 0.0), room)
            return OvalPath(table.centre, table.length, table.radius, table.speed, table.start, table.clockwise)
        case LissajousTable():
            _require_box_inside(place, "amplitude", table.centre, table.amplitude, room)
            x, y, z = map(math.radians, table.phase_deg)
            return LissajousPath(table.centre, table.amplitude, table.cycles, (x, y, z), table.period)
        case WalkTable():
            return _walk(table, room, place)
        case RingWalkTable():
            return _ring_walk(table, room, place)
        case StillTable():
            _require_inside(place, "position", table.position, room)
            return StillPath(table.position)


def _waypoints(table: WaypointsTable, room: Room, place: Place) -> Path:
    points = table.points
    for point in points:
        _require_inside(place, "points", point, room)
    if len(set(points)) < len(points):
        raise place.error("points", "a point is listed twice; all must differ")
    for one, other in itertools.pairwise([*points, points[0]] if table.closed else points):
        if math.dist(one, other) < _NEAREST_M:
            raise place.error("points", f"{list(one)} and {list(other)} are less than {_NEAREST_M:g} m apart")
    return WaypointPath(tuple(points), table.speed, table.closed)


def _walk(table: WalkTable, room: Room, place: Place) -> Path:
    low, high = table.low, table.high
    _require_inside(place, "low", low, room)
    _require_inside(place, "high", high, room)
    if any(a > b for a, b in zip(low, high, strict=True)) or low == high:
        raise place.error("high", f"{list(high)} must be at least 'low' {list(low)} on each axis and greater on one")
    _require_order(place, "speed", table.speed)
    return WalkPath(low, high, table.speed, table.acceleration)


def _ring_walk(table: RingWalkTable, room: Room, place: Place) -> Path:
    radius, height = table.radius, table.height
    _require_order(place, "radius", radius)
    _require_order(place, "height", height)
    _require_order(place, "speed", table.speed)
    _require_box_inside(place, "radius", (*table.centre, sum(height) / 2), (radius[1], radius[1], 0.0), room)
    _require_inside(place, "height", (*table.centre, height[1]), room)
    return RingWalkPath(table.centre, radius, height, table.speed, table.acceleration)


def _yaw(table: YawTable) -> Yaw:
    match table:
        case FixedTable():
            return FixedYaw(math.radians(table.yaw_deg))
        case AlongTable():
            return AlongYaw(math.radians(table.offset_deg), math.radians(table.turn_rate_deg_s))
        case TowardsTable():
            return TowardsYaw(table.point, math.radians(table.turn_rate_deg_s))


def _spawn(table: SpawnTable, name: str, room: Room, place: Place) -> Spawn:
    _require_inside(place, "position", table.position, room)
    return Spawn(name, table.position, math.radians(table.yaw_deg))


def _require_order(place: Place, key: str, limits: Vec2) -> None:
    if limits[0] > limits[1]:
        raise place.error(key, f"[{limits[0]:g}, {limits[1]:g}] is reversed; give [least, greatest]")


def _require_inside(place: Place, key: str, point: Vec3, room: Room) -> None:
    _require_box_inside(place, key, point, (0.0, 0.0, 0.0), room)


def _require_box_inside(place: Place, key: str, centre: Vec3, reach: Vec3, room: Room) -> None:
    lows, highs = (
        (-room.size_m[0] / 2, -room.size_m[1] / 2, 0.0),
        (room.size_m[0] / 2, room.size_m[1] / 2, room.size_m[2]),
    )
    for axis, c, r, low, high in zip("xyz", centre, reach, lows, highs, strict=True):
        if c - r < low - 1e-9 or c + r > high + 1e-9:
            reached = f"{c - r:g} to {c + r:g}" if r else f"{c:g}"
            raise place.error(
                key, f"{axis} = {reached} is outside the room, where {axis} ranges from {low:g} to {high:g}"
            )


def _colour(text: str, place: Place) -> Rgb:
    digits = text.removeprefix("#")
    if len(digits) != 6 or not text.startswith("#") or any(d not in "0123456789abcdefABCDEF" for d in digits):
        raise place.error("colour", f"{text!r} is not a colour; write red, green and blue as in '#eb6e14'")
    return (int(digits[0:2], 16), int(digits[2:4], 16), int(digits[4:6], 16))


_TRIES = 400  # maximum number of attempts to place one object
_BEGINNINGS = 100  # maximum number of restarts; the objects placed first may leave no room for the last ones

Varied = BoxTable | GateTable | SpawnTable


def place_varied(table: WorldTable, seed: int, place: Place) -> None:
    """Move varied objects to positions that the seed determines, uniformly distributed within their ranges."""
    things = _varied(table)
    if not things:
        return
    random = stream(seed, Purpose.LAYOUT)
    for _ in range(_BEGINNINGS):
        places = _places(things, table.vary.apart, random)
        if places is not None:
            break
    else:
        raise place.under("vary").error(
            "apart", f"no room for {len(things)} objects at least {table.vary.apart:g} m apart"
        )
    for thing, (x, y, z) in zip(things, places, strict=True):
        if isinstance(thing, BoxTable) and thing.stands_at is not None:
            thing.stands_at = (x, y)
        else:
            thing.position = (x, y, z)
        thing.yaw_deg = float(thing.yaw_deg + random.uniform(-1.0, 1.0) * thing.vary_yaw_deg)


def _varied(table: WorldTable) -> list[Varied]:
    things: list[Varied] = [*table.gate, *table.box, *table.spawn]
    return [thing for thing in things if (any(thing.vary) or thing.vary_yaw_deg) and _centre(thing) is not None]


def _places(things: list[Varied], apart_m: float, random: np.random.Generator) -> list[tuple[float, ...]] | None:
    """Return a position for each object; None if there was no room for one of them."""
    places: list[tuple[float, ...]] = []
    for thing in things:
        centre = _centre(thing)
        for _ in range(_TRIES if centre else 0):
            x, y, z = (np.array(centre) + random.uniform(-1.0, 1.0, 3) * thing.vary).tolist()
            if all(math.dist((x, y), other[:2]) >= apart_m for other in places):
                places.append((x, y, z))
                break
        else:
            return None
    return places


def _centre(thing: Varied) -> tuple[float, float, float] | None:
    """Return the position given in the file; None for a box without a position, which is refused later by name."""
    if isinstance(thing, BoxTable) and thing.stands_at is not None:
        return (*thing.stands_at, 0.0)
    return thing.position
