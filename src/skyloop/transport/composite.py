"""Several server ends as one: a proxy that is reached on its host and over the network at the same time."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from skyloop.errors import UsageError
from skyloop.messages import FrameHeader
from skyloop.transport.base import Peer, Pixels, ServerEnd, ServerHandler, check_packet


class _Place(NamedTuple):
    """Which end an application came by, and who it is there."""

    end: ServerEnd
    peer: Peer


class CompositeServer(ServerEnd):
    """One server end made of several, the nearest first. Its peers are numbered over all of them.

    The ends take turns at the handler, so that it is called by one at a time as the contract says.
    """

    def __init__(self, ends: Sequence[ServerEnd]) -> None:
        if not ends:
            raise UsageError("a server end of several needs at least one")
        self._ends = tuple(ends)
        self._turn = threading.RLock()  # whoever has it may call the handler
        self._in_turn = 0  # identity of the thread that has it
        self._places: dict[int, _Place] = {}  # by our number
        self._last_id = 0

    def start(self, handler: ServerHandler) -> None:
        """Begin to accept at all ends, or at none."""
        started: list[ServerEnd] = []
        try:
            for end in self._ends:
                end.start(_Door(self, end, handler))
                started.append(end)
        except BaseException:
            for end in reversed(started):
                end.stop()
            raise

    def stop(self) -> None:
        threads = [threading.Thread(target=end.stop, name="skyloop-stop", daemon=True) for end in self._ends]
        for thread in threads:
            thread.start()
        if self._in_turn != threading.get_ident():  # else an end would wait for a turn that its stopper has
            for thread in threads:
                thread.join()

    def send(self, peer: Peer, packet: bytes) -> bool:
        place = self._places.get(peer.id)
        if place is None:
            check_packet(packet)
            return False
        return place.end.send(place.peer, packet)

    def publish(self, topic: str, packet: bytes) -> int:
        return sum(end.publish(topic, packet) for end in self._ends)

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        return sum(end.publish_frame(header, pixels) for end in self._ends)

    def subscribers(self, topic: str) -> int:
        return sum(end.subscribers(topic) for end in self._ends)

    def disconnect(self, peer: Peer, reason: str) -> None:
        place = self._places.get(peer.id)
        if place is not None:
            place.end.disconnect(place.peer, reason)

    @property
    def address(self) -> str:
        return ", ".join(end.address for end in self._ends)

    def enter(self, end: ServerEnd, peer: Peer) -> Peer:
        """A number of ours for somebody who came by this end. In turn."""
        self._last_id += 1
        ours = Peer(self._last_id, peer.address)
        self._places[ours.id] = _Place(end, peer)
        return ours

    def leave(self, peer: Peer) -> None:
        """Forget the number. In turn."""
        self._places.pop(peer.id, None)

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Only one end at a time calls the handler."""
        with self._turn:
            self._in_turn = threading.get_ident()
            try:
                yield
            finally:
                self._in_turn = 0


class _Door:
    """The handler of one end: passes on in turn, with peers as the whole knows them."""

    def __init__(self, whole: CompositeServer, end: ServerEnd, handler: ServerHandler) -> None:
        self._whole = whole
        self._end = end
        self._handler = handler
        self._peers: dict[int, Peer] = {}  # ours, by the end's number

    def peer_joined(self, peer: Peer) -> None:
        with self._whole.turn():
            ours = self._peers[peer.id] = self._whole.enter(self._end, peer)
            self._handler.peer_joined(ours)

    def packet(self, peer: Peer, packet: bytes) -> None:
        with self._whole.turn():
            self._handler.packet(self._peers[peer.id], packet)

    def refused(self, peer: Peer, reason: str) -> None:
        with self._whole.turn():
            self._handler.refused(self._peers.get(peer.id, peer), reason)

    def peer_left(self, peer: Peer, reason: str) -> None:
        with self._whole.turn():
            ours = self._peers.pop(peer.id)
            self._whole.leave(ours)
            self._handler.peer_left(ours, reason)
