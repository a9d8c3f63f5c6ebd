"""The Ryze Tello's text protocol: commands, replies, state and video. Pure.

Sources: Ryze, "Tello SDK" 1.3 and "Tello SDK 2.0 User Guide". The additions in SDK 3.0 (Tello Talent, and EDU with
newer firmware) are known from the commands that djitellopy sends.

A reply does not identify its command, and may arrive seconds late or twice. A reply is therefore matched to a command
only if it has the format of that command's replies.

State arrives ten times per second; unknown values are None. Axes follow aviation: x forward, y right, z down;
positive pitch is nose up, positive roll right side down, positive yaw clockwise. Recorded strings confirm this for both
attitude and acceleration: a Tello that reports a pitch of 8° reports 0.116 g along x.

Video is H.264 in Annex B form, divided into pieces of 1460 bytes without headers or numbers. A piece shorter than the
others ends an image, and a piece that begins with a start code begins the next image. If a piece is lost in the middle
of an image, only the decoder notices.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import Final

from skyloop.drivers import h264
from skyloop.errors import DecodeError

PORT: Final = 8889  #: the Tello's port for commands; it replies to the sender's port
STATE_PORT: Final = 8890  #: the client's port for state
VIDEO_PORT: Final = 11111  #: the client's port for video
HOST: Final = "192.168.10.1"  #: address of a Tello that is its own access point
SILENCE_S: Final = 15.0  #: time without a command after which the Tello lands

ENTER: Final = "command"  #: command that must be sent first
MAX_STICK: Final = 100  #: value of ``rc`` for a full stick
#: Effect of a stick at 100; an estimate, because no guide gives it. Users assume that ``rc`` is in cm/s and degrees/s.
FULL_SPEED_M_S: Final = 1.0
FULL_CLIMB_M_S: Final = 1.0
FULL_YAW_RATE_RAD_S: Final = 1.75
MAX_COMMAND: Final = 256  #: length in characters; all commands and replies in the SDK are much shorter


class Sdk(StrEnum):
    """Protocol versions, each a superset of the previous ones."""

    V1_3 = "1.3"
    V2_0 = "2.0"
    V3_0 = "3.0"

    def knows(self, other: Sdk) -> bool:
        """Return whether this version is the other version or a newer one."""
        return self.value >= other.value


@dataclass(frozen=True, slots=True)
class TelloStick:
    """Values of ``rc``, from -100 to 100. Positive values mean right, forward, up, and clockwise seen from above."""

    right: int = 0
    forward: int = 0
    up: int = 0
    clockwise: int = 0

    @property
    def text(self) -> str:
        return f"rc {self.right} {self.forward} {self.up} {self.clockwise}"


LEVEL: Final = TelloStick()


def ports(state: int, video: int) -> str:
    """Return the command that sets the ports for state and video (SDK 3.0)."""
    return f"port {state} {video}"


def decoded(datagram: bytes) -> str | None:
    """Return a datagram's text without surrounding white space; None if it is not valid text in this protocol."""
    if len(datagram) > MAX_COMMAND:
        return None
    try:
        text = datagram.decode("ascii").strip("\r\n\0 ")
    except UnicodeDecodeError:
        return None
    return text if text.isprintable() else None


_ERROR: Final = re.compile(r"(error|unknown command|out of range|unactive|forced stop)", re.IGNORECASE)


class Shape(Enum):
    """Formats of replies other than errors."""

    OK = re.compile(r"ok\Z", re.IGNORECASE)
    NUMBER = re.compile(r"-?\d+(\.\d+)?\Z")  #: ``battery?``, ``wifi?``, ``sdk?``, ``speed?``, ``baro?``
    TIME = re.compile(r"\d+( ?s)?\Z")  #: ``time?``: a number with or without its unit
    LENGTH = re.compile(r"-?\d+ ?(mm|dm|cm)\Z")  #: ``height?``, ``tof?``
    TEMPERATURE = re.compile(r"-?\d+~-?\d+ ?C\Z")  #: ``temp?``
    NAME = re.compile(r"(?=.*[A-Za-z])(?!ok\Z)[0-9A-Za-z]{4,32}\Z")  #: ``sn?``
    FIELDS = re.compile(r"[a-z]+:-?[\d.]+;([a-z]+:-?[\d.]+;)*\Z")  #: ``attitude?``, ``acceleration?``


#: Commands with replies other than "ok".
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
    return READ.get(command, Shape.OK)


def is_error(reply: str) -> bool:
    """Return whether a reply reports that some command was not executed."""
    return _ERROR.match(reply) is not None


def answers(reply: str, command: str) -> bool:
    """Return whether a reply can belong to a command: it is an error or has the right format."""
    if reply.lower().startswith("unknown command"):
        named = reply.partition(":")[2].strip()
        return named in ("", command)
    return is_error(reply) or shape_of(command).value.match(reply) is not None


MAX_STATE: Final = 1024  #: maximum length [bytes]; real state strings are much shorter
FIELDS: Final = 64  #: maximum number of fields, which is more than any version has
NO_DISTANCE_CM: Final = 6553  #: the distance sensor's value for "nothing measured"
GROUND_CM: Final = 10  #: the distance sensor's reading on the ground, its minimum
NO_PAD: Final = -1  #: pad number while none is in view (-2 if detection is off)
NOWHERE_CM: Final = -100  #: value of each coordinate while no pad is in view
_FIELD: Final = re.compile(r"([a-z]+):(-?\d+(?:\.\d+)?(?:,-?\d+(?:\.\d+)?){0,2})\Z")

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Pad:
    """A mission pad in view, and the Tello's position above it in the axes printed on the pad, z up [cm]."""

    number: int
    place_cm: Vector | None
    angles_deg: Vector | None  #: ``mpry``: pitch, roll, yaw relative to the pad


@dataclass(frozen=True, slots=True)
class TelloState:
    """A state string. Values are None if they are missing or have the drone's value for "unknown"."""

    pitch_deg: float | None = None
    roll_deg: float | None = None
    yaw_deg: float | None = None
    speed_dm_s: Vector | None = None  #: ``vgx``, ``vgy``, ``vgz``
    temperature_c: tuple[float, float] | None = None  #: lowest and highest temperature
    distance_cm: float | None = None  #: ``tof``: distance to the surface below
    height_cm: float | None = None  #: height above the take-off point; may be negative
    battery_percent: float | None = None
    barometer: float | None = None  #: reading as sent; its zero point and unit differ between versions
    motor_s: int | None = None  #: total running time of the motors since the drone was switched on
    acceleration_mg: Vector | None = None
    pad: Pad | None = None
    pads: bool = False  #: whether there are fields for pads
    fields: tuple[tuple[str, float | Vector], ...] = ()  #: all fields, as sent


def parse(datagram: bytes) -> TelloState:
    """Return the state in a datagram, leaving out invalid fields; raise :class:`DecodeError` if none is valid.

    The last field of a truncated string is dropped, unless its semicolon is present.
    """
    if len(datagram) > MAX_STATE:
        raise DecodeError(f"the state string has {len(datagram)} bytes; a Tello's has at most {MAX_STATE}")
    try:
        text = datagram.decode("ascii")
    except UnicodeDecodeError:
        raise DecodeError("the state string has bytes that are not ASCII") from None
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
        raise DecodeError(f"no state field in {datagram[:40]!r}")
    return _state(fields)


def _state(fields: dict[str, float | Vector]) -> TelloState:
    def number(name: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        value = fields.get(name)
        return value if isinstance(value, float) and low <= value <= high else None

    def vector(*names: str) -> Vector | None:
        x, y, z = (number(name) for name in names)
        return None if x is None or y is None or z is None else (x, y, z)

    low, high = number("templ", -50, 150), number("temph", -50, 150)
    motor_s = number("time", 0)
    return TelloState(
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


PADS: Final = range(1, 9)  #: valid pad numbers


def _pad(fields: dict[str, float | Vector], number: float | None, place: Vector | None) -> Pad | None:
    if number is None or number not in PADS:  # -1 or 0 if no pad is in view; some firmware sends 257 instead
        return None
    angles = fields.get("mpry")
    nowhere = (float(NOWHERE_CM),) * 3
    return Pad(int(number), None if place == nowhere else place, angles if isinstance(angles, tuple) else None)


def build(fields: list[tuple[str, str]]) -> bytes:
    """Return a state datagram with these fields in this order, with the line ending that the Tello uses."""
    return ("".join(f"{name}:{value};" for name, value in fields) + "\r\n").encode("ascii")


PIECE: Final = 1460  #: size of every datagram of an image except the last [bytes]
MAX_PICTURE: Final = 1 << 19  #: maximum size of an image [bytes]; real images are a fiftieth of that size
_SLICES: Final = (h264.SLICE, h264.IDR)
_HEAD: Final = 256  # number of bytes searched for parameter sets and the beginning of the first slice


@dataclass(frozen=True, slots=True)
class AccessUnit:
    """An encoded image as received."""

    data: bytes
    is_key: bool  #: whether decoding can begin here
    arrived_ns: int  #: when the image's first piece arrived
    after_gap: bool  #: whether an earlier image is known to be missing or damaged
    whole: bool  #: whether the image seems to be complete
    number: int = 0  #: number of this image, counted from 0
    width: int = 0  #: width according to the newest parameter set [px]; 0 before the first parameter set
    height: int = 0


def pieces(picture: bytes) -> list[bytes]:
    """Divide an encoded image into datagrams."""
    return [picture[at : at + PIECE] for at in range(0, len(picture), PIECE)]


class Assembly:
    """Assembles images from pieces in order of arrival. Never raises, regardless of input.

    ``stray`` counts bytes that don't belong to any image; ``missing`` counts images missing from the stream's numbers.
    """

    def __init__(self) -> None:
        self.stray = 0
        self.missing = 0
        self._pieces: list[bytes] = []
        self._size = 0
        self._arrived_ns = 0
        self._sequence: h264.Sequence | None = None
        self._before: h264.Slice | None = None
        self._gap = True  # whether there was a gap after the last returned image
        self._count = 0

    def feed(self, piece: bytes, now_ns: int) -> list[AccessUnit]:
        """Add a datagram that arrived now; return the images that it completes, at most two."""
        found = []
        begins = piece.startswith(h264.START)
        if begins and self._has_picture():
            found += self._end(whole=False)  # the last piece is missing, unless it was by chance as long as the others
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
        """Return whether a slice has arrived; parameter sets may arrive in separate datagrams."""
        if not self._pieces:
            return False
        return any(h264.unit_type(unit) in _SLICES for unit in h264.units(self._head()))

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
        head = h264.units(self._head())
        kinds = {h264.unit_type(unit) for unit in head}
        gap = self._is_gap(head)
        data = b"".join(self._pieces)
        self._pieces, self._size = [], 0
        is_key = h264.IDR in kinds and {h264.SPS, h264.PPS} <= kinds
        size = (0, 0) if self._sequence is None else (self._sequence.width, self._sequence.height)
        made = AccessUnit(data, is_key, self._arrived_ns, self._gap or gap, whole, self._count, *size)
        self._gap = False
        self._count += 1
        return [made]

    def _is_gap(self, head: list[bytes]) -> bool:
        """Store this image's number; return True unless it directly follows the previous image's number."""
        try:
            for unit in head:
                if h264.unit_type(unit) == h264.SPS:
                    self._sequence = h264.parse_sequence(unit)
            if self._sequence is None:
                return False
            now = h264.parse_slice(next(unit for unit in head if h264.unit_type(unit) in _SLICES), self._sequence)
        except DecodeError:
            self._before = None
            return False
        before, self._before = self._before, now
        if now.is_key or before is None:
            return False
        skipped = h264.missing_between(before, now, self._sequence)
        self.missing += min(skipped, 1 << self._sequence.frame_number_bits - 1)
        return skipped != 0 or not now.is_first
