"""What the proxy remembers of one application's connection."""

from __future__ import annotations

from collections import deque
from typing import Final

from skyloop.clock import NS_PER_S
from skyloop.messages import Role
from skyloop.proxy.core.intents import Intents
from skyloop.proxy.core.limits import Episodes
from skyloop.transport.base import Peer

#: More malformed packets than this within a second restart the channel: its two ends no longer speak the same.
MAX_MALFORMED: Final = 50
#: How long a connection may be there without its Hello, which a client sends at once.
HELLO_NS: Final = 5 * NS_PER_S


class Session:
    """One application's connection, from joining to leaving. ``role`` is None until its Hello."""

    __slots__ = (
        "_malformed_ns",
        "app_id",
        "ended",
        "episodes",
        "intents",
        "joined_ns",
        "name",
        "peer",
        "pending",
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
        self.pending = 0  #: requests that wait for the worker
        self.ended = False  #: disconnected by the proxy: nothing more is taken from it
        self._malformed_ns: deque[int] = deque(maxlen=MAX_MALFORMED)

    def malformed(self, now_ns: int) -> bool:
        """Count a malformed packet; returns whether that is one too many within a second."""
        recent = self._malformed_ns
        too_many = len(recent) == MAX_MALFORMED and now_ns - recent[0] < NS_PER_S
        recent.append(now_ns)
        return too_many
