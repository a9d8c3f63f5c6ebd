"""The tables of a world file and their allowed values. Lengths [m], speeds [m/s], angles in degrees (``_deg``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta, Struct, field

from skyloop.messages.fields import Finite
from skyloop.sim.world import MARKER_DICTIONARIES, TEXTURES

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
#: The id of a marker; which ones are valid depends on the dictionary.
MarkerId = Annotated[Any, Meta(description="a whole number, a marker's in its dictionary")]


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
    """An object that the seed may move up to this far from its position in the file."""

    vary: tuple[Amplitude, Amplitude, Amplitude] = (0.0, 0.0, 0.0)
    vary_yaw_deg: Annotated[float, Meta(ge=0.0, le=180.0)] = 0.0


class BoxTable(VariedTable, kw_only=True):
    size: Size
    stands_at: Spot | None = None  #: position on the floor, the usual case
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
    """Position on a face of the room by two coordinates, or anywhere with a heading."""

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
    """The path is on the ground below the figure, and the heading is by default that of the path."""

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
