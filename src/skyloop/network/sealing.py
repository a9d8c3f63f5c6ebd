"""Seal packets end to end: no node between a proxy and its applications can read, change or replay them.

The seal is ChaCha20-Poly1305 (RFC 8439). The seal also authenticates a packet's attachment and the key it travels by.
Without keys, nothing is sealed. ``docs/wire-format.md`` describes the bytes.
"""

from __future__ import annotations

import itertools
import os
import struct
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, TypeAlias

from skyloop.errors import DecodeError
from skyloop.network import packets
from skyloop.transport.base import MAX_PACKET

if TYPE_CHECKING:
    import zenoh
    from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

TAG: Final = 16  #: number of bytes that sealing adds to a payload
_TRAILER = struct.Struct("<IQ")  # generation and number; they are appended to the attachment, and used as the nonce
TRAILER: Final = _TRAILER.size
KEY_BYTES: Final = 32  #: size of a key of ChaCha20-Poly1305
#: How far a packet's number may be behind the newest: datagrams, 100 a second, can overtake a resent packet for 10 s.
WIDTH: Final = 1024
GENERATIONS: Final = 3  #: topic keys that an application keeps: the current one, the newest one, and one between
#: Delay between sending a new topic key and first using it, so that it arrives before the packets sealed with it.
SWITCH_S: Final = 0.5


class Plain:
    """A seal and opener that change nothing, for use without keys."""

    tag = trailer = 0

    def seal(self, where: str, attachment: bytes, data: bytes) -> tuple[bytes, bytes]:  # noqa: ARG002
        return data, attachment

    def open(self, where: str, attachment: bytes, payload: bytes) -> tuple[bytes, bytes] | None:  # noqa: ARG002
        return payload, attachment

    def use(self, key: bytes, generation: int = 0) -> Plain:  # noqa: ARG002
        return self


PLAIN: Final = Plain()


class Seal:
    """Seals packets with a numbered key of :data:`KEY_BYTES` bytes, and never uses a packet number twice."""

    def __init__(self, key: bytes, generation: int = 0) -> None:
        self.key = key
        self.generation = generation
        self._cipher = _cipher(key)
        self._numbers = itertools.count(1)

    def seal(self, where: str, attachment: bytes, data: bytes) -> tuple[bytes, bytes]:
        """Return payload and attachment of a packet sent by the key ``where``; the attachment is only authenticated."""
        trailer = _TRAILER.pack(self.generation, next(self._numbers))
        attachment += trailer
        return self._cipher.encrypt(trailer, data, _bound(where, attachment)), attachment


class Open:
    """Opens packets that the other end's :class:`Seal` sealed, each only once. Any thread."""

    tag = TAG  #: bytes that sealing adds to a payload
    trailer = TRAILER  #: number of bytes that sealing adds to an attachment

    def __init__(self) -> None:
        self._ciphers: dict[int, ChaCha20Poly1305] = {}
        self._windows: dict[tuple[str, int], ReplayWindow] = {}  # only keys that have opened an authentic packet

    def use(self, key: bytes, generation: int = 0) -> Open:
        """Also open packets that were sealed with this key. Only the newest :data:`GENERATIONS` keys are kept."""
        self._ciphers = dict(sorted([*self._ciphers.items(), (generation, _cipher(key))])[-GENERATIONS:])
        self._windows = {at: window for at, window in self._windows.items() if at[1] in self._ciphers}
        return self

    def open(self, where: str, attachment: bytes, payload: bytes) -> tuple[bytes, bytes] | None:
        """Return the packet and its attachment; None if the packet is a repeat or can't be opened yet.

        Raises :class:`DecodeError` if the packet did not come from the other end.
        """
        trailer = attachment[-TRAILER:]
        if len(trailer) < TRAILER:
            raise DecodeError("it is not sealed")
        generation, number = _TRAILER.unpack(trailer)
        cipher = self._ciphers.get(generation)
        if cipher is None:
            if generation > max(self._ciphers, default=0):
                return None  # the key has not arrived yet
            raise DecodeError(f"it is sealed with an outdated key, of generation {generation}")
        try:
            data = cipher.decrypt(trailer, payload, _bound(where, attachment))
        except (_forged(), ValueError):
            raise DecodeError("it was not sealed by the other end, or was changed on the way") from None
        window = self._windows.get((where, generation))
        if window is None:
            window = self._windows.setdefault((where, generation), ReplayWindow())
        return (data, attachment[:-TRAILER]) if window.is_new(number) else None


def contents(opener: Plain | Open, sample: zenoh.Sample) -> tuple[bytes, bytes] | None:
    """Open a sample like :meth:`Open.open`, but don't copy a sample that is too large, and refuse an empty one."""
    payload, attachment = packets.contents(sample, MAX_PACKET + opener.tag)
    opened = opener.open(str(sample.key_expr), attachment, payload)
    if opened is not None and not 0 < len(opened[0]) <= MAX_PACKET:
        raise DecodeError(f"a packet of {len(opened[0])} bytes")
    return opened


class ReplayWindow:
    """Keeps track of the numbers received, as in IPsec (RFC 4303).

    Each number is new only once. A number that is :data:`WIDTH` or more behind the newest is never new. Thread-safe.
    """

    def __init__(self) -> None:
        self._newest = 0
        self._seen = 0  # one bit per number, from the newest number down
        self._lock = threading.Lock()

    def is_new(self, number: int) -> bool:
        """Return whether a number is new, and remember it."""
        with self._lock:
            ahead = number - self._newest
            if ahead > 0:
                self._seen = (self._seen << ahead | 1) & _MASK if ahead < WIDTH else 1
                self._newest = number
                return True
            if -ahead >= WIDTH or self._seen >> -ahead & 1:
                return False
            self._seen |= 1 << -ahead
            return True


class TopicSeal:
    """Seals packets for all of a proxy's applications. The key changes when an application is excluded."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.newest = Seal(os.urandom(KEY_BYTES), 1)
        self._in_use = self.newest
        self._since = 0.0

    def renew(self) -> None:
        """Create a new key, :attr:`newest`, for all remaining applications. It takes effect after :data:`SWITCH_S`.

        A pending switch is not delayed by another one, because otherwise the application that was excluded first could
        continue to read. Applications that stay may therefore miss packets until the newer key arrives.
        """
        if self._in_use is self.newest:
            self._since = self._clock() + SWITCH_S
        self.newest = Seal(os.urandom(KEY_BYTES), self.newest.generation + 1)

    def seal(self, where: str, attachment: bytes, data: bytes) -> tuple[bytes, bytes]:
        """Seal with the key currently in use; see :meth:`Seal.seal`."""
        if self._in_use is not self.newest and self._clock() >= self._since:
            self._in_use = self.newest
        return self._in_use.seal(where, attachment, data)


def _cipher(key: bytes) -> ChaCha20Poly1305:
    from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305  # imported only if keys are used

    return ChaCha20Poly1305(key)


def _forged() -> type[Exception]:
    from cryptography.exceptions import InvalidTag

    return InvalidTag


def _bound(where: str, attachment: bytes) -> bytes:
    """Return the bytes that are authenticated along with the payload.

    Keys contain no zero byte, so no byte can be shifted from one part to the other.
    """
    return where.encode() + b"\0" + attachment


Sealer: TypeAlias = Plain | Seal | TopicSeal
Opener: TypeAlias = Plain | Open
_MASK: Final = (1 << WIDTH) - 1
