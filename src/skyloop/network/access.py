"""Generate Zenoh's access control from a lab's roster. Pure functions.

A node applies the rules to the neighbour on each of its links, identified by the common name in the neighbour's
certificate. What that identity may *publish* passes inward (ingress), what it may *subscribe* to passes outward
(egress), and everything else is blocked. Each end thus protects itself, regardless of how others are configured. A
router may publish and subscribe to everything, and applies the rules to its own neighbours; traffic through it is
sealed, so that it cannot forge anything (:mod:`skyloop.network.sealing`).

The two directions mirror each other: proxies subscribe to what applications publish, and vice versa. Declarations and
queries count as messages in the direction in which they travel, so a subscriber's declaration counts as published.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

from skyloop.network import layout
from skyloop.network.keys.identity import ALL_DRONES, Identity, KeyRole

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


def access_control(identities: Iterable[Identity]) -> dict[str, Any]:
    """Return Zenoh's ``access_control`` section for any node in a lab: only these identities may join."""
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
    """Return what an identity may receive.

    Applications receive what proxies send to them; proxies receive what applications send.
    """
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
    """Return the keys on which proxies send packets and frames, and which applications subscribe to."""
    return [key for name in names for key in layout.downward(name)]


def _to_proxies(identity: Identity, who: str) -> list[str]:
    """Return the keys on which an application may send packets, or may receive ``who``'s subscription to them."""
    keys = [layout.upward(layout.ASK, name, who, _ANY) for name in _seen(identity)]
    if identity.role is KeyRole.PILOT:
        ways = (layout.ORDER, layout.COMMAND)
        keys += [layout.upward(way, name, who, _ANY) for name in _chunks(identity.drones) for way in ways]
    return keys


def _seen(identity: Identity) -> list[str]:
    """Return the drones that an application may see. A pilot may see all drones, not only those it may fly."""
    return _chunks(ALL_DRONES if identity.role is KeyRole.PILOT else identity.drones)


def _chunks(patterns: tuple[str, ...]) -> list[str]:
    """Convert each pattern to one chunk of a key expression, in which ``*`` is any name and ``$*`` any characters."""
    return [pattern if pattern == _ANY else pattern.replace("*", "$*") for pattern in patterns]
