"""Who is on the network: proxies by name, and what they say of themselves."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Final

import msgspec

from skyloop.errors import DecodeError
from skyloop.transport.fabric import layout, packets
from skyloop.transport.fabric.config import Part
from skyloop.transport.fabric.packets import ProxyInfo
from skyloop.transport.fabric.session import Session, acquire, load, release
from skyloop.transport.fabric.settings import FabricSettings

#: How long after it was opened a session has found who can be found at once: by multicast, or at the addresses given.
SETTLE_S: Final = 0.6
ANSWER_S: Final = 0.5
_LOOK_S: Final = 0.05


def list_proxies(settings: FabricSettings) -> list[ProxyInfo]:
    """The proxies that this process can reach over the network, by name. Takes about a second."""
    session = acquire(settings, Part.APP)
    try:
        _settle(session)
        return sorted(_ask(session, "*"), key=lambda about: (about.name, about.since_ns))
    finally:
        release(session)


def ask(settings: FabricSettings, name: str) -> list[ProxyInfo]:
    """The proxies with this name, the oldest first: there is more than one only where a network was cut in two."""
    if not settings.multicast and not settings.connect:
        return []  # whoever is there has to call us, and can't yet
    session = acquire(replace(settings, listen=()), Part.APP)
    try:
        _settle(session)
        return oldest_first(session, name)
    finally:
        release(session)


def oldest_first(session: Session, name: str) -> list[ProxyInfo]:
    """The same on a session that is open."""
    return sorted(_ask(session, name), key=lambda about: about.since_ns)


def runs(session: Session, name: str = "*") -> set[tuple[str, str]]:
    """NAME and RUN of the server ends whose tokens are seen now."""
    found = set()
    for reply in session.zenoh.liveliness().get(layout.alive(name, "*"), timeout=ANSWER_S):
        if reply.ok is not None:
            try:
                found.add(layout.parse_alive(str(reply.ok.key_expr)))
            except DecodeError:
                continue
    return found


def _settle(session: Session) -> None:
    """Wait until a session that was just opened knows who is there."""
    while (left_s := session.opened + SETTLE_S - time.monotonic()) > 0.0:
        time.sleep(min(left_s, _LOOK_S))


def _ask(session: Session, name: str) -> list[ProxyInfo]:
    z = load()
    found: dict[str, ProxyInfo] = {}
    replies = session.zenoh.get(
        layout.info(name), target=z.QueryTarget.ALL, consolidation=z.ConsolidationMode.NONE, timeout=ANSWER_S
    )
    for reply in replies:
        if reply.ok is None:
            continue
        try:
            about = packets.decode_info(bytes(reply.ok.payload))
        except msgspec.DecodeError:
            continue
        if str(reply.ok.key_expr) == layout.info(about.name):
            found[about.run] = about
    return list(found.values())
