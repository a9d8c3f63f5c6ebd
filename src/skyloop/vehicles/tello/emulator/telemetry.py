"""A Tello's state strings, its replies to queries, and its detection of mission pads on the floor. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from skyloop.messages.geometry import turned, wrap_angle
from skyloop.sim.host import Report
from skyloop.sim.parameters import GRAVITY_M_S2
from skyloop.sim.reports import VehicleTruth
from skyloop.vehicles.tello.wire import GROUND_CM, NO_DISTANCE_CM, NO_PAD, NOWHERE_CM, Sdk, build

LOWEST_M: Final = 0.3  #: minimum height at which pads are recognised; an estimate
HIGHEST_M: Final = 1.2  #: maximum height at which pads are recognised; an estimate
_VIEW: Final = 0.5  # horizontal reach of the downward camera as a fraction of the height; an estimate


@dataclass(frozen=True, slots=True)
class PadSighting:
    """A pad below, and the drone's position above it in world axes; all pads are aligned with those axes."""

    number: int
    place_m: tuple[float, float, float]


def seen(pads: Mapping[int, tuple[float, float]], truth: VehicleTruth) -> PadSighting | None:
    """Return the nearest pad in view; ``pads`` has x and y in world axes [m] by pad number."""
    x, y, z = truth.position_m
    if not LOWEST_M <= z <= HIGHEST_M:
        return None
    in_view = {number: math.dist((x, y), place) for number, place in pads.items()}
    nearest = min(in_view, key=lambda number: in_view[number], default=None)
    if nearest is None or in_view[nearest] > _VIEW * z:
        return None
    east, north = pads[nearest]
    return PadSighting(nearest, (x - east, y - north, z))


FARTHEST_CM: Final = 400  #: range of the distance sensor; an estimate
COLD_C: Final = 60  #: lowest reported temperature; a simulated drone does not warm up
BAROMETER_CM: Final = -6000  #: the barometer's reading at height 0, which is arbitrary as in real drones


@dataclass(frozen=True, slots=True)
class TelloSnapshot:
    """The state at one instant."""

    report: Report
    start_yaw_rad: float  #: yaw when the drone was switched on
    start_altitude_m: float  #: altitude at take-off
    motor_s: int
    pad: PadSighting | None = None


def fields(snapshot: TelloSnapshot) -> dict[str, str]:
    """Return all values as text, in the drone's own units and axes."""
    believed = snapshot.report.believed
    yaw_rad = wrap_angle(believed.yaw_rad - snapshot.start_yaw_rad)
    forward, left, up = believed.velocity_m_s
    ahead, aside = turned(forward, left, yaw_rad)  # velocity relative to the heading at power-on
    ax, ay, az = (part / GRAVITY_M_S2 * 1000 for part in believed.acceleration_m_s2)
    altitude_cm = believed.altitude_m * 100
    steep = math.cos(believed.roll_rad) * math.cos(believed.pitch_rad)
    distance_cm = max(GROUND_CM, round(altitude_cm / max(steep, 0.1)))
    return {
        "pitch": f"{round(math.degrees(-believed.pitch_rad))}",
        "roll": f"{round(math.degrees(believed.roll_rad))}",
        "yaw": f"{round(math.degrees(-yaw_rad))}",
        "vgx": f"{round(ahead * 10)}",
        "vgy": f"{round(-aside * 10)}",
        "vgz": f"{round(-up * 10)}",
        "templ": f"{COLD_C}",
        "temph": f"{COLD_C + 3}",
        "tof": f"{distance_cm if distance_cm <= FARTHEST_CM else NO_DISTANCE_CM}",
        "h": f"{round((believed.altitude_m - snapshot.start_altitude_m) * 10) * 10}",
        "bat": f"{max(0, min(100, round(believed.battery * 100)))}",
        "baro": f"{(BAROMETER_CM + altitude_cm) / 100:.2f}",
        "time": f"{snapshot.motor_s}",
        "agx": f"{ax:.2f}",
        "agy": f"{-ay:.2f}",
        "agz": f"{-az:.2f}",
    }


def state_string(snapshot: TelloSnapshot, sdk: Sdk) -> bytes:
    """Return the datagram with the state, which is sent ten times per second."""
    values = list(fields(snapshot).items())
    return build(values if sdk is Sdk.V1_3 else [*_pad_fields(snapshot.pad), *values])


def answer(question: str, snapshot: TelloSnapshot) -> str:
    """Return the reply to a query about the state; raise ``KeyError`` for other queries."""
    values = fields(snapshot)
    answers = {
        "battery?": values["bat"],
        "time?": values["time"],
        "height?": f"{int(values['h']) // 10}dm",
        "temp?": f"{values['templ']}~{values['temph']}C",
        "attitude?": "".join(f"{name}:{values[name]};" for name in ("pitch", "roll", "yaw")),
        "baro?": values["baro"],
        "acceleration?": "".join(f"{name}:{values[name]};" for name in ("agx", "agy", "agz")),
        "tof?": f"{int(values['tof']) * 10}mm",
    }
    return f"{answers[question]}\r\n"


def _pad_fields(pad: PadSighting | None) -> list[tuple[str, str]]:
    if pad is None:
        numbers = (NO_PAD, NOWHERE_CM, NOWHERE_CM, NOWHERE_CM)
    else:
        x, y, z = (round(part * 100) for part in pad.place_m)
        numbers = (pad.number, x, y, z)
    return [*zip(("mid", "x", "y", "z"), map(str, numbers), strict=True), ("mpry", "0,0,0")]
