"""Admit applications that prove their identity with their keys, as long as there is room for them.

The exchange of these proofs also gives the two ends the keys that seal their packets.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

from skyloop.errors import DecodeError, LinkError
from skyloop.network import layout, packets
from skyloop.network.sealing import PLAIN, TRAILER, Open, Opener, Seal, Sealer

if TYPE_CHECKING:
    from datetime import datetime

    from skyloop.network.keys import Identity, KeyRing

MAX_CLIENTS: Final = 256  #: maximum number of connections; each costs memory, and time on the handler's thread
#: Connections allowed per key. A program needs one per drone. A lab's cockpit, recorders and workers share a key.
PER_KEY: Final = 64
#: Connections reserved for keys that may fly this drone, so that any number of other keys can't lock pilots out.
FOR_PILOTS: Final = 64
#: Number of tokens remembered per key, because a token arrives before its connection.
TOKENS_PER_KEY: Final = 4 * PER_KEY
#: Total limit without keys. All applications then have the same name, so a flood from one looks like many applications.
TOKENS: Final = 16 * MAX_CLIENTS


class Admission(NamedTuple):
    """The terms of a connection. Without keys, only ``welcome`` is set."""

    welcome: bytes = b""  #: the proxy's answer
    offer: bytes = b""  #: the proof contained in the request
    identity: Identity | None = None  #: the proven identity of the other end
    expires: datetime | None = None  #: time at which its key expires
    sealer: Sealer = PLAIN  #: seals packets sent to the other end
    opener: Opener = PLAIN  #: opens packets received from the other end
    topics: Opener = PLAIN  #: opens published packets (in the application)
    generation: int = 0  #: generation of the topic key


def admit(
    ring: KeyRing | None, name: str, run: str, sender: layout.Sender, request: packets.Join, topics: Seal | None
) -> Admission:
    """Check a request to join. Return its terms, including the proxy's answer. Without keys, everyone is admitted."""
    if ring is None or topics is None:
        return Admission(packets.encode_own(packets.Welcome(packets.REVISION, run)))
    from skyloop.network.keys.agreement import Agreement

    proof, agreed = Agreement(ring, *_terms(name, run, sender)).answer(request.proof)
    identity = agreed.identity
    if identity.name != sender.who:
        raise LinkError(f"these are the keys of {identity}, not of {sender.who}")
    if not identity.may_see(name):
        raise LinkError(f"these are the keys of {identity}: they are not for {name}")
    sealer = Seal(agreed.down)
    where = layout.join(name, sender.who, sender.id)
    sealed, trailer = sealer.seal(where, b"", packets.key(topics.generation, topics.key))
    welcome = packets.encode_own(packets.Welcome(packets.REVISION, run, proof, trailer + sealed))
    return Admission(
        welcome, request.proof, identity, agreed.expires, sealer, Open().use(agreed.up), generation=topics.generation
    )


class JoinRequest:
    """An application's request to join. With keys, only the intended proxy's answer is accepted; without, any is."""

    def __init__(self, ring: KeyRing | None, name: str, run: str, sender: layout.Sender) -> None:
        self._name = name
        self._sender = sender
        self.proof = b""
        if ring is not None:
            from skyloop.network.keys.agreement import Agreement

            self._agreement = Agreement(ring, *_terms(name, run, sender))
            self.proof = self._agreement.offer()

    def accept(self, welcome: packets.Welcome) -> Admission:
        """Check the proxy's answer; return the terms. An answer from an impostor raises :class:`LinkError`."""
        if not self.proof:
            return Admission()
        agreed = self._agreement.accept(welcome.proof)
        if not agreed.identity.may_serve(self._name):
            raise LinkError(f"it answers with the keys of {agreed.identity}: they are not for the name {self._name!r}")
        opener = Open().use(agreed.down)
        where, trailer = layout.join(self._name, self._sender.who, self._sender.id), welcome.topics[:TRAILER]
        try:
            opened = opener.open(where, trailer, welcome.topics[TRAILER:])
            message = packets.parse(opened[0]) if opened is not None else None
        except DecodeError as error:
            raise LinkError(f"its answer is inconsistent: {error}") from None
        if not isinstance(message, packets.Key):
            raise LinkError("its answer has no key for topics")
        topics = Open().use(message.key, message.generation)
        return Admission(
            b"", self.proof, agreed.identity, agreed.expires, Seal(agreed.up), opener, topics, message.generation
        )


def _terms(name: str, run: str, sender: layout.Sender) -> tuple[str, ...]:
    return name, run, sender.who, sender.id


def no_place_reason(who: str, may_fly: bool, present: Iterable[tuple[str, bool]]) -> str:
    """Return why there is no room for another connection from ``who``; empty if there is room.

    ``present``: the identity behind each connection, and whether it may fly this drone.
    """
    here = list(present)
    own = sum(other == who for other, _ in here)
    if own >= PER_KEY:
        return f"the key of {who!r} already has {own} of at most {PER_KEY} connections: close some of them"
    if len(here) >= MAX_CLIENTS:
        return f"there are already {len(here)} of at most {MAX_CLIENTS} connections: close some of them"
    observers = sum(not flies for _, flies in here)
    if not may_fly and observers >= MAX_CLIENTS - FOR_PILOTS:
        return (
            f"there are already {observers} connections of keys that may not fly this drone, and the other "
            f"{FOR_PILOTS} are reserved for pilots: close some of them"
        )
    return ""


class Tokens:
    """The liveliness tokens of connections, with a limit per identity or, without keys, in total. Not thread-safe."""

    def __init__(self, *, by_key: bool) -> None:
        self._most = TOKENS_PER_KEY if by_key else TOKENS
        self._seen: dict[str, set[str]] = {}

    def add(self, who: str, connection: str) -> bool:
        """Add a token; return False if the identity has too many tokens."""
        seen = self._seen.setdefault(who, set())
        if len(seen) >= self._most and connection not in seen:
            return False
        seen.add(connection)
        return True

    def discard(self, who: str, connection: str) -> None:
        seen = self._seen.get(who)
        if seen is not None:
            seen.discard(connection)
            if not seen:
                del self._seen[who]

    def has(self, who: str, connection: str) -> bool:
        return connection in self._seen.get(who, ())

    def any_of(self, connections: Mapping[str, str]) -> bool:
        """Return whether there is a token for any of these connections, which are given with their identities."""
        return any(self.has(who, connection) for connection, who in connections.items())
