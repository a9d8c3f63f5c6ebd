"""Frozen descriptions of simulated worlds, without motion (see ``targets``) or file reading (see ``world_file``).

World axes: x east, y north, z up, metres, radians; yaw 0 faces east, positive yaw is counter-clockwise from above.
The room's floor is centred on the origin: x in ±size/2, y in ±size/2, z from 0 to the height.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.messages.parameter import Card, Opening, Solid, Start, WorldGeometry
from skyloop.sim.streams import Purpose, stream

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Rgb = tuple[int, int, int]


def vec3(values: NDArray[np.float64]) -> Vec3:
    """Return three numbers of an array as plain floats."""
    x, y, z = values.tolist()
    return x, y, z


# Surface names that a renderer must support. A world file with any other texture name is refused.
TEXTURES: tuple[str, ...] = (
    "asphalt",
    "books",
    "brick",
    "carpet",
    "checker",
    "concrete",
    "crate",
    "door",
    "fabric",
    "grass",
    "metal",
    "parquet",
    "plaster",
    "poster_chart",
    "poster_landscape",
    "poster_pattern",
    "tiles",
    "window",
    "wood",
)

# ArUco and AprilTag dictionaries by their OpenCV names, with the number of markers in each (ids 0 … n-1).
# Source: cv::aruco::PredefinedDictionaryType, OpenCV 4.x reference.
MARKER_DICTIONARIES: dict[str, int] = {
    **{f"DICT_{bits}X{bits}_{count}": count for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
}


@dataclass(frozen=True, slots=True)
class FacePose:
    """Pose of a flat object (poster, marker, board).

    ``yaw_rad`` and ``elevation_rad`` give the direction of the outward normal: its heading, and its angle above the
    horizon (π/2 points straight up, as for a marker that lies on the floor). ``turn_rad`` rotates the picture in its
    own plane, counter-clockwise as seen from the front.
    """

    position_m: Vec3
    yaw_rad: float = 0.0
    elevation_rad: float = 0.0
    turn_rad: float = 0.0

    def rotation(self) -> NDArray[np.float64]:
        """Return the world-from-face rotation, (3, 3); columns: picture's right, picture's up, outward normal."""
        cy, sy = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        ce, se = math.cos(self.elevation_rad), math.sin(self.elevation_rad)
        right = np.array([-sy, cy, 0.0])
        up = np.array([-se * cy, -se * sy, ce])
        normal = np.array([ce * cy, ce * sy, se])
        ct, st = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return np.column_stack([ct * right + st * up, ct * up - st * right, normal])


@dataclass(frozen=True, slots=True)
class Room:
    """The bounds of the world, which drones never leave.

    If not ``enclosed``, the world has ground and sky but no visible walls or ceiling; its bounds then act as a net.
    """

    size_m: Vec3  # x, y, z extents
    floor: str = "parquet"
    walls: str = "plaster"
    ceiling: str = "plaster"
    enclosed: bool = True


@dataclass(frozen=True, slots=True)
class Box:
    """A solid upright box: ``position_m`` is its centre, and ``size_m`` its extents along its own x, y and z axes."""

    name: str
    position_m: Vec3
    size_m: Vec3
    yaw_rad: float = 0.0
    texture: str = "crate"
    colour: Rgb | None = None  # plain colour that replaces the texture

    def corners(self) -> NDArray[np.float64]:
        """Return the corners in world axes, shape (8, 3). Bits 0, 1 and 2 of the row number select +x, +y and +z."""
        bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
        local = (bits - 0.5) * np.asarray(self.size_m)
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        world = np.column_stack([c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1], local[:, 2]])
        corners: NDArray[np.float64] = world + np.asarray(self.position_m)
        return corners


@dataclass(frozen=True, slots=True)
class Gate:
    """A rectangular frame to fly through."""

    name: str
    position_m: Vec3  #: position of the opening's centre
    inner_size_m: Vec2  #: width and height of the opening
    yaw_rad: float = 0.0  #: heading for flying through the gate
    frame_m: float = 0.08  #: thickness of the frame's bars
    colour: Rgb = (235, 110, 20)

    def bars(self) -> tuple[Box, ...]:
        """Return the solid parts: top, bottom, left and right bars, and two legs if the opening is above the floor."""
        width, height = self.inner_size_m
        bar, x, y, z = self.frame_m, *self.position_m
        side = (width + bar) / 2
        parts = [
            ("top", 0.0, z + (height + bar) / 2, width + 2 * bar, bar),
            ("bottom", 0.0, z - (height + bar) / 2, width + 2 * bar, bar),
            ("left", side, z, bar, height),
            ("right", -side, z, bar, height),
        ]
        leg = z - height / 2 - bar
        if leg > 0.01:
            parts += [("left leg", side, leg / 2, bar, leg), ("right leg", -side, leg / 2, bar, leg)]
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return tuple(
            Box(
                name=f"{self.name} {part}",
                position_m=(x - s * left, y + c * left, centre_z),
                size_m=(bar, across, up),
                yaw_rad=self.yaw_rad,
                colour=self.colour,
            )
            for part, left, centre_z, across, up in parts
        )


@dataclass(frozen=True, slots=True)
class Panel:
    """A flat textured rectangle without thickness: a poster, a window, a door. Drones don't collide with it."""

    name: str
    pose: FacePose
    size_m: Vec2  # width, height
    texture: str


@dataclass(frozen=True, slots=True)
class MarkerPattern:
    """A printed marker whose black square has edges of ``size_m``, with a white margin of ``margin_m``."""

    dictionary: str
    marker_id: int
    size_m: float
    margin_m: float

    @property
    def card_size_m(self) -> float:
        """Return the edge of the square card: the black square plus the margin on both sides."""
        return self.size_m + 2 * self.margin_m


@dataclass(frozen=True, slots=True)
class Marker:
    """A printed marker, with the pose of its centre. The top of the marker is the top of the picture."""

    name: str
    pose: FacePose
    pattern: MarkerPattern


@dataclass(frozen=True, slots=True)
class WaypointPath:
    """Straight legs between points at a constant speed: a loop if ``closed``, else back and forth."""

    points_m: tuple[Vec3, ...]
    speed_m_s: float
    closed: bool = True


@dataclass(frozen=True, slots=True)
class CirclePath:
    """A level circle at a constant speed, starting at ``start_rad`` from east, counter-clockwise as seen from above."""

    centre_m: Vec3
    radius_m: float
    speed_m_s: float
    start_rad: float = 0.0
    clockwise: bool = False


@dataclass(frozen=True, slots=True)
class OvalPath:
    """A level race track at a constant speed: two straights along x joined by half circles, counter-clockwise.

    It starts ``start_m`` after the beginning of the southern straight, or of the northern one if clockwise.
    """

    centre_m: Vec3
    length_m: float  #: length of each straight
    radius_m: float
    speed_m_s: float
    start_m: float = 0.0
    clockwise: bool = False


@dataclass(frozen=True, slots=True)
class LissajousPath:
    """position = centre + amplitude · sin(2π · cycles · t / period + phase) on each axis."""

    centre_m: Vec3
    amplitude_m: Vec3
    cycles: Vec3
    phase_rad: Vec3
    period_s: float


@dataclass(frozen=True, slots=True)
class WalkPath:
    """A seeded random walk between points in a box; the speed of each leg is drawn from a range.

    The box extends from ``low_m`` to ``high_m``. Corners are rounded (the acceleration is at most
    ``acceleration_m_s2``), so the walk can leave the box by about 0.1 m.
    """

    low_m: Vec3
    high_m: Vec3
    speed_m_s: Vec2  # minimum, maximum
    acceleration_m_s2: float = 0.5


@dataclass(frozen=True, slots=True)
class RingWalkPath:
    """A seeded random walk around a centre within a ring, with occasional reversals. Corners are rounded."""

    centre_m: Vec2
    radius_m: Vec2  # minimum, maximum
    height_m: Vec2  # minimum, maximum
    speed_m_s: Vec2  # minimum, maximum
    acceleration_m_s2: float = 0.5


@dataclass(frozen=True, slots=True)
class StillPath:
    """A fixed point, for a parked car or a waiting person."""

    position_m: Vec3


Path = WaypointPath | CirclePath | OvalPath | LissajousPath | WalkPath | RingWalkPath | StillPath


@dataclass(frozen=True, slots=True)
class FixedYaw:
    """A constant heading."""

    yaw_rad: float


@dataclass(frozen=True, slots=True)
class AlongYaw:
    """The heading of the motion plus an offset; it turns at most as fast as the limit allows."""

    offset_rad: float
    turn_rate_rad_s: float


@dataclass(frozen=True, slots=True)
class TowardsYaw:
    """The heading towards a point on the floor plan; it turns at most as fast as the limit allows."""

    point_m: Vec2
    turn_rate_rad_s: float


Yaw = FixedYaw | AlongYaw | TowardsYaw


@dataclass(frozen=True, slots=True)
class BoardTarget:
    """An upright card with a marker that is carried along a path. Drones can fly through it.

    The path describes the card's centre, and the yaw is the heading of the card's face.
    """

    name: str
    pattern: MarkerPattern
    path: Path
    yaw: Yaw


@dataclass(frozen=True, slots=True)
class PlatformTarget:
    """A solid slab with a marker on top, moving along a path. Drones can land on it.

    The path describes the centre of the top face, and the top of the marker points along the platform's heading.
    """

    name: str
    pattern: MarkerPattern
    path: Path
    yaw: Yaw
    size_m: Vec3
    texture: str = "wood"


FIGURE_SIZES_M: dict[str, Vec3] = {"person": (0.42, 0.56, 1.76), "car": (2.6, 1.3, 1.15)}  #: depth, width and height


@dataclass(frozen=True, slots=True)
class FigureTarget:
    """A solid dummy that moves along a path on the ground: a person with swinging legs and arms, or a car.

    The path describes the centre of its footprint (z is the ground below it), and the yaw is its heading.
    """

    name: str
    shape: str  #: ``person`` or ``car``, a key of :data:`FIGURE_SIZES_M`
    path: Path
    yaw: Yaw
    size_m: Vec3  #: size along the figure's own x (forward), y (left) and z
    #: index that selects the colours and pattern of the clothes; figures with the same shape and index are look-alikes
    look: int = 0
    colour: Rgb | None = None  #: colour of a person's top or a car's body; None for the look's colour


Target = BoardTarget | PlatformTarget | FigureTarget


@dataclass(frozen=True, slots=True)
class TargetState:
    """The state of a moving target at a simulation time, in world axes.

    Position [m], yaw [rad, within ±π] and velocity [m/s]. The position of a platform is the centre of its top face; the
    position of a figure is the ground below it. ``walked_m`` is the distance travelled since the start, and
    ``yaw_rate_rad_s`` is the turn rate.
    """

    name: str
    time_s: float
    position_m: Vec3
    yaw_rad: float
    velocity_m_s: Vec3
    walked_m: float = 0.0
    yaw_rate_rad_s: float = 0.0

    def face(self, target: Target) -> FacePose:
        """Return the pose of the target's marker at the time of this state."""
        if isinstance(target, PlatformTarget):
            # The picture faces up, with its top along the heading; FacePose explains the half turn.
            return FacePose(self.position_m, yaw_rad=self.yaw_rad + math.pi, elevation_rad=math.pi / 2)
        return FacePose(self.position_m, yaw_rad=self.yaw_rad)


@dataclass(frozen=True, slots=True)
class Wind:
    """Moving air: a mean velocity (the direction it blows towards) and gusts.

    Gusts are a first-order Gauss-Markov process per axis. ``gust_m_s`` is the standard deviation along each horizontal
    axis; the vertical one is half of it.
    """

    mean_m_s: Vec3 = (0.0, 0.0, 0.0)
    gust_m_s: float = 0.0
    time_constant_s: float = 1.0


@dataclass(frozen=True, slots=True)
class Light:
    """Slowly changing daylight, as if clouds were passing: between 1 - ``amplitude`` and 1 times the full brightness.

    The light sums two sines with periods of ``period_s`` and about a third of it, and phases from the world's seed.
    """

    amplitude: float = 0.0
    period_s: float = 60.0

    def at(self, time_s: float, seed: int = 0) -> float:
        """Return the brightness at a simulation time [s], from 1 - amplitude to 1; exactly 1 for amplitude 0."""
        if self.amplitude == 0.0:
            return 1.0
        first, second = stream(seed, Purpose.LIGHT).uniform(0.0, 2 * math.pi, 2).tolist()
        turn = 2 * math.pi * time_s / self.period_s
        wave = 0.7 * math.sin(turn + first) + 0.3 * math.sin(2.7 * turn + second)
        return 1.0 - self.amplitude * (0.5 - 0.5 * wave)


@dataclass(frozen=True, slots=True)
class Spawn:
    """A drone's starting position. ``position_m`` is on the ground below the drone's centre."""

    name: str
    position_m: Vec3
    yaw_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class World:
    """A whole world. ``seed`` determines everything random in it: its layout, the walks of its targets, its light."""

    name: str
    room: Room
    boxes: tuple[Box, ...] = ()
    gates: tuple[Gate, ...] = ()
    panels: tuple[Panel, ...] = ()
    markers: tuple[Marker, ...] = ()
    targets: tuple[Target, ...] = ()
    spawns: tuple[Spawn, ...] = ()
    wind: Wind = Wind()
    seed: int = 0
    light: Light = Light()

    def solids(self) -> tuple[Box, ...]:
        """Return all fixed solids: the boxes, and the bars and legs of the gates."""
        return self.boxes + tuple(bar for gate in self.gates for bar in gate.bars())


def geometry_of(world: World) -> WorldGeometry:
    """Return the fixed geometry of a world, without its textures and moving objects."""
    x, y, z = world.room.size_m
    return WorldGeometry(
        name=world.name[:64],
        low=(-x / 2, -y / 2, 0.0),
        high=(x / 2, y / 2, z),
        enclosed=world.room.enclosed,
        solids=tuple(
            Solid(b.name, _rounded(b.position_m), _rounded(b.size_m), round(b.yaw_rad, 4)) for b in world.boxes
        ),
        gates=tuple(
            Opening(g.name, _rounded(g.position_m), g.inner_size_m, round(g.yaw_rad, 4), g.frame_m) for g in world.gates
        ),
        markers=tuple(
            Card(
                m.name,
                _rounded(m.pose.position_m),
                m.pattern.size_m,
                round(m.pose.yaw_rad, 4),
                round(m.pose.elevation_rad, 4),
            )
            for m in world.markers
        ),
        starts=tuple(Start(s.name, _rounded(s.position_m), round(s.yaw_rad, 4)) for s in world.spawns),
    )


def _rounded(place: tuple[float, float, float]) -> tuple[float, float, float]:
    """Round to millimetres, to keep the encoded geometry short."""
    return round(place[0], 3), round(place[1], 3), round(place[2], 3)
