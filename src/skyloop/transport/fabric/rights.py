"""By which of an application's keys a packet has to travel, so that control of keys is control of deeds. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from skyloop.errors import DecodeError
from skyloop.messages import (
    Command,
    GetParameter,
    GetStatistics,
    Hello,
    JoinProcessor,
    ListParameters,
    Ping,
    Refusal,
    Refused,
    Reply,
    Request,
    VehiclePose,
    decode,
    encode,
)
from skyloop.messages.codec import KINDS
from skyloop.transport.fabric.layout import ASK, COMMAND, ORDER

if TYPE_CHECKING:
    from skyloop.keys import Identity

#: What an observer may ask. A request that is not named here needs the right to order, so a new one is safe.
ASKED: Final = (Hello, Ping, GetParameter, ListParameters, GetStatistics, JoinProcessor)
_RANK: Final = {ASK: 0, ORDER: 1, COMMAND: 2}
_COMMAND: Final = bytes([KINDS[Command]])
_REQUEST: Final = bytes([KINDS[Request]])
_POSE: Final = bytes([KINDS[VehiclePose]])  # a vehicle may fly by it


def way_of(packet: bytes) -> str:
    """The key that a packet needs: :data:`ASK`, :data:`ORDER` or :data:`COMMAND`.

    What is no packet of ours needs no right: nobody obeys it.
    """
    kind = packet[5:6]
    if kind == _COMMAND:
        return COMMAND
    if kind == _POSE:
        return ORDER
    if kind != _REQUEST:
        return ASK
    try:
        request = decode(packet)
    except DecodeError:
        return ASK
    return ASK if isinstance(request, Request) and isinstance(request.body, ASKED) else ORDER


def refusal(packet: bytes, identity: Identity, drone: str) -> bytes | None:
    """The answer that a request would not get from the proxy, which does not even hear it; None to a command."""
    sample = decode(packet)
    if not isinstance(sample, Request):
        return None
    text = f"these are the keys of {identity}: they give no right to fly or configure {drone!r}"
    return encode(Reply(sample.id, Refused(Refusal.OBSERVER, text)))


def allows(way: str, packet: bytes) -> bool:
    """Whether a packet that came by this key has the right to."""
    return _RANK[way] >= _RANK[way_of(packet)]
