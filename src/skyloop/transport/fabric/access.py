"""Zenoh's access control, made from a lab's roster. Pure.

A node applies it on each of its links, to whoever stands at the other end, by the common name in the certificate: what
that one may *say* passes inward (ingress), what it may *hear* passes outward (egress), and nothing else passes. So each
end protects itself, and none relies on what another one's configuration says. A router is trusted by its neighbours
with everything, and does the same with its own neighbours.

To say and to hear are two sides of one thing: what an application says, proxies hear. Declarations count as what they
are: who subscribes says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

from skyloop.keys.credentials import Credentials
from skyloop.keys.identity import ALL_DRONES, Identity, KeyRole
from skyloop.keys.ring import KeyRing
from skyloop.transport.fabric import layout
from skyloop.transport.fabric.settings import FabricSettings, TlsFiles

SAYS: Final = "ingress"
HEARS: Final = "egress"
_LIFE: Final = ("liveliness_query", "declare_liveliness_subscriber")
_ANSWERS: Final = ("declare_queryable", "reply")
_PUT: Final = ("put",)
_QUERY: Final = ("query",)
_TOKEN: Final = ("liveliness_token",)
_SUBSCRIBE: Final = ("declare_subscriber",)
_ALL: Final = (*_PUT, "delete", *_SUBSCRIBE, *_QUERY, *_ANSWERS, *_TOKEN, *_LIFE)
_ANY: Final = "*"

#: Key expressions, by the kinds of messages.
Rules = Mapping[tuple[str, ...], list[str]]


def access_control(identities: Iterable[Identity]) -> dict[str, Any]:
    """Zenoh's ``access_control`` for any node of a lab with these identities. Without identities nothing passes."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for identity in identities:
        own = [
            {"id": f"{identity.name} {flow} {number}", "messages": list(messages), "flows": [flow]}
            | {"permission": "allow", "key_exprs": keys}
            for flow, table in ((SAYS, says(identity)), (HEARS, hears(identity)))
            for number, (messages, keys) in enumerate(table.items())
        ]
        rules += own
        subjects.append({"id": identity.name, "cert_common_names": [identity.name]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [identity.name]})
    lists = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"enabled": True, "default_permission": "deny", **lists}


def secured(settings: FabricSettings, credentials: Credentials) -> FabricSettings:
    """These settings with a key: mutual TLS over QUIC, and access control by the roster that came with it."""
    return replace(
        settings,
        tls=TlsFiles(credentials.authority_file, credentials.certificate_file, credentials.key_file),
        who=credentials.name,
        access_control=access_control(credentials.roster.identities),
        ring=KeyRing(credentials),
    )


def says(identity: Identity) -> Rules:
    """What an identity may send, declare and ask for."""
    if identity.role is KeyRole.ROUTER:
        return {_ALL: [f"{layout.ROOT}/**"]}
    names = _chunks(identity.drones)
    if identity.role is KeyRole.PROXY:
        return {
            _PUT: _each(names, layout.proxy_puts),
            _TOKEN: _each(names, layout.proxy_tokens),
            _ANSWERS: _each(names, layout.proxy_answers),
            _SUBSCRIBE: _each(names, layout.proxy_subscriptions),
            _LIFE: [*layout.app_watches(_ANY), *_each(names, layout.proxy_watches)],
            _QUERY: [layout.info(_ANY)],
        }
    who, seen = identity.name, _seen(identity)
    return {
        _PUT: _app_puts(identity, who),
        _TOKEN: [key for name in seen for key in layout.app_tokens(who, name)],
        _SUBSCRIBE: _each(seen, layout.app_subscriptions),
        _LIFE: layout.app_watches(_ANY),
        _QUERY: [layout.info(_ANY), *(layout.join(name, who, _ANY) for name in seen)],
    }


def hears(identity: Identity) -> Rules:
    """What an identity is told: what proxies say to an application, what applications say to a proxy."""
    if identity.role is KeyRole.ROUTER:
        return says(identity)
    names = _chunks(identity.drones)
    everywhere = {_TOKEN: layout.proxy_tokens(_ANY), _ANSWERS: [layout.info(_ANY)], _LIFE: layout.app_watches(_ANY)}
    if identity.role is KeyRole.PROXY:
        return {
            **everywhere,
            _TOKEN: [*everywhere[_TOKEN], *(key for name in names for key in layout.app_tokens(_ANY, name))],
            _PUT: [
                key for name in names for key in (*layout.observer_puts(_ANY, name), *layout.pilot_puts(_ANY, name))
            ],
            _SUBSCRIBE: _each(names, layout.app_subscriptions),
            _QUERY: [layout.info(_ANY), *(layout.join(name, _ANY, _ANY) for name in names)],
        }
    seen = _seen(identity)
    return {
        **everywhere,
        _PUT: _each(seen, layout.proxy_puts),
        _ANSWERS: [*everywhere[_ANSWERS], *(layout.join(name, _ANY, _ANY) for name in seen)],
        _SUBSCRIBE: _app_puts(identity, _ANY),
        _LIFE: [*everywhere[_LIFE], *(layout.app(name, _ANY, _ANY) for name in seen)],
        _QUERY: [layout.info(_ANY)],
    }


def _app_puts(identity: Identity, who: str) -> list[str]:
    """Where an application may put packets, or hear that ``who`` is awaited there."""
    keys = [key for name in _seen(identity) for key in layout.observer_puts(who, name)]
    if identity.role is KeyRole.PILOT:
        keys += [key for name in _chunks(identity.drones) for key in layout.pilot_puts(who, name)]
    return keys


def _seen(identity: Identity) -> list[str]:
    """A pilot may see all drones, whichever he may fly."""
    return _chunks(ALL_DRONES if identity.role is KeyRole.PILOT else identity.drones)


def _chunks(patterns: tuple[str, ...]) -> list[str]:
    """Patterns as one part of a key expression each, where ``*`` alone is any name and ``$*`` any characters."""
    return [pattern if pattern == _ANY else pattern.replace("*", "$*") for pattern in patterns]


def _each(names: list[str], keys: Callable[[str], list[str]]) -> list[str]:
    return [key for name in names for key in keys(name)]
