"""Encoding and decoding of MAVLink 1 and 2 frames with pymavlink, and of the texts, parameters and modes in them.

Pure except for the wall clock in signatures. The float field in ``PARAM_VALUE`` and ``PARAM_SET`` can hold an integer
in two ways: ArduPilot converts it to a float; PX4 stores its bytes. ``PARAM_ENCODE_BYTEWISE`` in
``AUTOPILOT_VERSION.capabilities`` tells the two apart.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import struct
import time
from collections.abc import Callable, Hashable
from enum import IntEnum, IntFlag
from functools import lru_cache
from typing import Any, Final, NamedTuple, TypeAlias

from skyloop.errors import DecodeError, MissingExtraError, UsageError

try:
    from pymavlink.dialects.v20 import all as dialect
except ImportError as error:
    raise MissingExtraError("mavlink://", "mavlink", cause=str(error)) from error

__all__ = ["KEY_BYTES", "MAX_FRAME", "MavlinkCodec", "Message", "dialect"]

#: A pymavlink message; its fields are attributes.
Message: TypeAlias = Any

MAX_FRAME: Final = 280  #: size of the longest frame in bytes, including the signature
KEY_BYTES: Final = 32  #: size of a signing key
_AROUND_V1: Final = 8  #: bytes in a MAVLink 1 frame's header and checksum
_AROUND_V2: Final = 12  #: bytes in a MAVLink 2 frame's header and checksum
_SIGNATURE: Final = 13  #: bytes in a signature: link id (1), time (6), hash (6)
_LEAST: Final = _AROUND_V1  #: bytes in the shortest frame
_MARKERS: Final = (dialect.PROTOCOL_MARKER_V1, dialect.PROTOCOL_MARKER_V2)
_MOST_SOURCES: Final = 16  #: maximum number of senders whose incomplete frames are kept: anybody can send datagrams
_SIGNED: Final = 1  #: incompatibility flag that marks a signed frame
_SIGNING_EPOCH_S: Final = 1_420_070_400  #: 2015-01-01, the start of signature time
_STEPS_PER_S: Final = 100_000  #: signature time counts in steps of 10 µs
_OLD: Final = 60 * _STEPS_PER_S  #: how far a new sender's time may lag behind
_UNSIGNED: Final = dialect.MAVLINK_MSG_ID_RADIO_STATUS  #: accepted without a signature: radios have no key
_HEADER_V1: Final = struct.Struct("<xBBBBB")  #: length, sequence number, system, component, type
_HEADER_V2: Final = struct.Struct("<xBBBBBBHB")  #: length, two flag bytes, then as above but with a three-byte type


class _Kind(NamedTuple):
    """A message type with only numeric fields, and how to create such a message from a payload.

    pymavlink's own decoder takes three times as long, mostly because it sorts the fields and makes room for strings and
    arrays in every message.
    """

    make: type[Message]
    common: dict[str, Any]  #: attributes shared by all messages of the type
    fields: list[str]  #: field names in payload order
    size: int  #: size of the complete payload, although trailing zeros are not sent
    unpack: Callable[[bytes], tuple[Any, ...]]
    seed: bytes  #: additional bytes that the checksum covers


@lru_cache(maxsize=512)  # bounded, because anybody can send invalid message numbers
def _kind_of(number: int) -> _Kind | None:
    """Return how to create messages of a type; None if the type is unknown or contains strings or arrays."""
    made: Any = dialect.mavlink_map.get(number)
    if made is None or any(made.array_lengths) or set(made.lengths) != {1}:
        return None
    fields = list(made.ordered_fieldnames)
    common = {name: value for name, value in vars(made(*[0] * len(fields))).items() if name not in fields}
    return _Kind(made, common, fields, made.unpacker.size, made.unpacker.unpack, bytes([made.crc_extra]))


def _decode_plain(data: bytes) -> Message | None:
    """Return the message in a single complete unsigned frame; None if pymavlink must decode or reject the data.

    The result equals pymavlink's, attribute by attribute.
    """
    incompatible = compatible = 0
    if data[0] == dialect.PROTOCOL_MARKER_V1:
        begin = _HEADER_V1.size
        length, sequence, system, component, number = _HEADER_V1.unpack_from(data)
    else:
        begin = _HEADER_V2.size
        length, incompatible, compatible, sequence, system, component, low, high = _HEADER_V2.unpack_from(data)
        number = high << 16 | low
    kind = None if incompatible else _kind_of(number)
    if kind is None:
        return None
    end = begin + length
    checksum: int = data[end] | data[end + 1] << 8
    if dialect.x25crc(data[1:end] + kind.seed).crc != checksum:
        return None
    message: Message = object.__new__(kind.make)
    attributes = message.__dict__
    attributes.update(kind.common)
    attributes.update(zip(kind.fields, kind.unpack(data[begin:end].ljust(kind.size, b"\0")[: kind.size]), strict=True))
    message._msgbuf, message._crc = bytearray(data), checksum
    message._payload = message._msgbuf[_HEADER_V1.size : end]  # pymavlink does this for both versions
    message._header = dialect.MAVLink_header(number, incompatible, compatible, length, sequence, system, component)
    return message


def _length_of(data: bytes) -> int | None:
    """Return the length of the frame at the start of the data; None if there is none or too little data to tell."""
    if len(data) < _LEAST or data[0] not in _MARKERS:
        return None
    if data[0] == dialect.PROTOCOL_MARKER_V1:
        return data[1] + _AROUND_V1
    return data[1] + _AROUND_V2 + (_SIGNATURE if data[2] == _SIGNED else 0) if data[2] in (0, _SIGNED) else None


def _begins_with_a_frame(data: bytes) -> bool:
    """Return whether the data starts with a complete frame of a known type with a valid checksum."""
    length = _length_of(data)
    if length is None or len(data) < length:
        return False
    old = data[0] == dialect.PROTOCOL_MARKER_V1
    number = data[5] if old else int.from_bytes(data[7:10], "little")
    end = data[1] + (_HEADER_V1 if old else _HEADER_V2).size
    kind = dialect.mavlink_map.get(number)
    if kind is None:
        return False
    checksum: int = dialect.x25crc(data[1:end] + bytes([kind.crc_extra])).crc
    return checksum == data[end] | data[end + 1] << 8


class _Signatures:
    """The state of one link's MAVLink 2 signatures: the time, which only increases, and the senders."""

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._newest = 0  # newest time sent or accepted
        self._streams: dict[tuple[int, int, int], int] = {}  # newest accepted time for each link, system and component

    def now(self) -> int:
        """Return the next signature's time: this host's time or, if that is later, one step after the newest so far."""
        self._newest = max(self._newest + 1, int((time.time() - _SIGNING_EPOCH_S) * _STEPS_PER_S))
        return self._newest

    def check(self, frame: bytearray, system: int, component: int) -> bool:
        """Return whether to accept a signed frame. A frame signed without the key has no effect on the state."""
        signature = hashlib.sha256(self._key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(signature, bytes(frame[-6:])):
            return False
        stream = frame[-_SIGNATURE], system, component
        stamp = int.from_bytes(frame[-12:-6], "little")
        if stamp <= self._streams.get(stream, self.now() - _OLD - 1):
            return False
        self._streams[stream] = stamp
        self._newest = max(self._newest, stamp)
        return True


class MavlinkCodec:
    """One end of a link, with its sequence numbers, incomplete frames and signatures.

    With a 32-byte ``key``, everything sent is signed, and everything unsigned but RADIO_STATUS rejected (MAVLink 2).
    """

    def __init__(self, system: int, component: int, *, key: bytes | None = None) -> None:
        if key is not None and len(key) != KEY_BYTES:
            raise UsageError(f"a signing key has {KEY_BYTES} bytes, not {len(key)}")
        self.frames = 0  #: number of complete frames received
        self.damaged = 0  #: number of damaged frames, and of pieces that are not frames
        self.unknown = 0  #: number of frames of unknown types
        self.signed = 0  #: number of signed frames rejected because we have no key
        self._key = key
        self._signatures = None if key is None else _Signatures(key)
        self._rests: dict[Hashable, bytes] = {}  # incomplete frame from each sender of datagrams
        self._sender = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._receiver = self._fresh()
        if key is not None:
            self._sender.signing.secret_key, self._sender.signing.sign_outgoing = key, True

    def encode(self, message: Message, *, version: int = 2) -> bytes:
        """Return a frame with the next sequence number; raise ``struct.error`` if a value does not fit its field."""
        old = version == 1 and self._key is None
        if self._signatures is not None:
            self._sender.signing.timestamp = self._signatures.now()
        frame: bytes = message.pack(self._sender, force_mavlink1=old)
        self._sender.seq = (self._sender.seq + 1) % 256
        return frame

    def decode(self, data: bytes, *, whole: bool = False, source: Hashable = None) -> list[Message]:
        """Return the messages that these bytes complete. Never raises, whatever the input.

        ``whole`` means that the bytes are one datagram from ``source``. A frame may continue in the sender's next
        datagram, because some bridges divide a serial line's bytes anywhere.
        """
        if not whole:
            return self._parsed(data)
        rest = self._rests.pop(source, b"")
        if _length_of(data) == len(data):  # usually true, so that no search for frame boundaries is needed
            self.damaged += bool(rest)
            return self._decoded(data)
        if rest and _begins_with_a_frame(data):
            rest = b""  # the rest of the frame never arrived
            self.damaged += 1
        self._receiver.buf, self._receiver.buf_index = bytearray(), 0
        found = self._parsed(rest + data)
        left = bytes(self._receiver.buf[self._receiver.buf_index :])
        if left:
            self._rests[source] = left
        if len(self._rests) > _MOST_SOURCES:
            self._rests.pop(next(iter(self._rests)))
        return found

    def _decoded(self, frame: bytes) -> list[Message]:
        plain = _decode_plain(frame) if self._key is None else None
        if plain is not None:
            self.frames += 1
            return [plain]
        return self._taken(lambda: [self._receiver.decode(bytearray(frame))])

    def _parsed(self, data: bytes) -> list[Message]:
        return self._taken(lambda: self._receiver.parse_buffer(data) or [])

    def _taken(self, parse: Callable[[], list[Message]]) -> list[Message]:
        try:
            found = parse()
        except dialect.MAVError:
            self.damaged += 1
            return []
        except Exception:  # noqa: BLE001  noise in a field broke the parser: continue with the next bytes
            self._receiver = self._fresh()
            self.damaged += 1
            return []
        return [message for message in found if self._good(message)]

    def _good(self, message: Message) -> bool:
        kind = message.get_type()
        if kind == "BAD_DATA":
            self.damaged += 1
            return False
        self.frames += 1
        if kind.startswith("UNKNOWN"):
            self.unknown += 1
            return False
        if self._key is None and message.get_header().incompat_flags & _SIGNED:
            self.signed += 1
            return False
        return True

    def _fresh(self) -> Any:
        receiver = dialect.MAVLink(None)
        receiver.robust_parsing = True
        if self._signatures is not None:
            receiver.signing.secret_key = self._key
            receiver.check_signature = self._signatures.check
            receiver.signing.allow_unsigned_callback = lambda _, number: number == _UNSIGNED
        return receiver


CHUNK: Final = 50  #: number of characters in one STATUSTEXT
_MOST_OPEN: Final = 8  #: maximum number of unfinished texts; beyond that, the oldest is returned incomplete


def chunks_of(text: str, severity: int, number: int) -> list[Message]:
    """Split text into messages. ``number`` is the text's id, or 0 if it fits in a single message."""
    data = text.encode("ascii", "replace")
    if len(data) < CHUNK:
        return [dialect.MAVLink_statustext_message(severity, data, 0, 0)]
    pieces = [data[at : at + CHUNK] for at in range(0, len(data) + 1, CHUNK)]  # the last piece is never full
    return [dialect.MAVLink_statustext_message(severity, piece, number, at) for at, piece in enumerate(pieces)]


class Texts:
    """Joins the chunks of texts, with an ellipsis in place of each lost chunk."""

    def __init__(self) -> None:
        self._open: dict[tuple[int, int], tuple[int, dict[int, str]]] = {}
        self._ended: dict[tuple[int, int], dict[int, str]] = {}

    def on_message(self, message: Message) -> list[tuple[int, str]]:
        """Return the texts completed by this message, with their severities (0 emergency to 7 debug).

        A chunk that arrives twice, or after the last chunk of its text, does not start a new text.
        """
        text = _printable(message.text)
        number = message.id
        if not number:
            return [(message.severity, text.strip())] if text.strip() else []
        key = message.get_srcComponent(), number
        if key in self._ended:
            if self._ended[key].get(message.chunk_seq, text) == text:
                return []
            del self._ended[key]  # the vehicle rebooted and started numbering its texts again
        _, chunks = self._open.setdefault(key, (message.severity, {}))
        ended: list[tuple[int, str]] = []
        chunks[message.chunk_seq] = text
        if len(message.text) < CHUNK:
            ended.append(self._end(key))
        while len(self._open) > _MOST_OPEN:
            ended.append(self._end(next(iter(self._open))))
        return [(severity, whole) for severity, whole in ended if whole]

    def _end(self, key: tuple[int, int]) -> tuple[int, str]:
        severity, chunks = self._open.pop(key)
        self._ended[key] = chunks
        while len(self._ended) > _MOST_OPEN:
            del self._ended[next(iter(self._ended))]
        pieces = [chunks.get(at, "…") for at in range(max(chunks) + 1)]
        return severity, "".join(pieces).strip()


def _printable(text: str) -> str:
    return "".join(each if each.isprintable() or each == " " else " " for each in text)


BYTEWISE: Final = 0x10  #: the capabilities' bit for bytewise encoding of integers
REAL32: Final = 9  #: MAV_PARAM_TYPE
#: For each integer ``MAV_PARAM_TYPE``: the layout in the four bytes, and the range.
_INTEGERS: Final = {
    1: ("<B3x", 0, 0xFF),
    2: ("<b3x", -0x80, 0x7F),
    3: ("<H2x", 0, 0xFFFF),
    4: ("<h2x", -0x8000, 0x7FFF),
    5: ("<I", 0, 0xFFFFFFFF),
    6: ("<i", -0x80000000, 0x7FFFFFFF),
}


def is_integer(kind: int) -> bool:
    """Return whether this ``MAV_PARAM_TYPE`` is for whole numbers."""
    return kind in _INTEGERS


def bounds(kind: int) -> tuple[int, int]:
    """Return the smallest and greatest value of an integer type."""
    _, low, high = _INTEGERS[kind]
    return low, high


def from_field(field: float, kind: int, *, bytewise: bool) -> int | float:
    """Return a field's number; raise :class:`DecodeError` for an unknown type or a non-integer in an integer field."""
    if not is_integer(kind):
        if kind != REAL32:
            raise DecodeError(f"parameter type {kind} is unknown")
        return field
    if not bytewise:
        if not math.isfinite(field):
            raise DecodeError(f"{field} is not a whole number")
        return round(field)
    form, _, _ = _INTEGERS[kind]
    number: int = struct.unpack(form, struct.pack("<f", field))[0]
    return number


def to_field(value: float, kind: int, *, bytewise: bool) -> float:
    """Return the field for a number; raise ``struct.error`` if the number does not fit the type."""
    if not (bytewise and is_integer(kind)):
        return float(value)
    field: float = struct.unpack("<f", struct.pack(_INTEGERS[kind][0], int(value)))[0]
    return field


# Modes ---------------------------------------------------------------------------------------------------------------


class MavAutopilot(IntEnum):
    """The supported ``MAV_AUTOPILOT`` values."""

    ARDUPILOT = 3
    PX4 = 12


class ModeFlag(IntFlag):
    """Flags in a heartbeat's ``base_mode``."""

    CUSTOM = 1
    ARMED = 128


class SystemState(IntEnum):
    """The values of a heartbeat's ``system_status`` that are used here."""

    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5  #: a failsafe is active
    EMERGENCY = 6
    TERMINATION = 8


class Landed(IntEnum):
    """Values of ``landed_state`` in ``EXTENDED_SYS_STATE``."""

    UNKNOWN = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKING_OFF = 3
    LANDING = 4


#: ArduCopter's modes by number (``mode.h``).
COPTER_MODES: Final = {
    0: "STABILIZE",
    1: "ACRO",
    2: "ALT_HOLD",
    3: "AUTO",
    4: "GUIDED",
    5: "LOITER",
    6: "RTL",
    7: "CIRCLE",
    9: "LAND",
    11: "DRIFT",
    13: "SPORT",
    14: "FLIP",
    15: "AUTOTUNE",
    16: "POSHOLD",
    17: "BRAKE",
    18: "THROW",
    19: "AVOID_ADSB",
    20: "GUIDED_NOGPS",
    21: "SMART_RTL",
    22: "FLOWHOLD",
    23: "FOLLOW",
    24: "ZIGZAG",
    25: "SYSTEMID",
    26: "AUTOROTATE",
    27: "AUTO_RTL",
    28: "TURTLE",
}
COPTER_NUMBERS: Final = {name: number for number, name in COPTER_MODES.items()}
#: PX4's modes by main mode and sub mode (``px4_custom_mode.h``).
PX4_MODES: Final = {
    (1, 0): "MANUAL",
    (2, 0): "ALTCTL",
    (3, 0): "POSCTL",
    (4, 1): "AUTO.READY",
    (4, 2): "AUTO.TAKEOFF",
    (4, 3): "AUTO.LOITER",
    (4, 4): "AUTO.MISSION",
    (4, 5): "AUTO.RTL",
    (4, 6): "AUTO.LAND",
    (4, 8): "AUTO.FOLLOW",
    (4, 9): "AUTO.PRECLAND",
    (5, 0): "ACRO",
    (6, 0): "OFFBOARD",
    (7, 0): "STABILIZED",
}
PX4_NUMBERS: Final = {name: numbers for numbers, name in PX4_MODES.items()}


def copter_mode(custom_mode: int) -> str:
    """Return the name of a heartbeat's ``custom_mode``."""
    return COPTER_MODES.get(custom_mode, f"MODE_{custom_mode}")


def px4_mode(custom_mode: int) -> str:
    """Return the name of a heartbeat's ``custom_mode``."""
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    return PX4_MODES.get((main, sub)) or PX4_MODES.get((main, 0)) or f"MODE_{main}.{sub}"


def px4_custom(name: str) -> int:
    """Return the ``custom_mode`` for a mode name."""
    main, sub = PX4_NUMBERS[name]
    return main << 16 | sub << 24
