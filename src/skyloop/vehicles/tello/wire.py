"""The Ryze Tello's text protocol: commands, replies, state, video. Pure.

From Ryze, "Tello SDK" 1.3 and "Tello SDK 2.0 User Guide".

What SDK 3.0 (Tello Talent, and EDU with newer firmware) has besides is known from the commands that djitellopy sends.

A reply does not say what it answers, and may come seconds late or twice. So a reply is taken for a command's only if it
has the shape that this command's answers have.

State comes ten times a second; what is not known is None. Axes are those of aviation, x forward, y right, z down:
positive pitch is nose up, positive roll right side down, positive yaw clockwise. That attitude and accelerations agree
in this is seen in recorded strings: a Tello that sends a pitch of 8° sends 0.116 g along its x.

Video is H.264 in Annex B form, cut into pieces of 1460 bytes without any header. Nothing numbers the pieces. A piece
that is shorter than the others ends a picture; one that begins with a start code begins the next. Of a picture whose
piece was lost in the middle the only sign is that it does not decode.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import Final

from skyloop.drivers.h264 import (
    IDR,
    PPS,
    SLICE,
    SPS,
    START,
    Sequence,
    Slice,
    missing_between,
    parse_sequence,
    parse_slice,
)
from skyloop.drivers.h264 import unit_type as type_of
from skyloop.drivers.h264 import units as units_of
from skyloop.errors import DecodeError

PORT: Final = 8889  #: where the Tello takes commands; it answers to where a command came from
STATE_PORT: Final = 8890  #: of the client, where state comes
VIDEO_PORT: Final = 11111  #: of the client, where video comes
HOST: Final = "192.168.10.1"  #: of a Tello that is its own access point
SILENCE_S: Final = 15.0  #: without a command for so long the Tello lands by itself

ENTER: Final = "command"  #: nothing works before it
MAX_STICK: Final = 100
#: What a stick of 100 comes to. Estimates: no guide says it, and people take ``rc`` for cm/s and degrees a second.
FULL_SPEED_M_S: Final = 1.0
FULL_CLIMB_M_S: Final = 1.0
FULL_YAW_RATE_RAD_S: Final = 1.75
MAX_COMMAND: Final = 256  #: no command and no reply of the SDK is nearly as long


class Sdk(StrEnum):
    """Versions of the protocol. Each knows what those before it know."""

    V1_3 = "1.3"
    V2_0 = "2.0"
    V3_0 = "3.0"

    def knows(self, other: Sdk) -> bool:
        """Whether it is this one or newer."""
        return self.value >= other.value


@dataclass(frozen=True, slots=True)
class Stick:
    """``rc``: each from -100 to 100. Positive is right, forward, up, and clockwise seen from above."""

    right: int = 0
    forward: int = 0
    up: int = 0
    clockwise: int = 0

    @property
    def text(self) -> str:
        return f"rc {self.right} {self.forward} {self.up} {self.clockwise}"


LEVEL: Final = Stick()


def ports(state: int, video: int) -> str:
    """SDK 3.0: where state and video are to be sent."""
    return f"port {state} {video}"


def decoded(datagram: bytes) -> str | None:
    """The text of a datagram without what surrounds it; None for what is no text of this protocol."""
    if len(datagram) > MAX_COMMAND:
        return None
    try:
        text = datagram.decode("ascii").strip("\r\n\0 ")
    except UnicodeDecodeError:
        return None
    return text if text.isprintable() else None


_ERROR: Final = re.compile(r"(error|unknown command|out of range|unactive|forced stop)", re.IGNORECASE)


class Shape(Enum):
    """What an answer that is no error looks like."""

    OK = re.compile(r"ok\Z", re.IGNORECASE)
    NUMBER = re.compile(r"-?\d+(\.\d+)?\Z")  #: ``battery?``, ``wifi?``, ``sdk?``, ``speed?``, ``baro?``
    TIME = re.compile(r"\d+( ?s)?\Z")  #: ``time?``: a bare number, or with its unit
    LENGTH = re.compile(r"-?\d+ ?(mm|dm|cm)\Z")  #: ``height?``, ``tof?``
    TEMPERATURE = re.compile(r"-?\d+~-?\d+ ?C\Z")  #: ``temp?``
    NAME = re.compile(r"(?=.*[A-Za-z])(?!ok\Z)[0-9A-Za-z]{4,32}\Z")  #: ``sn?``
    FIELDS = re.compile(r"[a-z]+:-?[\d.]+;([a-z]+:-?[\d.]+;)*\Z")  #: ``attitude?``, ``acceleration?``


#: What is answered otherwise than with "ok".
READ: Final = {
    "speed?": Shape.NUMBER,
    "battery?": Shape.NUMBER,
    "time?": Shape.TIME,
    "height?": Shape.LENGTH,
    "temp?": Shape.TEMPERATURE,
    "attitude?": Shape.FIELDS,
    "baro?": Shape.NUMBER,
    "acceleration?": Shape.FIELDS,
    "tof?": Shape.LENGTH,
    "wifi?": Shape.NUMBER,
    "sdk?": Shape.NUMBER,
    "sn?": Shape.NAME,
}


def shape_of(command: str) -> Shape:
    """Of a command's answer."""
    return READ.get(command, Shape.OK)


def is_error(reply: str) -> bool:
    """Whether it reports that a command, whichever, was not executed."""
    return _ERROR.match(reply) is not None


def answers(reply: str, command: str) -> bool:
    """Whether this reply can be this command's: an answer of its shape, or an error."""
    if reply.lower().startswith("unknown command"):
        named = reply.partition(":")[2].strip()
        return named in ("", command)
    return is_error(reply) or shape_of(command).value.match(reply) is not None


MAX_STATE: Final = 1024
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
    if len(datagram) > MAX_STATE:
        raise DecodeError(f"a state string of {len(datagram)} bytes; the Tello's have less than {MAX_STATE}")
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


PIECE: Final = 1460  #: bytes of every datagram of a picture but its last
MAX_PICTURE: Final = 1 << 19  #: bytes; real ones have a fiftieth of that
_HEAD: Final = 256  # bytes in which parameter sets and the beginning of the first slice are looked for


@dataclass(frozen=True, slots=True)
class AccessUnit:
    """One picture as it came."""

    data: bytes
    is_key: bool  #: decoding can begin here
    arrived_ns: int  #: when its first piece came
    after_gap: bool  #: a picture before it is known to be missing or damaged
    whole: bool  #: nothing shows that a piece of its own is missing
    number: int = 0  #: counts the pictures that came
    width: int = 0  #: by the newest parameters [px]; 0 before the first
    height: int = 0


def pieces(picture: bytes) -> list[bytes]:
    """A picture's datagrams."""
    return [picture[at : at + PIECE] for at in range(0, len(picture), PIECE)]


class Assembly:
    """Pieces in the order of their coming to pictures. Never raises for what it is fed.

    ``stray`` counts bytes that belong to no picture, ``missing`` the pictures that the numbers in the stream show to be
    missing.
    """

    def __init__(self) -> None:
        self.stray = 0
        self.missing = 0
        self._pieces: list[bytes] = []
        self._size = 0
        self._arrived_ns = 0
        self._sequence: Sequence | None = None
        self._before: Slice | None = None
        self._gap = True  # since the last picture that was given out
        self._count = 0

    def feed(self, piece: bytes, now_ns: int) -> list[AccessUnit]:
        """A datagram that came now; the pictures that are complete with it, at most two."""
        found = []
        begins = piece.startswith(START)
        if begins and self._has_picture():
            found += self._end(whole=False)  # its last piece was lost, unless it was as long as the others
        if not begins and not self._pieces:
            self.stray += len(piece)
            self._gap = True
            return found
        if not self._pieces:
            self._arrived_ns = now_ns
        self._pieces.append(piece)
        self._size += len(piece)
        if self._size > MAX_PICTURE:
            self._drop()
        elif len(piece) < PIECE and self._has_picture():
            found += self._end(whole=True)
        return found

    def _has_picture(self) -> bool:
        """Whether a slice has come; parameter sets may come in datagrams of their own."""
        if not self._pieces:
            return False
        return any(type_of(unit) in (SLICE, IDR) for unit in units_of(self._head()))

    def _head(self) -> bytes:
        head = b""
        for piece in self._pieces:
            head += piece[:_HEAD]
            if len(piece) > _HEAD:
                break
        return head

    def _drop(self) -> None:
        self.stray += self._size
        self._pieces, self._size, self._gap = [], 0, True

    def _end(self, *, whole: bool) -> list[AccessUnit]:
        head = units_of(self._head())
        kinds = {type_of(unit) for unit in head}
        gap = self._is_gap(head)
        data = b"".join(self._pieces)
        self._pieces, self._size = [], 0
        is_key = IDR in kinds and {SPS, PPS} <= kinds
        size = (0, 0) if self._sequence is None else (self._sequence.width, self._sequence.height)
        made = AccessUnit(data, is_key, self._arrived_ns, self._gap or gap, whole, self._count, *size)
        self._gap = False
        self._count += 1
        return [made]

    def _is_gap(self, head: list[bytes]) -> bool:
        """Whether the number of this picture does not follow that of the one before. Takes note of it."""
        try:
            for unit in head:
                if type_of(unit) == SPS:
                    self._sequence = parse_sequence(unit)
            if self._sequence is None:
                return False
            now = parse_slice(next(unit for unit in head if type_of(unit) in (SLICE, IDR)), self._sequence)
        except DecodeError:
            self._before = None
            return False
        before, self._before = self._before, now
        if now.is_key or before is None:
            return False
        skipped = missing_between(before, now, self._sequence)
        self.missing += min(skipped, 1 << self._sequence.frame_number_bits - 1)
        return skipped != 0 or not now.is_first
