"""Identities on the network (a name, a role, and the drones that the role applies to), and Zenoh's access control.

A node applies the rules to the neighbour on each of its links, identified by the common name in the neighbour's
certificate. What that identity may *publish* is let in (ingress), what it may *subscribe* to is let out (egress), and
everything else is blocked. Each end therefore protects itself, however the others are configured. A router may publish
and subscribe to everything, and applies the rules to its own neighbours. Traffic through it is sealed, so it can't
forge anything (:mod:`skyloop.network.sealing`).

The two directions mirror each other: proxies subscribe to what applications publish, and vice versa. Declarations and
queries count as messages in the direction that they travel, so a subscriber's declaration counts as published.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatchcase
from typing import Any, Final

from skyloop.errors import UsageError
from skyloop.network import layout

ALL_DRONES: Final = ("*",)
MAX_PATTERNS: Final = 32  #: maximum number of an identity's patterns, each of which adds keys to every node's rules
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9_.-]{0,47}")
_PATTERN: Final = re.compile(r"[a-z0-9_.*-]{1,48}")
INGRESS: Final = "ingress"
EGRESS: Final = "egress"
_LIFE: Final = ("liveliness_query", "declare_liveliness_subscriber")
_ANSWERS: Final = ("declare_queryable", "reply")
_PUT: Final = ("put",)
_QUERY: Final = ("query",)
_TOKEN: Final = ("liveliness_token",)
_SUBSCRIBE: Final = ("declare_subscriber",)
_ALL: Final = (*_PUT, "delete", *_SUBSCRIBE, *_QUERY, *_ANSWERS, *_TOKEN, *_LIFE)
_ANY: Final = "*"

#: Key expressions for each kind of message.
Rules = Mapping[tuple[str, ...], list[str]]


class KeyRole(StrEnum):
    """What a key permits its owner to do with the identity's drones."""

    PILOT = "pilot"  #: may observe every drone, and fly its own
    OBSERVER = "observer"  #: may observe its drones, but not fly any
    PROXY = "proxy"  #: may serve drones with its names
    ROUTER = "router"  #: forwards everyone's sealed traffic between networks; it could drop traffic, but not read it


@dataclass(frozen=True, slots=True)
class Identity:
    """A name and its rights. ``drones`` contains patterns in which ``*`` matches any characters."""

    name: str
    role: KeyRole
    drones: tuple[str, ...] = ALL_DRONES

    def covers(self, drone: str) -> bool:
        """Return whether this identity's drones include one with this name."""
        return any(fnmatchcase(drone, pattern) for pattern in self.drones)

    def may_fly(self, drone: str) -> bool:
        """Return whether this identity is a pilot for a drone with this name."""
        return self.role is KeyRole.PILOT and self.covers(drone)

    def may_see(self, drone: str) -> bool:
        """Return whether an application with these keys may see a drone with this name. A pilot may see all drones."""
        return self.role is KeyRole.PILOT or (self.role is KeyRole.OBSERVER and self.covers(drone))

    def may_serve(self, drone: str) -> bool:
        """Return whether this is a proxy that may serve a drone with this name."""
        return self.role is KeyRole.PROXY and self.covers(drone)

    def require_proxy(self, drone: str) -> None:
        """Check that this is a proxy that may serve a drone with this name."""
        if self.role is not KeyRole.PROXY:
            raise UsageError(f"these are the keys of {self}: a proxy needs keys created with --role proxy")
        if not self.covers(drone):
            raise UsageError(f"these are the keys of {self}: they are not for the name {drone!r}")

    def require_router(self) -> None:
        if self.role is not KeyRole.ROUTER:
            raise UsageError(f"these are the keys of {self}: a router needs keys created with --role router")

    def require_application(self) -> None:
        if self.role not in (KeyRole.PILOT, KeyRole.OBSERVER):
            raise UsageError(f"these are the keys of {self}: an application needs a pilot's or an observer's")

    def __str__(self) -> str:
        return f"{self.name}, {self.role}" + ("" if self.role is KeyRole.ROUTER else f" of {','.join(self.drones)}")


def make_identity(name: str, role: str, drones: str = "*") -> Identity:
    """Create an identity from user input.

    The name has 1 to 48 lowercase letters, digits, ``_``, ``-`` and ``.``, and must not be ``anyone``. ``role`` is a
    value of :class:`KeyRole`. ``drones`` are names or patterns, separated by commas; for a router, ``*``.
    """
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{name!r} cannot be the name of a key: 1 to 48 lower-case letters, digits, '_', '-' and '.', "
            "the first one a letter or a digit"
        )
    if name == layout.ANYONE:
        raise UsageError(f"no key can be named {layout.ANYONE!r}: that name stands for everyone without a key")
    if role not in list(KeyRole):
        raise UsageError(f"there is no role {role!r}: choose one of {', '.join(KeyRole)}")
    patterns = parse_drones(drones)
    if role == KeyRole.ROUTER and patterns != ALL_DRONES:
        raise UsageError("a router carries the traffic of all drones: leave out the drones")
    return Identity(name, KeyRole(role), patterns)


def parse_drones(text: str) -> tuple[str, ...]:
    """Parse drone names or patterns separated by commas: ``alpha,bravo*``."""
    patterns = tuple(dict.fromkeys(re.sub(r"\*+", "*", part.strip()) for part in text.split(",")))
    for pattern in patterns:
        if not _PATTERN.fullmatch(pattern) or not (_NAME.fullmatch(pattern) or "*" in pattern):
            raise UsageError(
                f"{pattern!r} names no drones: lower-case letters, digits, '_', '-' and '.', and '*' for any of these; "
                "several are separated by commas: alpha,bravo*"
            )
    if len(patterns) > MAX_PATTERNS:
        raise UsageError(
            f"{len(patterns)} patterns of drones are too many: give at most {MAX_PATTERNS}, or '*' for any name"
        )
    return ALL_DRONES if "*" in patterns else patterns


# Zenoh's access control, generated from a lab's roster ----------------------------------------------------------------


def access_control(identities: Iterable[Identity]) -> dict[str, Any]:
    """Return Zenoh's ``access_control`` section for any node in a lab. Only these identities may join."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for identity in identities:
        own = [
            {"id": f"{identity.name} {flow} {number}", "messages": list(messages), "flows": [flow]}
            | {"permission": "allow", "key_exprs": keys}
            for flow, table in ((INGRESS, may_publish(identity)), (EGRESS, may_subscribe(identity)))
            for number, (messages, keys) in enumerate(table.items())
        ]
        rules += own
        subjects.append({"id": identity.name, "cert_common_names": [identity.name]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [identity.name]})
    lists = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"enabled": True, "default_permission": "deny", **lists}


def may_publish(identity: Identity) -> Rules:
    """Return what an identity may send, declare and query."""
    if identity.role is KeyRole.ROUTER:
        return {_ALL: [f"{layout.ROOT}/**"]}
    names = _chunks(identity.drones)
    if identity.role is KeyRole.PROXY:
        return {
            _PUT: _to_applications(names),
            _TOKEN: [layout.alive(name, _ANY) for name in names],
            _ANSWERS: [key for name in names for key in (layout.join(name, _ANY, _ANY), layout.info(name))],
            _SUBSCRIBE: [layout.upward(way, name, _ANY, _ANY) for name in names for way in layout.WAYS],
            _LIFE: [
                layout.alive(_ANY, _ANY),
                *(key for name in names for key in (layout.alive(name, _ANY), layout.app(name, _ANY, _ANY))),
            ],
            _QUERY: [layout.info(_ANY)],
        }
    who, seen = identity.name, _seen(identity)
    return {
        _PUT: _to_proxies(identity, who),
        _TOKEN: [layout.app(name, who, _ANY) for name in seen],
        _SUBSCRIBE: _to_applications(seen),
        _LIFE: [layout.alive(_ANY, _ANY)],
        _QUERY: [layout.info(_ANY), *(layout.join(name, who, _ANY) for name in seen)],
    }


def may_subscribe(identity: Identity) -> Rules:
    """Return what an identity may receive: what proxies send to applications for an application, and vice versa."""
    if identity.role is KeyRole.ROUTER:
        return may_publish(identity)
    names, alive, info = _chunks(identity.drones), layout.alive(_ANY, _ANY), layout.info(_ANY)
    if identity.role is KeyRole.PROXY:
        return {
            _TOKEN: [alive, *(layout.app(name, _ANY, _ANY) for name in names)],
            _ANSWERS: [info],
            _LIFE: [alive],
            _PUT: [layout.upward(way, name, _ANY, _ANY) for name in names for way in layout.WAYS],
            _SUBSCRIBE: _to_applications(names),
            _QUERY: [info, *(layout.join(name, _ANY, _ANY) for name in names)],
        }
    seen = _seen(identity)
    return {
        _TOKEN: [alive],
        _ANSWERS: [info, *(layout.join(name, _ANY, _ANY) for name in seen)],
        _LIFE: [alive, *(layout.app(name, _ANY, _ANY) for name in seen)],
        _PUT: _to_applications(seen),
        _SUBSCRIBE: _to_proxies(identity, _ANY),
        _QUERY: [info],
    }


def _to_applications(names: list[str]) -> list[str]:
    """Return the keys that proxies send packets and frames on, and that applications subscribe to."""
    return [key for name in names for key in layout.downward(name)]


def _to_proxies(identity: Identity, who: str) -> list[str]:
    """Return the keys on which an application may send packets or may receive ``who``'s subscription to them."""
    keys = [layout.upward(layout.ASK, name, who, _ANY) for name in _seen(identity)]
    if identity.role is KeyRole.PILOT:
        ways = (layout.ORDER, layout.COMMAND)
        keys += [layout.upward(way, name, who, _ANY) for name in _chunks(identity.drones) for way in ways]
    return keys


def _seen(identity: Identity) -> list[str]:
    """Return the drones that an application may see. A pilot may observe all drones, not only those it may fly."""
    return _chunks(ALL_DRONES if identity.role is KeyRole.PILOT else identity.drones)


def _chunks(patterns: tuple[str, ...]) -> list[str]:
    """Convert each pattern to one chunk of a key expression: ``*`` becomes any name, ``$*`` any characters."""
    return [pattern if pattern == _ANY else pattern.replace("*", "$*") for pattern in patterns]
