"""The keys of a running process: which identities a newer roster excludes, and how two ends prove their identities.

A link's certificates only identify the neighbour on that *link*, which may be a router. The two ends of a connection
therefore also present their certificates to each other, in an exchange like those of SIGMA (Krawczyk, CRYPTO 2003) and
TLS 1.3: each end signs a fresh X25519 share together with the terms of the connection. The proxy also signs the
application's whole message. The secrets are derived from both shares and the transcript (HKDF-SHA256). No router knows
them. Replayed messages are therefore useless, and a key that leaks later can't decrypt earlier recordings.
"""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from hashlib import sha256
from pathlib import Path
from typing import Final

import msgspec
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from skyloop.errors import DecodeError, LinkError, UsageError
from skyloop.network.keys import certificates
from skyloop.network.keys.credentials import Credentials, Roster
from skyloop.network.keys.identity import Identity

AGAIN: Final = timedelta(hours=1)  #: interval between warnings about an approaching expiry
SECRET_BYTES: Final = 32  #: size of a key of ChaCha20-Poly1305
_PURPOSE: Final = "fabric connection 1"  # prefix of all content that is signed here; no other signature uses it
_OFFER, _ANSWER = "offer", "answer"


class KeyRing:
    """A process's keys, and the newest roster in their folder. Thread-safe."""

    def __init__(self, credentials: Credentials) -> None:
        self.credentials = credentials
        #: Names that were revoked, or whose rights have changed, since this process applied its roster.
        self.shut_out: frozenset[str] = frozenset()
        self._in_force = credentials.roster
        self._listed = frozenset(credentials.roster.identities)  # identities that are in the newest roster
        self._stamp = _stamp(credentials)
        self._announced: dict[str, datetime] = {}
        self._pending: list[str] = []
        self._lock = threading.Lock()

    @property
    def roster(self) -> Roster:
        """The newest roster that was read."""
        return self.credentials.roster

    @property
    def outdated(self) -> bool:
        """Whether the newest roster differs from the roster that this process applied."""
        return self._listed != frozenset(self._in_force.identities)

    def admits(self, identity: Identity) -> bool:
        """Return whether the newest roster lists this identity with these rights and has never excluded it."""
        return identity in self._listed and identity.name not in self.shut_out

    def refresh(self) -> None:
        """Read the roster if its file has changed, and store the resulting messages for :meth:`poll`."""
        with self._lock:
            self._pending += self._read()

    def poll(self, now: datetime | None = None) -> list[str]:
        """Read the roster if its file has changed, and return messages for users, one sentence each.

        These messages announce a newer roster and, once an hour, a certificate that expires within a week. A roster
        that can't be read is reported, and the previous roster stays in force.
        """
        now = now or datetime.now(UTC)
        with self._lock:
            changes, self._pending = [*self._pending, *self._read()], []
            return [*self._ending(now), *changes]

    def _ending(self, now: datetime) -> list[str]:
        ends = self.credentials.ends(now)
        due = [what for what in ends if what not in self._announced or now - self._announced[what] >= AGAIN]
        self._announced.update(dict.fromkeys(due, now))
        return [ends[what] for what in due]

    def _read(self) -> list[str]:
        stamp = _stamp(self.credentials)
        if stamp == self._stamp:
            return []
        self._stamp = stamp
        try:
            renewed = self.credentials.renewed()
        except UsageError as error:
            return [f"{error}; the previous roster stays in force"]
        if renewed is None:
            return []
        before, after = frozenset(self._in_force.identities), frozenset(renewed.roster.identities)
        self.shut_out = frozenset(identity.name for identity in before - after)
        self._listed = after
        self.credentials = renewed
        if before == after:
            return []
        gone = f"; revoked or changed: {', '.join(sorted(self.shut_out))}" if self.shut_out else ""
        number = renewed.roster.number
        return [f"the lab's roster has changed (number {number}){gone}; restart this program to apply all of it"]


def _stamp(credentials: Credentials) -> tuple[int, int, int]:
    """Return values that change whenever the roster's file changes."""
    try:
        found = os.stat(credentials.roster_file)  # noqa: PTH116  cheaper, and called twice a second
    except OSError:
        return 0, 0, 0
    return found.st_mtime_ns, found.st_size, found.st_ino


class Proof(msgspec.Struct, frozen=True, array_like=True):
    """The proof that each end sends to the other."""

    certificate: bytes  #: DER
    share: bytes  #: X25519, 32 bytes
    signature: bytes  #: ECDSA with SHA-256, made with the certificate's key, in DER


@dataclass(frozen=True, slots=True)
class Agreed:
    """The identity at the other end, and the secrets of this connection."""

    identity: Identity  #: the other end's identity
    expires: datetime  #: expiry of the other end's certificate
    up: bytes  #: secret that seals the application's packets
    down: bytes  #: secret that seals the proxy's packets


class Agreement:
    """One end's part in the exchange, using its keys. Both ends have the same ``terms`` of the connection."""

    def __init__(self, ring: KeyRing, *terms: str) -> None:
        self._ring = ring
        self._terms = terms
        self._private = X25519PrivateKey.generate()
        self._offered = b""
        self._share = self._private.public_key().public_bytes_raw()

    def offer(self) -> bytes:
        """Return the application's first message, which is a :class:`Proof` as MessagePack."""
        self._offered = self._prove(self._claim(_OFFER, self._share))
        return self._offered

    def answer(self, offer: bytes, now: datetime | None = None) -> tuple[bytes, Agreed]:
        """Check the application's offer. Return the proxy's answer (a :class:`Proof`) and the agreed secrets."""
        proof = _decode(offer)
        identity, expires = self._check(proof, self._claim(_OFFER, proof.share), now)
        claim = self._claim(_ANSWER, self._share, offer)
        return self._prove(claim), self._agree(identity, expires, proof.share, claim)

    def accept(self, answer: bytes, now: datetime | None = None) -> Agreed:
        """Check the proxy's answer and return the secrets that were agreed on."""
        proof = _decode(answer)
        claim = self._claim(_ANSWER, proof.share, self._offered)
        identity, expires = self._check(proof, claim, now)
        return self._agree(identity, expires, proof.share, claim)

    def _claim(self, what: str, share: bytes, offer: bytes = b"") -> bytes:
        return msgspec.msgpack.encode([_PURPOSE, what, self._terms, share, offer])

    def _prove(self, claim: bytes) -> bytes:
        own = self._ring.credentials
        proof = Proof(certificates.der(own.certificate), self._share, certificates.sign(own.key, claim))
        return msgspec.msgpack.encode(proof)

    def _check(self, proof: Proof, claim: bytes, now: datetime | None) -> tuple[Identity, datetime]:
        try:
            certificate = certificates.read_der(proof.certificate)
            path = Path("its certificate")
            certificates.check_issued(certificate, self._ring.credentials.authority, path)
            certificates.check_time(certificate, "its key", now or datetime.now(UTC))
            identity = certificates.identity_of(certificate, path)
        except (DecodeError, UsageError) as error:
            raise LinkError(f"the other end presents no key of this lab: {error}") from None
        if not certificates.signed_by(certificate, claim, proof.signature):
            raise LinkError(f"the other end shows the certificate of {identity.name} but does not have its key")
        if not self._ring.admits(identity):
            raise LinkError(f"the roster (number {self._ring.roster.number}) does not have {identity}: {_WHY}")
        return identity, certificate.not_valid_after_utc

    def _agree(self, identity: Identity, expires: datetime, share: bytes, claim: bytes) -> Agreed:
        try:
            shared = self._private.exchange(X25519PublicKey.from_public_bytes(share))
        except ValueError as error:
            raise LinkError(f"the other end's key share is invalid: {error}") from None
        salt = sha256(claim).digest()
        secrets = HKDF(SHA256(), 2 * SECRET_BYTES, salt, _PURPOSE.encode()).derive(shared)
        return Agreed(identity, expires, secrets[:SECRET_BYTES], secrets[SECRET_BYTES:])


def _decode(proof: bytes) -> Proof:
    try:
        return msgspec.msgpack.decode(proof, type=Proof)
    except msgspec.DecodeError:
        raise LinkError("the other end presents no key: both ends need keys, and a version presenting them") from None


_WHY: Final = "it was revoked, its rights were changed, or a newer roster is needed here"
