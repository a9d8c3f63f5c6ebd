"""The keys of the fabric transport: the key for each packet, and the keys that each role may use. Pure functions.

A packet that requests something must travel by the matching key. Controlling keys therefore means controlling actions.

``docs/wire-format.md`` contains the table. NAME is a proxy's name. WHO is an application's identity: the common name of
its certificate, or ``anyone`` without keys. ID is a connection (16 random hexadecimal digits). TOPIC, CAMERA and
VARIANT may be arbitrary text, so each is percent-encoded to one chunk of a key.
"""

from __future__ import annotations

import re
import secrets
from typing import Final, NamedTuple
from urllib.parse import quote, unquote

from skyloop.errors import DecodeError, UsageError
from skyloop.messages import (
    Command,
    GetParameter,
    GetStatistics,
    Hello,
    JoinProcessor,
    ListParameters,
    Ping,
    Request,
    StreamReport,
    VehiclePose,
    decode,
    encode,
)
from skyloop.messages.codec import KINDS
from skyloop.transport.base import FEEDBACK, NAME

ROOT: Final = "skyloop/1"
ANYONE: Final = "anyone"  #: WHO if there are no keys
PLAIN: Final = "-"  #: the variant that contains a camera's unchanged frames
#: Valid identities: one chunk of a key, without wildcards.
WHO: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
ID: Final = re.compile(r"[0-9a-f]{16}")

# Kinds of keys for an application's packets, weakest right first.
ASK: Final = "ask"  #: reliable; also for observers
ORDER: Final = "order"  #: reliable; only for pilots
COMMAND: Final = "command"  #: best effort; the channel for commands
WAYS: Final = (ASK, ORDER, COMMAND)
#: Requests that observers may send. All others are only for pilots, so that new kinds are safe by default.
ASKED: Final = (Hello, Ping, GetParameter, ListParameters, GetStatistics, JoinProcessor)
_COMMAND: Final = bytes([KINDS[Command]])
_REQUEST: Final = bytes([KINDS[Request]])
_REPORT: Final = encode(StreamReport("", 0))[:6]  # signature, version and kind: garbage is no report
_POSE: Final = bytes([KINDS[VehiclePose]])  # some vehicles need poses to fly


class Sender(NamedTuple):
    """The application that a key belongs to."""

    way: str  #: ``ask``, ``order``, ``command``, ``app`` or ``join``
    who: str
    id: str


def new_id() -> str:
    return secrets.token_hex(8)


def alive(name: str, run: str) -> str:
    """Return the key for a transport server's liveliness token."""
    return f"{ROOT}/{name}/alive/{run}"


def info(name: str) -> str:
    """Return the key under which a proxy describes itself."""
    return f"{ROOT}/{name}/info"


def app(name: str, who: str, connection: str) -> str:
    """Return the key for a connection's liveliness token."""
    return f"{ROOT}/{name}/app/{who}/{connection}"


def join(name: str, who: str, connection: str) -> str:
    """Return the key for an application's request to join."""
    return f"{ROOT}/{name}/join/{who}/{connection}"


def upward(way: str, name: str, who: str, connection: str) -> str:
    """Return the key for packets from an application sent in one of the :data:`WAYS`."""
    return f"{ROOT}/{name}/{way}/{who}/{connection}"


def to(name: str, connection: str) -> str:
    """Return the key for packets from a proxy to one application."""
    return f"{ROOT}/{name}/to/{connection}"


def topic(name: str, topic_name: str) -> str:
    """Return the key for published packets of a topic."""
    return f"{ROOT}/{name}/topic/{_chunk(topic_name)}"


def newest_wins(topic_name: str) -> bool:
    """Return whether only a topic's newest packet matters. Such a packet may be lost, and never waits for others."""
    return topic_name.partition("?")[0] == FEEDBACK  # feedback in any variant


def video(name: str, camera: str, variant: str = "") -> str:
    """Return the key for a variant's frames; the variant is the part after the ``?`` in their topic."""
    return f"{ROOT}/{name}/video/{_chunk(camera)}/{_chunk(variant) or PLAIN}"


def video_for(name: str, camera: str, variant: str, connection: str) -> str:
    """Return the key for frames to one application. It is used while another reader of the variant can't keep up."""
    return f"{video(name, camera, variant)}/{connection}"


def downward(name: str) -> tuple[str, str, str]:
    """Return expressions for all keys that a proxy uses to send packets and frames."""
    return to(name, "*"), f"{ROOT}/{name}/topic/*", f"{ROOT}/{name}/video/**"


def parse_sender(key: str) -> Sender:
    """Return the application that a key belongs to."""
    parts = key.split("/")
    if len(parts) == 6 and WHO.fullmatch(parts[4]) and ID.fullmatch(parts[5]):
        return Sender(parts[3], parts[4], parts[5])
    raise DecodeError(f"{key[:200]!r} is not an application's key")


def parse_alive(key: str) -> tuple[str, str]:
    """Parse NAME and RUN from the key of a transport server's token."""
    parts = key.split("/")
    if len(parts) == 5 and parts[3] == "alive" and NAME.fullmatch(parts[2]) and ID.fullmatch(parts[4]):
        return parts[2], parts[4]
    raise DecodeError(f"{key[:200]!r} is not a proxy's token")


def parse_topic(key: str) -> str:
    """Return the topic for which :func:`topic` made a key."""
    return unquote(key.rpartition("/")[2])


def check_identity(who: str) -> None:
    """Check that an identity is a valid WHO."""
    if not WHO.fullmatch(who):
        raise UsageError(
            f"{who!r} cannot be an identity: 1 to 64 letters, digits, '_', '-' and '.', the first one a letter or digit"
        )


# The key that a packet needs ---------------------------------------------------------------------------------


def way_of(packet: bytes) -> str:
    """Return the kind of key that a packet needs: :data:`ASK`, :data:`ORDER` or :data:`COMMAND`.

    Bytes that are not a packet need no rights, because they have no effect.
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


def is_report(packet: bytes) -> bool:
    """Return whether a packet reports a stream's state. It may be lost, because a late report would be wrong."""
    return packet[:6] == _REPORT


def allows(way: str, packet: bytes) -> bool:
    """Return whether a packet is allowed on the key that it arrived on."""
    return WAYS.index(way) >= WAYS.index(way_of(packet))


def _chunk(text: str) -> str:
    """Encode arbitrary text as one chunk of a key, without ``/``, ``*``, ``$``, ``?`` and ``#``."""
    return quote(text, safe="=&,:")
