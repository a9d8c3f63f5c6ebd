"""The Tello's state, ten texts a second, as typed values in the units that it comes in; what it does not know is None.

Axes are those of aviation, x forward, y right, z down: positive pitch is nose up, positive roll right side down,
positive yaw clockwise. That attitude and accelerations agree in this is seen in recorded strings: a Tello that sends a
pitch of 8° sends 0.116 g along its x.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final

from skyloop.errors import DecodeError

LONGEST: Final = 1024
FIELDS: Final = 64  #: more than any version has
NO_DISTANCE_CM: Final = 6553  #: the distance sensor's "nothing measured"
GROUND_CM: Final = 10  #: what the distance sensor reports on the ground, and the least that it can
NO_PAD: Final = -1  #: none is seen; -2: they are not looked for
NOWHERE_CM: Final = -100  #: each coordinate while no pad is seen
_FIELD: Final = re.compile(r"([a-z]+):(-?\d+(?:\.\d+)?(?:,-?\d+(?:\.\d+)?){0,2})\Z")

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Pad:
    """A mission pad that is seen, and where the Tello is above it: axes as printed on the pad, z up [cm]."""

    number: int
    place_cm: Vector | None
    angles_deg: Vector | None  #: ``mpry``: pitch, roll, yaw to the pad


@dataclass(frozen=True, slots=True)
class State:
    """One state string. None: missing, or the value that means "not known"."""

    pitch_deg: float | None = None
    roll_deg: float | None = None
    yaw_deg: float | None = None
    speed_dm_s: Vector | None = None  #: ``vgx``, ``vgy``, ``vgz``
    temperature_c: tuple[float, float] | None = None  #: lowest and highest
    distance_cm: float | None = None  #: ``tof``: to what is below
    height_cm: float | None = None  #: above where it took off; may be negative
    battery_percent: float | None = None
    barometer: float | None = None  #: as sent; its zero and unit differ between versions
    motor_s: int | None = None  #: how long motors have run since it was switched on
    acceleration_mg: Vector | None = None
    pad: Pad | None = None
    pads: bool = False  #: whether it has fields for pads at all
    fields: tuple[tuple[str, float | Vector], ...] = ()  #: all of it, as sent


def parse(datagram: bytes) -> State:
    """A state datagram. Fields that make no sense are left out; raises :class:`DecodeError` if nothing is left.

    A string that was cut off loses its last field, unless it ends with its semicolon.
    """
    if len(datagram) > LONGEST:
        raise DecodeError(f"a state string of {len(datagram)} bytes; the Tello's have less than {LONGEST}")
    try:
        text = datagram.decode("ascii")
    except UnicodeDecodeError:
        raise DecodeError("a state string with bytes that are no ASCII") from None
    fields: dict[str, float | Vector] = {}
    for part in text.strip("\r\n\0 ").split(";")[:FIELDS]:
        match = _FIELD.match(part)
        if match is None:
            continue
        numbers = tuple(float(number) for number in match[2].split(","))
        if len(numbers) == 1 and math.isfinite(numbers[0]):
            fields[match[1]] = numbers[0]
        elif len(numbers) == 3 and all(map(math.isfinite, numbers)):
            fields[match[1]] = (numbers[0], numbers[1], numbers[2])
    if not fields:
        raise DecodeError(f"no field of a state string in {datagram[:40]!r}")
    return _state(fields)


def _state(fields: dict[str, float | Vector]) -> State:
    def number(name: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        value = fields.get(name)
        return value if isinstance(value, float) and low <= value <= high else None

    def vector(*names: str) -> Vector | None:
        x, y, z = (number(name) for name in names)
        return None if x is None or y is None or z is None else (x, y, z)

    low, high = number("templ", -50, 150), number("temph", -50, 150)
    motor_s = number("time", 0)
    return State(
        pitch_deg=number("pitch", -180, 180),
        roll_deg=number("roll", -180, 180),
        yaw_deg=number("yaw", -360, 360),
        speed_dm_s=vector("vgx", "vgy", "vgz"),
        temperature_c=None if low is None or high is None else (low, high),
        distance_cm=number("tof", 0, NO_DISTANCE_CM - 1),
        height_cm=number("h", -10_000, 10_000),
        battery_percent=number("bat", 0, 100),
        barometer=number("baro"),
        motor_s=None if motor_s is None else int(motor_s),
        acceleration_mg=vector("agx", "agy", "agz"),
        pad=_pad(fields, number("mid"), vector("x", "y", "z")),
        pads="mid" in fields,
        fields=tuple(fields.items()),
    )


PADS: Final = range(1, 9)  #: the numbers of the pads that there are


def _pad(fields: dict[str, float | Vector], number: float | None, place: Vector | None) -> Pad | None:
    if number is None or number not in PADS:  # -1 and 0: none is in view; some firmware says 257 then
        return None
    angles = fields.get("mpry")
    nowhere = (float(NOWHERE_CM),) * 3
    return Pad(int(number), None if place == nowhere else place, angles if isinstance(angles, tuple) else None)


def build(fields: list[tuple[str, str]]) -> bytes:
    """A state datagram with these fields, in their order, as a Tello ends it."""
    return ("".join(f"{name}:{value};" for name, value in fields) + "\r\n").encode("ascii")
