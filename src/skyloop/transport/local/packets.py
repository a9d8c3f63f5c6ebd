"""The local transport's own packets: pure functions that convert between bytes and typed tuples.

They share the header of all packets and use kinds from 0x40, which no sample has. ``docs/wire-format.md`` has the
tables.
"""

from __future__ import annotations

import re
import struct
from enum import IntEnum
from typing import Final, NamedTuple

from skyloop.errors import DecodeError
from skyloop.messages import FrameHeader, decode
from skyloop.messages.codec import HEADER, HEADER_SIZE, SIGNATURE, VERSION
from skyloop.transport.base import MAX_TOPIC

REVISION: Final = 1  #: revision of the packets that only the local transport uses
MAX_REASON: Final = 400  #: bytes of UTF-8 in a reason
MEMORY_NAME: Final = re.compile(r"[a-z0-9-]{1,30}")  #: a slot's shared memory; macOS allows 31 bytes with its slash


class LocalKind(IntEnum):
    """Kinds of packets that the two ends exchange between themselves."""

    HELLO = 0x40  #: a client's first packet
    SUBSCRIBE = 0x41  #: client to server
    RELEASE = 0x42  #: client to server: the client no longer uses the frame in this slot
    SLOT = 0x43  #: server to client, together with the slot's descriptor
    FRAME = 0x44  #: server to client: a slot contains a frame
    RETIRE = 0x45  #: server to client: the older slots of a camera will not be used again
    BYE = 0x46  #: either direction: the reason why the connection ends
    WAKE = 0x47  #: client to server: older applications send this before each command, and it is ignored
    NAMED_SLOT = 0x48  #: server to client: a slot in named shared memory


# A packet's sixth byte is its kind. The byte is compared with these kinds without conversion.
OWN: Final = bytes([LocalKind.HELLO])  #: packets of this kind and above are the transport's own
FRAME: Final = bytes([LocalKind.FRAME])


class Hello(NamedTuple):
    """A client's first packet."""

    revision: int


class Subscribe(NamedTuple):
    """A client subscribes to a topic, or unsubscribes from it."""

    topic: str
    on: bool


class Release(NamedTuple):
    """A client returns a slot."""

    slot: int


class Slot(NamedTuple):
    """A slot for frames of one camera. ``capacity`` is in bytes."""

    slot: int
    camera: int
    capacity: int


class NamedSlot(NamedTuple):
    """A :class:`Slot` in shared memory with this name."""

    slot: int
    camera: int
    capacity: int
    name: str


class Frame(NamedTuple):
    """A frame in a slot."""

    slot: int
    header: FrameHeader


class Retire(NamedTuple):
    """A camera's slots with numbers below ``before`` are no longer used."""

    camera: int
    before: int


class Bye(NamedTuple):
    """The reason why the connection ends."""

    reason: str


Message = Hello | Subscribe | Release | Slot | NamedSlot | Frame | Retire | Bye

_HELLO = struct.Struct("<H")
_NUMBER = struct.Struct("<I")
_SLOT = struct.Struct("<IIQ")
_RETIRE = struct.Struct("<II")
_FRAME_PREFIX = struct.Struct(HEADER.format + "I")


def is_own(packet: bytes) -> bool:
    """Return whether a packet is meant for the transport itself rather than the handler."""
    return packet[5:6] >= OWN and packet.startswith(SIGNATURE)


def hello() -> bytes:
    """Encode a :class:`Hello` of this revision."""
    return _packet(LocalKind.HELLO, _HELLO.pack(REVISION))


def subscribe(topic: str, on: bool) -> bytes:
    return _packet(LocalKind.SUBSCRIBE, bytes((on,)) + topic.encode())


def release(slot: int) -> bytes:
    return _packet(LocalKind.RELEASE, _NUMBER.pack(slot))


def slot(number: int, camera: int, capacity: int) -> bytes:
    return _packet(LocalKind.SLOT, _SLOT.pack(number, camera, capacity))


def named_slot(number: int, camera: int, capacity: int, name: str) -> bytes:
    return _packet(LocalKind.NAMED_SLOT, _SLOT.pack(number, camera, capacity) + name.encode())


def frame(number: int, header: bytes) -> bytes:
    """Encode a :class:`Frame`. ``header`` is the whole packet of the frame's :class:`FrameHeader`."""
    return _FRAME_PREFIX.pack(SIGNATURE, VERSION, LocalKind.FRAME, 0, _NUMBER.size + len(header), number) + header


def retire(camera: int, before: int) -> bytes:
    return _packet(LocalKind.RETIRE, _RETIRE.pack(camera, before))


def bye(reason: str) -> bytes:
    """Encode a :class:`Bye`; the reason is cut to :data:`MAX_REASON` bytes."""
    return _packet(LocalKind.BYE, reason.encode(errors="replace")[:MAX_REASON])


def _packet(kind: LocalKind, body: bytes) -> bytes:
    return HEADER.pack(SIGNATURE, VERSION, kind, 0, len(body)) + body


def parse(packet: bytes) -> Message:
    """Decode one of the transport's own packets."""
    if len(packet) < HEADER_SIZE:
        raise DecodeError(f"{len(packet)} bytes are too few for the header of {HEADER_SIZE}")
    if packet[5:6] == FRAME:
        return parse_frame(packet)
    signature, version, kind, reserved, length = HEADER.unpack_from(packet)
    if signature != SIGNATURE or version != VERSION or reserved or length != len(packet) - HEADER_SIZE:
        raise DecodeError(f"not a packet of the local transport: header {packet[:HEADER_SIZE].hex(' ')}")
    body = packet[HEADER_SIZE:]
    try:
        if kind == LocalKind.SUBSCRIBE:
            on, topic = body[0], body[1:].decode()
            if on > 1 or not 0 < len(topic) <= MAX_TOPIC:
                raise DecodeError(f"invalid subscription: {len(topic)} characters, flag {on}")
            return Subscribe(topic, bool(on))
        if kind == LocalKind.BYE:
            return Bye(body[:MAX_REASON].decode(errors="replace"))
        if kind == LocalKind.NAMED_SLOT:
            name = body[_SLOT.size :].decode()
            if not MEMORY_NAME.fullmatch(name):
                raise DecodeError(f"{name[:64]!r} can't be the name of a slot's memory")
            number, camera, capacity = _SLOT.unpack_from(body)
            return NamedSlot(number, camera, capacity, name)
        layout, message = _FIXED[kind]
        return message(*layout.unpack(body))
    except (KeyError, IndexError, struct.error, UnicodeDecodeError) as error:
        raise DecodeError(f"bad packet of kind {kind:#x} with {length} bytes of body: {error!r}") from None


_FIXED: Final[dict[int, tuple[struct.Struct, type[Hello | Release | Slot | Retire]]]] = {
    LocalKind.HELLO: (_HELLO, Hello),
    LocalKind.RELEASE: (_NUMBER, Release),
    LocalKind.SLOT: (_SLOT, Slot),
    LocalKind.RETIRE: (_RETIRE, Retire),
}


def parse_frame(packet: bytes) -> Frame:
    """Decode a frame's packet, header and slot in one step, because such packets are frequent."""
    if len(packet) < _FRAME_PREFIX.size:
        raise DecodeError(f"{len(packet)} bytes are too few for the {_FRAME_PREFIX.size} before the header of a frame")
    signature, version, _, reserved, length, slot = _FRAME_PREFIX.unpack_from(packet)
    if signature != SIGNATURE or version != VERSION or reserved or length != len(packet) - HEADER_SIZE:
        raise DecodeError(f"not a frame packet of the local transport: header {packet[:HEADER_SIZE].hex(' ')}")
    header = decode(packet[_FRAME_PREFIX.size :])
    if type(header) is not FrameHeader:
        raise DecodeError(f"a frame was announced by a {type(header).__name__} and must be announced by a FrameHeader")
    return Frame(slot, header)


WAKE: Final = _packet(LocalKind.WAKE, b"")
