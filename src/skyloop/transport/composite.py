"""Combine several transport servers into one, for a proxy that serves its own host and the network at the same time."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from skyloop.errors import UsageError
from skyloop.messages import FrameHeader
from skyloop.transport.base import Peer, Pixels, ServerHandler, TransportServer, check_packet
from skyloop.transport.priority import PriorityLock, is_command


class CompositeServer(TransportServer):
    """One transport server that combines several, nearest first. The server assigns its own numbers to their peers.

    The handler gets one call at a time, as the contract requires: commands first, all others in order of arrival.
    """

    def __init__(self, ends: Sequence[TransportServer]) -> None:
        if not ends:
            raise UsageError("a composite transport server needs at least one end")
        self._ends = tuple(ends)
        self.lock = PriorityLock()  #: a thread must hold this lock to call the handler
        # By our number for an application: the end that it is connected to, and its peer at that end.
        self._members: dict[int, tuple[TransportServer, Peer]] = {}
        self._last_id = 0

    def start(self, handler: ServerHandler) -> None:
        """Start accepting connections at all ends. If one end's ``start`` raises, stop the ends that have started."""
        started: list[TransportServer] = []
        try:
            for end in self._ends:
                end.start(_EndHandler(self, end, handler))
                started.append(end)
        except BaseException:
            for end in reversed(started):
                end.stop()
            raise

    def stop(self) -> None:
        """Stop all ends at the same time, and wait for them unless this is called from a handler."""
        threads = [threading.Thread(target=end.stop, name="skyloop-stop", daemon=True) for end in self._ends]
        for thread in threads:
            thread.start()
        if not self.lock.held:  # otherwise an end would wait for the lock that this thread holds
            for thread in threads:
                thread.join()

    def send(self, peer: Peer, packet: bytes) -> bool:
        member = self._members.get(peer.id)
        if member is None:
            check_packet(packet)
            return False
        end, theirs = member
        return end.send(theirs, packet)

    def publish(self, topic: str, packet: bytes) -> int:
        return sum(end.publish(topic, packet) for end in self._ends)

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        return sum(end.publish_frame(header, pixels) for end in self._ends)

    def subscribers(self, topic: str) -> int:
        return sum(end.subscribers(topic) for end in self._ends)

    def admit(self, peer: Peer, *, pilot: bool) -> str:
        member = self._members.get(peer.id)
        return "" if member is None else member[0].admit(member[1], pilot=pilot)

    def disconnect(self, peer: Peer, reason: str) -> None:
        if (member := self._members.get(peer.id)) is not None:
            member[0].disconnect(member[1], reason)

    @property
    def counters(self) -> dict[str, float]:
        total: dict[str, float] = {}
        for end in self._ends:
            for name, count in end.counters.items():
                total[name] = total.get(name, 0) + count
        return total

    @property
    def restricted(self) -> bool:
        return any(end.restricted for end in self._ends)

    @property
    def address(self) -> str:
        return ", ".join(end.address for end in self._ends)

    def enter(self, end: TransportServer, peer: Peer) -> Peer:
        """Give an end's peer a number of this server; return it as the handler knows it. The caller holds the lock."""
        self._last_id += 1
        ours = Peer(self._last_id, peer.address)
        self._members[ours.id] = end, peer
        return ours

    def leave(self, peer: Peer) -> None:
        """Forget a peer of this server. The caller holds the lock."""
        self._members.pop(peer.id, None)


class _EndHandler:
    """The handler for one end. It calls the composite's handler with the composite's peers, under its lock."""

    def __init__(self, whole: CompositeServer, end: TransportServer, handler: ServerHandler) -> None:
        self._whole = whole
        self._lock = whole.lock
        self._end = end
        self._handler = handler
        self._peers: dict[int, Peer] = {}  # our peers, by the numbers that the end assigned

    def peer_joined(self, peer: Peer) -> None:
        with self._lock:
            ours = self._peers[peer.id] = self._whole.enter(self._end, peer)
            self._handler.peer_joined(ours)

    def packet(self, peer: Peer, packet: bytes) -> None:
        self._lock.acquire(is_command(packet))
        try:
            self._handler.packet(self._peers[peer.id], packet)
        finally:
            self._lock.release()

    def refused(self, peer: Peer, reason: str) -> None:
        with self._lock:
            self._handler.refused(self._peers.get(peer.id, peer), reason)

    def topic_problem(self, topic: str) -> str:
        return self._handler.topic_problem(topic)

    def malformed(self, peer: Peer, reason: str) -> None:
        with self._lock:
            self._handler.malformed(self._peers[peer.id], reason)

    def peer_left(self, peer: Peer, reason: str) -> None:
        with self._lock:
            ours = self._peers.pop(peer.id)
            self._whole.leave(ours)
            self._handler.peer_left(ours, reason)
