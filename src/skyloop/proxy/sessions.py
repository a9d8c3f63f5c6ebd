"""What the proxy remembers of one application's connection."""

from __future__ import annotations

from collections import deque
from typing import Final

from skyloop.clock import NS_PER_S
from skyloop.messages import Role
from skyloop.proxy.core.intents import Intents
from skyloop.proxy.events import Episodes
from skyloop.transport.base import Peer

#: More malformed packets than this within a second restart the channel: its two ends no longer speak the same.
MAX_MALFORMED: Final = 50
#: How long a connection may be there without its Hello, which a client sends at once.
HELLO_NS: Final = 5 * NS_PER_S

MAX_KEPT: Final = 32  #: answers kept for repeats, per connection: a client repeats a request for seconds at most


class Answers:
    """Which requests of one connection are being answered, and the answers kept for repeats. Not thread-safe."""

    __slots__ = ("_forgotten", "_kept", "_pending")

    def __init__(self) -> None:
        self._pending: set[int] = set()
        self._kept: dict[int, bytes] = {}
        self._forgotten = 0  # the highest number whose answer was kept and dropped again

    @property
    def pending(self) -> int:
        """How many requests are being answered."""
        return len(self._pending)

    def repeats(self, number: int) -> bool:
        """Whether this request was carried out, or is being carried out, and must not be again."""
        return number in self._pending or number in self._kept or number <= self._forgotten

    def kept(self, number: int) -> bytes | None:
        """Return the answer kept for repeats of this request; None: there is none (yet)."""
        return self._kept.get(number)

    def begin(self, number: int) -> None:
        """Note that this request is being answered."""
        self._pending.add(number)

    def end(self, number: int, answer: bytes | None) -> None:
        """Note that this request is answered; ``answer`` is kept for repeats. None: it may be carried out again."""
        self._pending.discard(number)
        if answer is None:
            return
        self._kept[number] = answer
        if len(self._kept) > MAX_KEPT:
            oldest = next(iter(self._kept))
            del self._kept[oldest]
            self._forgotten = max(self._forgotten, oldest)


class Session:
    """One application's connection, from joining to leaving. ``role`` is None until its Hello."""

    __slots__ = (
        "_malformed_ns",
        "answers",
        "app_id",
        "authority_request",
        "ended",
        "episodes",
        "intents",
        "joined_ns",
        "name",
        "peer",
        "role",
    )

    def __init__(self, peer: Peer, joined_ns: int) -> None:
        self.peer = peer
        self.joined_ns = joined_ns
        self.app_id = peer.id
        self.name = f"application {peer.id}"  #: until Hello has it
        self.role: Role | None = None
        self.intents = Intents()
        self.episodes = Episodes()
        self.answers = Answers()
        self.authority_request = 0  #: number of the newest request for the authority, or of its release
        self.ended = False  #: disconnected by the proxy: nothing more is taken from it
        self._malformed_ns: deque[int] = deque(maxlen=MAX_MALFORMED)

    def malformed(self, now_ns: int) -> bool:
        """Count a malformed packet; returns whether that is one too many within a second."""
        recent = self._malformed_ns
        too_many = len(recent) == MAX_MALFORMED and now_ns - recent[0] < NS_PER_S
        recent.append(now_ns)
        return too_many
