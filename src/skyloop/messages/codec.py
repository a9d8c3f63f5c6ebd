"""Encode samples as bytes and decode them, with pure functions; the byte tables are in ``docs/wire-format.md``.

A packet is a 12-byte header (signature, version, kind, reserved, body length) followed by a body: the sample's fields
in order, as one MessagePack array. msgspec encodes and decodes, and checks types, lengths and ranges in C. Older
readers skip fields that a later version added at the end of a sample.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final

import msgspec

from skyloop.errors import DecodeError
from skyloop.messages.command import Applied, Command, VehiclePose
from skyloop.messages.config import Reply, Request
from skyloop.messages.feedback import Event, Feedback, Overview
from skyloop.messages.frame import EncodedFrame, FrameHeader, StreamReport
from skyloop.messages.relayed import Annotation, LogEntry, ProcessorResult, ProcessorShare

# The header of every packet, little-endian: signature, version, kind, reserved, body length (docs/wire-format.md).
SIGNATURE: Final = b"SKYL"
VERSION: Final = 1
HEADER: Final = struct.Struct("<4sBBHI")
HEADER_SIZE: Final = HEADER.size
MAX_BODY: Final = 60_000  #: maximum size of a body [bytes], which fits into one datagram; pixels are sent separately

#: All types of samples that a packet can contain.
Sample = (
    Command
    | Feedback
    | FrameHeader
    | Event
    | Request
    | Reply
    | Annotation
    | Applied
    | LogEntry
    | EncodedFrame
    | ProcessorResult
    | ProcessorShare
    | VehiclePose
    | Overview
    | StreamReport
)


class Kind(IntEnum):
    """Kinds of packets. Values from 0x40 belong to the transports and never reach this codec."""

    COMMAND = 1
    FEEDBACK = 2
    FRAME = 3
    EVENT = 4
    REQUEST = 5
    REPLY = 6
    ANNOTATION = 7
    APPLIED = 8
    LOG = 9
    ENCODED = 10
    RESULT = 11
    SHARE = 12
    POSE = 13
    OVERVIEW = 14
    STREAM_REPORT = 15


KINDS: Final[dict[type[Sample], Kind]] = {
    Command: Kind.COMMAND,
    Feedback: Kind.FEEDBACK,
    FrameHeader: Kind.FRAME,
    Event: Kind.EVENT,
    Request: Kind.REQUEST,
    Reply: Kind.REPLY,
    Annotation: Kind.ANNOTATION,
    Applied: Kind.APPLIED,
    LogEntry: Kind.LOG,
    EncodedFrame: Kind.ENCODED,
    ProcessorResult: Kind.RESULT,
    ProcessorShare: Kind.SHARE,
    VehiclePose: Kind.POSE,
    Overview: Kind.OVERVIEW,
    StreamReport: Kind.STREAM_REPORT,
}

_encode_body = msgspec.msgpack.Encoder().encode
_KIND_NUMBERS: Final = {sample: int(kind) for sample, kind in KINDS.items()}
_pack_header = HEADER.pack
_unpack_header = HEADER.unpack_from
_unpack_length = struct.Struct("<I").unpack_from
_PREFIX_SIZE: Final = 8  #: bytes of the header before the body length
_BY_PREFIX: Final = {
    _pack_header(SIGNATURE, VERSION, kind, 0, 0)[:_PREFIX_SIZE]: msgspec.msgpack.Decoder(sample).decode
    for sample, kind in KINDS.items()
}


def encode(sample: Sample) -> bytes:
    """Encode a sample as a packet.

    Raises ``ValueError`` if free text or native telemetry makes the body larger than :data:`MAX_BODY`.
    """
    body = _encode_body(sample)
    if len(body) > MAX_BODY:
        raise ValueError(f"{type(sample).__name__} is {len(body)} bytes, over the {MAX_BODY} of a packet")
    return _pack_header(SIGNATURE, VERSION, _KIND_NUMBERS[type(sample)], 0, len(body)) + body


def decode(packet: bytes | memoryview) -> Sample:
    """Decode a packet from any source in bounded time and memory, and check its types, lengths and ranges.

    Raises :class:`DecodeError` if the bytes are not a packet that contains a valid sample.
    """
    # A single look-up checks the signature, version, kind and reserved bytes; only failures are analysed further.
    decoder = _BY_PREFIX.get(bytes(packet[:_PREFIX_SIZE]))
    size = len(packet) - HEADER_SIZE
    if decoder is None or not 0 <= size <= MAX_BODY or _unpack_length(packet, _PREFIX_SIZE)[0] != size:
        kind = packet_kind(packet)
        raise DecodeError(f"unknown kind {kind}: known kinds are {', '.join(f'{k.value} {k.name}' for k in Kind)}")
    try:
        sample: Sample = decoder(memoryview(packet)[HEADER_SIZE:])
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError, OverflowError) as error:
        raise DecodeError(f"bad {Kind(packet[5]).name.lower()} packet: {error}") from None
    return sample


def packet_kind(packet: bytes | memoryview) -> int:
    """Return a packet's kind, after checking that its header matches its length.

    Raises :class:`DecodeError` if the header has a different version or does not match the packet.
    """
    if len(packet) < HEADER_SIZE:
        raise DecodeError(f"{len(packet)} bytes are too few for the header of {HEADER_SIZE}")
    signature, version, kind, reserved, length = _unpack_header(packet)
    if signature != SIGNATURE:
        raise DecodeError(f"signature {bytes(signature)!r} is not {SIGNATURE!r}")
    if version != VERSION:
        raise DecodeError(f"version {version} is not {VERSION}: update the older of the two ends")
    if reserved:
        raise DecodeError(f"reserved bytes are {reserved:#06x} and must be 0")
    if length != len(packet) - HEADER_SIZE:
        raise DecodeError(f"header announces {length} bytes of body, got {len(packet) - HEADER_SIZE}")
    if length > MAX_BODY:
        raise DecodeError(f"{length} bytes of body exceed the {MAX_BODY} that a packet may carry")
    return int(kind)
