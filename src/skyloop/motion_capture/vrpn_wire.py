"""VRPN, the Virtual-Reality Peripheral Network: what a server of trackers sends over TCP. Pure.

Server and client each send a cookie of 24 bytes that names the protocol's version. Everything from then on is a
message: a header of 24 bytes, then the payload, padded to a multiple of 8 bytes. The length in the header counts the
header and the payload without its padding. All numbers are big endian.

======  =====  ====================================================================================
offset  type   meaning
======  =====  ====================================================================================
0       u32    length
4       u32    time of the report, seconds; then microseconds at 8
12      i32    sender: number of a tracker, by the server's descriptions
16      i32    type: number of a kind of message, by the server's descriptions; negative: of the protocol itself
20      u32    sequence number, for sniffers only
======  =====  ====================================================================================

A description (type -1: of a sender, -2: of a type) has the number in the sender's place, and as payload the length of
the name (u32, with the NUL at its end) and the name. A tracker's pose has the type that is described as
``vrpn_Tracker Pos_Quat``, and as payload the sensor (i32), 4 bytes of padding, the position x, y, z [m] and the
quaternion x, y, z, w (7 doubles).

A client that never sends a UDP port gets everything over TCP.

Sources: ``Format_Of_Protocol.txt``, ``vrpn_Connection.C`` (``marshall_message``, ``check_vrpn_cookie``) and
``vrpn_Tracker.C`` (``encode_to``) of https://github.com/vrpn/vrpn (Boost licence).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from skyloop.errors import DecodeError

DEFAULT_PORT: Final = 3883
COOKIE_SIZE: Final = 24
COOKIE: Final = b"vrpn: ver. 07.38  0".ljust(COOKIE_SIZE, b"\0")  #: 0: no logging on the other side is asked for
SENDER_DESCRIPTION: Final = -1
TYPE_DESCRIPTION: Final = -2
DISCONNECT: Final = -5
POS_QUAT: Final = "vrpn_Tracker Pos_Quat"
MAX_PAYLOAD: Final = 64_000  #: bytes; the reference implementation's buffer
MAX_NAMES: Final = 2_000  #: of senders, and of types, as in the reference implementation
MAX_NAME: Final = 100  #: bytes of a name with its NUL

_HEADER: Final = struct.Struct(">IIIiiI")
_NAME_LENGTH: Final = struct.Struct(">I")
_POSE: Final = struct.Struct(">ii7d")
_SAME_MAJOR: Final = COOKIE[: COOKIE.rindex(b".") + 1]


@dataclass(frozen=True, slots=True)
class TrackerPose:
    """Where a tracker's sensor is, in the server's own axes. The numbers may be NaN or infinite."""

    tracker: str
    sensor: int
    position: tuple[float, float, float]  #: x, y, z [m]
    quaternion: tuple[float, float, float, float]  #: x, y, z, w: turns the sensor's axes into the server's


class Decoder:
    """Decodes what a server sends, from its cookie on, however it is cut into pieces.

    Holds at most one message that is not complete yet, and the names that the server has described.
    """

    def __init__(self) -> None:
        self._pending = bytearray()
        self._greeted = False
        self._names: dict[int, dict[int, str]] = {SENDER_DESCRIPTION: {}, TYPE_DESCRIPTION: {}}

    def feed(self, data: bytes) -> list[TrackerPose]:
        """Decode the next bytes of the stream.

        Returns:
            The poses that are complete now, in the order in which they were sent; everything else is skipped.

        Raises:
            DecodeError: These bytes are not VRPN, or the server ends the connection. The decoder is unusable then.
        """
        self._pending += data
        if not self._greeted:
            if not _SAME_MAJOR.startswith(self._pending[: len(_SAME_MAJOR)]):
                raise DecodeError(
                    f"a VRPN server of version 7 begins with {_SAME_MAJOR!r}, got {bytes(self._pending[:16])!r}"
                )
            if len(self._pending) < COOKIE_SIZE:
                return []
            del self._pending[:COOKIE_SIZE]
            self._greeted = True
        poses: list[TrackerPose] = []
        at = 0
        while len(self._pending) - at >= _HEADER.size:
            length, _, _, sender, kind, _ = _HEADER.unpack_from(self._pending, at)
            if not _HEADER.size <= length <= _HEADER.size + MAX_PAYLOAD:
                raise DecodeError(
                    f"a VRPN message has from {_HEADER.size} to {_HEADER.size + MAX_PAYLOAD} bytes, got {length}"
                )
            end = at + length + -length % 8
            if end > len(self._pending):
                break
            pose = self._message(sender, kind, bytes(self._pending[at + _HEADER.size : at + length]))
            if pose is not None:
                poses.append(pose)
            at = end
        del self._pending[:at]
        return poses

    def _message(self, sender: int, kind: int, payload: bytes) -> TrackerPose | None:
        if kind in self._names:
            names = self._names[kind]
            names[sender] = _decode_name(payload)
            if len(names) > MAX_NAMES:
                raise DecodeError(f"the VRPN server describes more than {MAX_NAMES} senders or types")
        elif kind == DISCONNECT:
            raise DecodeError("the VRPN server ends the connection")
        elif self._names[TYPE_DESCRIPTION].get(kind) == POS_QUAT and sender in self._names[SENDER_DESCRIPTION]:
            if len(payload) != _POSE.size:
                raise DecodeError(f"a VRPN pose has {_POSE.size} bytes, got {len(payload)}")
            sensor, _, *numbers = _POSE.unpack(payload)
            x, y, z, qx, qy, qz, qw = numbers
            return TrackerPose(self._names[SENDER_DESCRIPTION][sender], sensor, (x, y, z), (qx, qy, qz, qw))
        return None


def encode_message(sender: int, kind: int, payload: bytes, *, seconds: int = 0, microseconds: int = 0) -> bytes:
    """Encode one message, with its padding; the time is that of the report, since 1970."""
    head = _HEADER.pack(_HEADER.size + len(payload), seconds, microseconds, sender, kind, 0)
    return head + payload + bytes(-len(payload) % 8)


def encode_description(kind: int, number: int, name: str) -> bytes:
    """Encode what a sender (``SENDER_DESCRIPTION``) or a type (``TYPE_DESCRIPTION``) of this number is called."""
    text = name.encode() + b"\0"
    return encode_message(number, kind, _NAME_LENGTH.pack(len(text)) + text)


def encode_pose(
    sender: int,
    kind: int,
    sensor: int,
    position: tuple[float, float, float],
    quaternion: tuple[float, float, float, float],
    *,
    seconds: int = 0,
    microseconds: int = 0,
) -> bytes:
    """Encode a pose; ``kind`` is the number that was described as ``vrpn_Tracker Pos_Quat``."""
    payload = _POSE.pack(sensor, sensor, *position, *quaternion)  # twice, as the reference does for its padding
    return encode_message(sender, kind, payload, seconds=seconds, microseconds=microseconds)


def _decode_name(payload: bytes) -> str:
    if len(payload) < _NAME_LENGTH.size:
        raise DecodeError(f"a VRPN description has at least {_NAME_LENGTH.size} bytes, got {len(payload)}")
    (length,) = _NAME_LENGTH.unpack_from(payload)
    text = payload[_NAME_LENGTH.size : _NAME_LENGTH.size + length]
    if not 1 <= length <= MAX_NAME or len(text) < length:
        raise DecodeError(
            f"a name in a VRPN description has from 1 to {MAX_NAME} bytes, got {length} in {len(payload)} bytes"
        )
    name = text.partition(b"\0")[0].decode(errors="backslashreplace")
    return name if name.isprintable() else name.encode("unicode_escape").decode()
