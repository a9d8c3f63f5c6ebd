"""A drone's surroundings: the scenery, where it may fly, and where its cameras point; also whether the drone is ready.

All of these requests are read-only.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from skyloop.client import Level, PreflightFinding
from skyloop.cockpit.api import BadRequest, answer_json, answered
from skyloop.cockpit.feeds import ROW_HZ
from skyloop.cockpit.telemetry import Json, number, vector
from skyloop.errors import NoAnswerError, ParameterError
from skyloop.messages import Position
from skyloop.messages.parameter import WORLD, WorldGeometry, decode_world
from skyloop.proxy.core.airspace import Airspace, AirspaceSettings, Limits
from skyloop.zones import FAR_M, Box, Space, Zone, space_of

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.fleet import CockpitFleet
    from skyloop.cockpit.recordings import Recordings
    from skyloop.messages import CameraInfo, Feedback, Value

LIMITS: Final = ("speed", "climb", "altitude")
RECORDED: Final = "recorded."  #: prefix of recorded parameters, see docs/replay.md


def world_values(drone: Drone, given: WorldGeometry | None) -> Json:
    """Query a drone's surroundings from its proxy, and wait. ``given``: the scenery if the drone reports none."""
    read = _reader(drone)
    known = _known(read(WORLD))
    world = known or given
    space = space_from(read)
    return {
        **geometry_values(world),
        "source": "vehicle" if known else "file" if given else None,
        "box": None if space.box is None else _box(space.box),
        "zones": [_zone(zone) for zone in space.zones],
        "limits": {name: _limit(read(f"limits.{name}")) for name in LIMITS},
        "cameras": [view_values(camera) for camera in drone.capabilities.cameras],
    }


def way_values(drone: Drone, place: tuple[float, float, float]) -> Json:
    """Return the proxy's objections to a straight flight from the drone's position to a place, in world axes [m]."""
    read = _reader(drone)

    def limit(name: str) -> float:
        value = _limit(read(f"limits.{name}"))
        return math.inf if value is None else value

    limits = Limits(limit("tilt"), limit("climb"), limit("yaw_rate"), limit("speed"), limit("altitude"))
    airspace = Airspace(AirspaceSettings(limits, space_from(read)))
    return {"problem": airspace.judge(Position(*place), _newest(drone), drone.now_ns, new=True).why}


def space_from(read: Callable[[str], Value | None]) -> Space:
    """Return the space in which a vehicle's parameters allow it to fly; a missing parameter means no limit."""

    def edge(name: str) -> float:
        value = read(name)
        return float(value) if isinstance(value, int | float) else FAR_M if name.endswith("high") else -FAR_M

    def text(name: str) -> str:
        value = read(name)
        return value if isinstance(value, str) else ""

    try:
        return space_of(edge, text)
    except ParameterError:
        return Space()  # this driver uses these parameter names for other values


def geometry_values(world: WorldGeometry | None) -> Json:
    """Convert a world's scenery to JSON values; the lists are empty if nothing is known."""
    if world is None:
        return {"name": "", "room": None, "solids": [], "gates": [], "markers": [], "starts": [], "left_out": 0}
    room = None
    if world.low is not None and world.high is not None:
        room = {"low": vector(world.low), "high": vector(world.high), "enclosed": world.enclosed}
    return {
        "name": world.name,
        "room": room,
        "solids": [_fields(one) for one in world.solids],
        "gates": [_fields(one) for one in world.gates],
        "markers": [_fields(one) for one in world.markers],
        "starts": [_fields(one) for one in world.starts],
        "left_out": world.left_out,
    }


def view_values(camera: CameraInfo) -> Json:
    """Return a camera's view: the rays through the corners of its pictures, in body axes; null if unknown."""
    lens, rotation = camera.intrinsics, camera.rotation
    rays = None
    if lens is not None and rotation is not None and lens.fx > 0 and lens.fy > 0:
        to_body = np.reshape(np.asarray(rotation, dtype=np.float64), (3, 3))
        corners = ((0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height))
        rays = []
        for u, v in corners:
            ray = to_body @ np.array([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, 1.0])
            rays.append([number(float(part)) for part in ray / np.linalg.norm(ray)])
    return {"name": camera.name, "position": vector(camera.position_m), "rays": rays}


def _newest(drone: Drone) -> Feedback | None:
    try:
        return drone.feedback(max_hz=ROW_HZ)
    except NoAnswerError:
        return None


def _reader(drone: Drone) -> Callable[[str], Value | None]:
    """Return a function that reads a parameter's value, or None if there is no such parameter."""
    found = {parameter.name: parameter.value for parameter in drone.config.parameters()}
    # A replay's own proxy has meaningless limits and zones, so the recorded vehicle's are shown instead.
    prefix = RECORDED if drone.uri.startswith("replay:") else ""
    return lambda name: found.get(prefix + name)


def _known(text: Value | None) -> WorldGeometry | None:
    if not isinstance(text, str) or not text:
        return None
    try:
        return decode_world(text)
    except ValueError:
        return None  # this driver uses the parameter name for another value


def _limit(value: Value | None) -> float | None:
    return number(float(value)) if isinstance(value, int | float) and math.isfinite(value) else None


def _box(box: Box) -> Json:
    ends = zip(box.low, box.high, strict=True)
    pairs = [(None if low <= -FAR_M else low, None if high >= FAR_M else high) for low, high in ends]
    return {"low": [low for low, _ in pairs], "high": [high for _, high in pairs]}


def _zone(zone: Zone) -> Json:
    name = {"name": zone.name} if zone.name else {}
    if isinstance(zone, Box):
        return {**name, "kind": "box", "low": vector(zone.low), "high": vector(zone.high)}
    centre = [zone.x, zone.y]
    return {**name, "kind": "cylinder", "centre": centre, "radius": zone.radius, "low": zone.low, "high": zone.high}


def _fields(thing: Any) -> Json:
    return {name: getattr(thing, name) for name in thing.__struct_fields__}


_OURS: Final = PreflightFinding("control", Level.OK, "a page of this cockpit has control")
MAX_ASKING: Final = 4  #: maximum number of parallel requests to drones; each may block its thread for seconds


class WorldApi:
    """The routes ``world``, ``way`` and ``preflight`` of each drone. ``given``: the scenery if a drone reports none."""

    def __init__(self, fleet: CockpitFleet, recordings: Recordings, given: WorldGeometry | None) -> None:
        self._fleet = fleet
        self._recordings = recordings
        self._given = given
        self._asking = asyncio.Semaphore(MAX_ASKING)

    def routes(self) -> list[Route]:
        return [
            Route("/api/drones/{name}/world", self.world),
            Route("/api/drones/{name}/way", self.way),
            Route("/api/drones/{name}/preflight", self.preflight),
        ]

    @answered
    async def world(self, request: Request) -> Response:
        return await self._ask(request, lambda drone: world_values(drone, self._given))

    @answered
    async def way(self, request: Request) -> Response:
        """Respond with the objections to a straight flight to a place, ``?to=X,Y,Z``."""
        place = _place(request.query_params.get("to", ""))
        return await self._ask(request, lambda drone: way_values(drone, place))

    @answered
    async def preflight(self, request: Request) -> Response:
        folder = self._recordings.folder
        station = self._fleet.stations.get(request.path_params["name"])
        ours = station is not None and bool(station.view.overview()["me"])

        def check(drone: Drone) -> list[Any]:
            findings = drone.preflight(folder=folder)
            return [asdict(_OURS if ours and one.check == "control" else one) for one in findings]

        return await self._ask(request, check)

    async def _ask(self, request: Request, question: Callable[[Drone], Any]) -> Response:
        """Query a drone on a thread, because its proxy may take a while to answer."""
        drone = self._fleet.station(request.path_params["name"]).drone
        async with self._asking:
            return answer_json(await asyncio.to_thread(question, drone))


def _place(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise BadRequest(400, f"to must be three finite numbers in metres, such as 1.5,0,1, not {text!r:.60}")
    return x, y, z
