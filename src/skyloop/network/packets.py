"""The fabric transport's own packets and attachments: convert bytes to typed tuples and back. Pure functions.

They share the header of all packets and use kinds from 0x50 up, which samples don't use. ``docs/wire-format.md`` has
the tables.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from skyloop.errors import DecodeError
from skyloop.messages import FrameHeader, decode
from skyloop.messages.codec import HEADER, HEADER_SIZE, SIGNATURE, VERSION
from skyloop.transport.base import MAX_PACKET, MAX_TOPIC

if TYPE_CHECKING:
    import zenoh

REVISION: Final = 2  #: revision of the fabric transport
MAX_REASON: Final = 400  #: maximum length of a reason [bytes of UTF-8]
MAX_OWN: Final = 4096  #: maximum size of a Join, a Welcome, a ProxyInfo or any attachment [bytes]


class FabricKind(IntEnum):
    """Kinds of packets that the transport's two ends exchange."""

    SUBSCRIBE = 0x50  #: application to proxy
    TAKEN = 0x51  #: either direction: all packets up to this number were received
    SEEN = 0x52  #: application to proxy: frames up to this number were received
    BYE = 0x53  #: either direction: the reason why the connection ends; answered with a BYE
    KEY = 0x54  #: proxy to application, sealed: the new key for topics and frames


class Subscribe(NamedTuple):
    """Subscribes an application to a topic, or ends the subscription."""

    topic: str
    on: bool


class Taken(NamedTuple):
    """Acknowledges all packets up to a number."""

    topic: str  #: empty for packets sent to this end only
    number: int


class Seen(NamedTuple):
    """Acknowledges all frames of a topic up to a number."""

    topic: str
    number: int


class Bye(NamedTuple):
    """The reason why the connection ends."""

    reason: str


class Key(NamedTuple):
    """The new key for topics and frames."""

    generation: int
    key: bytes  #: 32 bytes

    def __repr__(self) -> str:
        return f"Key(generation={self.generation})"


Message = Subscribe | Taken | Seen | Bye | Key

_NUMBER = struct.Struct("<Q")
_OWN: Final = bytes([FabricKind.SUBSCRIBE])
_PUBLISHED = struct.Struct("<8sQ")
_KEY = struct.Struct("<I32s")


class Join(msgspec.Struct, frozen=True, array_like=True):
    """An application's request to join, as MessagePack."""

    revision: int
    run: str  #: the run of the proxy that the request is meant for
    host: str = ""  #: shown to users
    pid: int = 0  #: shown to users
    program: str = ""  #: shown to users
    proof: bytes = b""  #: with keys: proof of the identity, see :mod:`skyloop.network.keys.agreement`


class Welcome(msgspec.Struct, frozen=True, array_like=True):
    """The answer to a :class:`Join`: the connection is established."""

    revision: int
    run: str
    proof: bytes = b""  #: with keys: the proxy's proof of identity
    topics: bytes = b""  #: with keys: a :class:`Key` packet, sealed for this connection


class ProxyInfo(msgspec.Struct, frozen=True, array_like=True):
    """A proxy's description of itself. It is sent as MessagePack in reply to queries of the proxy's info key."""

    name: str
    run: str
    since_ns: int  #: wall-clock time when the proxy started [ns since 1970]; the older of two proxies keeps the name
    host: str
    pid: int
    vehicle: str  #: the vehicle's address, e.g. ``sim://``
    address: str  #: where the proxy listens, shown to users


encode_own = msgspec.msgpack.Encoder().encode
decode_join = msgspec.msgpack.Decoder(Join).decode
decode_welcome = msgspec.msgpack.Decoder(Welcome).decode
decode_info = msgspec.msgpack.Decoder(ProxyInfo).decode


def is_own(packet: bytes) -> bool:
    """Return whether a packet may be meant for the transport itself rather than for the handler."""
    return packet[5:6] >= _OWN and packet.startswith(SIGNATURE)


def subscribe(topic: str, on: bool) -> bytes:
    return _packet(FabricKind.SUBSCRIBE, bytes((on,)) + topic.encode())


def taken(topic: str, number: int) -> bytes:
    return _packet(FabricKind.TAKEN, _NUMBER.pack(number) + topic.encode())


def seen(topic: str, number: int) -> bytes:
    return _packet(FabricKind.SEEN, _NUMBER.pack(number) + topic.encode())


def bye(reason: str) -> bytes:
    """Encode a :class:`Bye`; the reason is truncated to :data:`MAX_REASON` bytes."""
    return _packet(FabricKind.BYE, reason.encode(errors="replace")[:MAX_REASON])


def key(generation: int, secret: bytes) -> bytes:
    """Encode a :class:`Key`; ``secret`` has 32 bytes."""
    return _packet(FabricKind.KEY, _KEY.pack(generation, secret))


def _packet(kind: FabricKind, body: bytes) -> bytes:
    return HEADER.pack(SIGNATURE, VERSION, kind, 0, len(body)) + body


def parse(packet: bytes) -> Message:
    """Decode one of the transport's own packets."""
    if len(packet) < HEADER_SIZE:
        raise DecodeError(f"{len(packet)} bytes are shorter than the header of {HEADER_SIZE}")
    signature, version, kind, reserved, length = HEADER.unpack_from(packet)
    if signature != SIGNATURE or version != VERSION or reserved or length != len(packet) - HEADER_SIZE:
        raise DecodeError(f"not a packet of the fabric transport: header {packet[:HEADER_SIZE].hex(' ')}")
    body = packet[HEADER_SIZE:]
    try:
        if kind == FabricKind.SUBSCRIBE:
            if body[0] > 1:
                raise DecodeError(f"a subscription with flag {body[0]}")
            return Subscribe(_topic(body[1:], least=1), bool(body[0]))
        if kind == FabricKind.TAKEN:
            return Taken(_topic(body[_NUMBER.size :]), *_NUMBER.unpack_from(body))
        if kind == FabricKind.SEEN:
            return Seen(_topic(body[_NUMBER.size :], least=1), *_NUMBER.unpack_from(body))
        if kind == FabricKind.BYE:
            return Bye(body[:MAX_REASON].decode(errors="replace"))
        if kind == FabricKind.KEY:
            return Key(*_KEY.unpack(body))
    except (IndexError, struct.error, UnicodeDecodeError) as error:
        raise DecodeError(f"bad packet of kind {kind:#x} with {length} bytes of body: {error!r}") from None
    raise DecodeError(f"unknown kind {kind:#x}")


def parse_own(packet: bytes) -> Message | None:
    """Decode one of the transport's own packets. Return None if the packet is for the handler, or is garbage."""
    if not is_own(packet):
        return None
    try:
        return parse(packet)
    except DecodeError:
        return None


def _topic(text: bytes, least: int = 0) -> str:
    topic = text.decode()
    if not least <= len(topic) <= MAX_TOPIC:
        raise DecodeError(f"a topic of {len(topic)} characters")
    return topic


# Received by Zenoh ----------------------------------------------------------------------------------------------


def copied(data: zenoh.ZBytes | None, at_most: int) -> bytes:
    """Return a copy of bytes that Zenoh received, unless they exceed the maximum size; empty for None."""
    if data is None:
        return b""
    if len(data) > at_most:
        raise DecodeError(f"{len(data)} bytes, at most {at_most} allowed")
    return bytes(data)


def contents(sample: zenoh.Sample, at_most: int = MAX_PACKET) -> tuple[bytes, bytes]:
    """Return the packet in a sample, which must not be empty or too large, and its attachment."""
    if not sample.payload:
        raise DecodeError("it is empty")
    return copied(sample.payload, at_most), copied(sample.attachment, MAX_OWN)


# Attachments ---------------------------------------------------------------------------------------------------

#: Attachment of a packet sent to a single end: its number, counted from 1. The transport's own packets have number 0.
number = _NUMBER.pack


def parse_number(attachment: bytes) -> int:
    """Decode the attachment of a packet sent to one end."""
    try:
        return int(_NUMBER.unpack(attachment)[0])
    except struct.error as error:
        raise DecodeError(f"an attachment of {len(attachment)} bytes: {error}") from None


def published(run: bytes, count: int) -> bytes:
    """Encode a published packet's attachment: the proxy's RUN (8 bytes) and its number on the topic, from 1."""
    return _PUBLISHED.pack(run, count)


def parse_published(attachment: bytes) -> tuple[bytes, int]:
    """Decode a published packet's attachment: RUN and number."""
    try:
        run, count = _PUBLISHED.unpack(attachment)
    except struct.error as error:
        raise DecodeError(f"an attachment of {len(attachment)} bytes: {error}") from None
    return run, count


def frame(run: bytes, count: int, header: bytes) -> bytes:
    """Encode a frame's attachment: the proxy's RUN (8 bytes), the frame's number, and the packet of its header."""
    return _PUBLISHED.pack(run, count) + header


def parse_frame(attachment: bytes) -> tuple[bytes, int, FrameHeader]:
    """Decode a frame's attachment: RUN, number and header."""
    run, count = parse_published(attachment[: _PUBLISHED.size])
    header = decode(attachment[_PUBLISHED.size :])
    if type(header) is not FrameHeader:
        raise DecodeError(f"a frame has a {type(header).__name__} instead of a FrameHeader")
    return run, count, header
