"""The keys of the fabric transport: where each packet travels, and who may use which key. Pure: names only.

``docs/wire-format.md`` has the table. NAME is a proxy's name, WHO an application's identity (the common name of its
certificate, ``anyone`` without keys), ID a connection: 16 hexadecimal digits, random. TOPIC, CAMERA and VARIANT may be
any text, so they are percent-encoded to one chunk of a key each.
"""

from __future__ import annotations

import re
import secrets
from typing import Final, NamedTuple
from urllib.parse import quote, unquote

from skyloop.errors import DecodeError, UsageError
from skyloop.transport.names import NAME

ROOT: Final = "skyloop/1"
ANYONE: Final = "anyone"  #: WHO without keys
PLAIN: Final = "-"  #: the variant of a camera's frames as the proxy has them
#: Identities: one chunk of a key, with no wildcard in it.
WHO: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
ID: Final = re.compile(r"[0-9a-f]{16}")

# What an application sends by, weakest right first.
ASK: Final = "ask"  #: reliable; what an observer may send
ORDER: Final = "order"  #: reliable; what only a pilot may send
COMMAND: Final = "command"  #: best effort; the command channel


class Sender(NamedTuple):
    """Whom a key of an application belongs to."""

    way: str  #: ``ask``, ``order``, ``command``, ``app`` or ``join``
    who: str
    id: str


def new_id() -> str:
    """An ID, or a RUN."""
    return secrets.token_hex(8)


def alive(name: str, run: str) -> str:
    """Liveliness token of a server end."""
    return f"{ROOT}/{name}/alive/{run}"


def info(name: str) -> str:
    """Where a proxy tells who it is, to anybody who asks."""
    return f"{ROOT}/{name}/info"


def app(name: str, who: str, connection: str) -> str:
    """Liveliness token of a connection."""
    return f"{ROOT}/{name}/app/{who}/{connection}"


def join(name: str, who: str, connection: str) -> str:
    """Where an application asks to be let in."""
    return f"{ROOT}/{name}/join/{who}/{connection}"


def upward(way: str, name: str, who: str, connection: str) -> str:
    """Where an application sends packets: ``way`` is :data:`ASK`, :data:`ORDER` or :data:`COMMAND`."""
    return f"{ROOT}/{name}/{way}/{who}/{connection}"


def to(name: str, connection: str) -> str:
    """Where a proxy sends packets to one application."""
    return f"{ROOT}/{name}/to/{connection}"


def topic(name: str, topic_name: str) -> str:
    """Where packets of a topic are published."""
    return f"{ROOT}/{name}/topic/{_chunk(topic_name)}"


def video(name: str, camera: str, variant: str = "") -> str:
    """Where frames are published; ``variant`` is what follows the ``?`` of their topic."""
    return f"{ROOT}/{name}/video/{_chunk(camera)}/{_chunk(variant) or PLAIN}"


def video_for(name: str, camera: str, variant: str, connection: str) -> str:
    """The same for one application alone, while another one of the same variant can't keep up."""
    return f"{video(name, camera, variant)}/{connection}"


def parse_sender(key: str) -> Sender:
    """Whom a key belongs to. Raises :class:`DecodeError` for a key that no application of ours uses."""
    parts = key.split("/")
    if len(parts) == 6 and WHO.fullmatch(parts[4]) and ID.fullmatch(parts[5]):
        return Sender(parts[3], parts[4], parts[5])
    raise DecodeError(f"{key[:200]!r} is no key of an application")


def parse_alive(key: str) -> tuple[str, str]:
    """NAME and RUN of a server end's token. Raises :class:`DecodeError`."""
    parts = key.split("/")
    if len(parts) == 5 and parts[3] == "alive" and NAME.fullmatch(parts[2]) and ID.fullmatch(parts[4]):
        return parts[2], parts[4]
    raise DecodeError(f"{key[:200]!r} is no token of a proxy")


def parse_topic(key: str) -> str:
    """The topic of a key made by :func:`topic`."""
    return unquote(key.rpartition("/")[2])


def check_identity(who: str) -> None:
    """Raise :class:`UsageError` for what cannot be WHO."""
    if not WHO.fullmatch(who):
        raise UsageError(
            f"{who!r} cannot be an identity: 1 to 64 letters, digits, '_', '-' and '.', the first one a letter or digit"
        )


# What each role may do, as key expressions (see Zenoh's "access control": a rule's ``key_exprs``) -----------------


def observer_puts(who: str, name: str = "*") -> list[str]:
    """Where an observer may put packets."""
    return [upward(ASK, name, who, "*")]


def pilot_puts(who: str, name: str) -> list[str]:
    """Where a pilot may put packets, beside those of an observer."""
    return [upward(ORDER, name, who, "*"), upward(COMMAND, name, who, "*")]


def app_tokens(who: str, name: str = "*") -> list[str]:
    """Liveliness tokens that an application may declare."""
    return [app(name, who, "*")]


def app_queries(who: str, name: str = "*") -> list[str]:
    """What an application may query."""
    return [join(name, who, "*"), info(name)]


def app_watches(name: str = "*") -> list[str]:
    """Liveliness tokens that an application may ask for and watch."""
    return [alive(name, "*")]


def app_subscriptions(name: str = "*") -> list[str]:
    """What an application may subscribe to."""
    return [to(name, "*"), f"{ROOT}/{name}/topic/*", f"{ROOT}/{name}/video/**"]


def proxy_puts(name: str) -> list[str]:
    """Where a proxy may put packets."""
    return app_subscriptions(name)


def proxy_tokens(name: str) -> list[str]:
    """Liveliness tokens that a proxy may declare."""
    return [alive(name, "*")]


def proxy_watches(name: str) -> list[str]:
    """Liveliness tokens that a proxy may ask for and watch."""
    return [alive(name, "*"), app(name, "*", "*")]


def proxy_answers(name: str) -> list[str]:
    """Queries that a proxy may answer (its queryables)."""
    return [join(name, "*", "*"), info(name)]


def proxy_subscriptions(name: str) -> list[str]:
    """What a proxy may subscribe to."""
    return [upward(way, name, "*", "*") for way in (ASK, ORDER, COMMAND)]


def _chunk(text: str) -> str:
    """Any text as one chunk of a key: no ``/``, ``*``, ``$``, ``?`` or ``#`` is left in it."""
    return quote(text, safe="=&,:")
