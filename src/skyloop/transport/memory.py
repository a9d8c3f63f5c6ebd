"""The transport within one process, for tests, and for a proxy and an application that share a process.

It fulfils the whole contract of :mod:`skyloop.transport.base`, including receiving threads and bounded queues. Code
that works with it therefore works with other transports. :class:`Faults` makes it lose, repeat, reorder and damage
packets and frames, identically for the same seed.
"""

from __future__ import annotations

import itertools
import logging
import threading
from collections import deque
from collections.abc import Callable
from queue import SimpleQueue

import numpy as np

from skyloop.errors import LinkError, UsageError
from skyloop.faults import FaultInjector, Faults
from skyloop.messages import FrameHeader
from skyloop.transport.base import (
    MAX_SUBSCRIPTIONS,
    ClientHandler,
    Peer,
    Pixels,
    ServerHandler,
    TransportClient,
    TransportServer,
    check_frame,
    check_packet,
    check_topic,
    too_many_topics,
    video,
)

__all__ = ["DEPTH", "FRAME_DEPTH", "Faults", "MemoryClient", "MemoryServer"]

DEPTH = 256  #: maximum number of packets waiting at one end; further packets are dropped
FRAME_DEPTH = 4  #: maximum number of a camera's frames that wait at a client; the newest replaces the previous one

_log = logging.getLogger(__name__)
_Frame = tuple[FrameHeader, Pixels]


#: A client, and a call to the handler that the server's receiving thread makes on the client's behalf.
_Item = tuple["MemoryClient", Callable[[ServerHandler], object]]


class MemoryServer(TransportServer):
    """A proxy's end. :meth:`dial` is its :data:`skyloop.transport.base.Dialer`. It can be restarted after a stop."""

    def __init__(self, name: str = "memory", *, faults: Faults | None = None) -> None:
        self._name = name
        self._faults = faults or Faults()
        self._lock = threading.Lock()  # guards joining and leaving; never held while the handler is called
        self._clients: dict[int, MemoryClient] = {}
        self._ids = itertools.count(1)
        self._inbox: SimpleQueue[_Item | None] = SimpleQueue()
        self._handler: ServerHandler | None = None
        self._thread: threading.Thread | None = None

    def dial(self, handler: ClientHandler) -> MemoryClient:
        """Connect to this server. The server must be running. The handler runs on the client's own receiving thread."""
        with self._lock:
            if self._thread is None:
                raise LinkError(f"{self.address} has no server: start the transport server first")
            client = MemoryClient(self, Peer(next(self._ids), "this process"), handler, self._faults)
            self._clients[client.peer.id] = client
            self._inbox.put((client, lambda handler: handler.peer_joined(client.peer)))
        client.begin()
        return client

    def start(self, handler: ServerHandler) -> None:
        with self._lock:
            if self._thread is not None:
                raise UsageError(f"{self.address} has already been started")
            self._inbox = SimpleQueue()
            self._handler = handler
            name = f"skyloop-{self._name}-server"
            self._thread = threading.Thread(target=self._receive, args=(handler, self._inbox), name=name, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        with self._lock:
            thread, self._thread = self._thread, None
        if thread is None:
            return
        for client in list(self._clients.values()):
            self.end(client, "the proxy stopped", muted=True)
        self._inbox.put(None)
        if thread is not threading.current_thread():
            thread.join()

    def send(self, peer: Peer, packet: bytes) -> bool:
        check_packet(packet)
        client = self._clients.get(peer.id)
        return client is not None and client.deliver(packet)

    def publish(self, topic: str, packet: bytes) -> int:
        check_packet(packet)
        return sum(not client.deliver(packet) for client in self._subscribed(topic))

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        check_frame(header, pixels)
        wanted = self._subscribed(video(header.camera))
        if not wanted:
            return 0
        copy = np.frombuffer(pixels.tobytes(), np.uint8)
        return sum(not client.deliver_frame(header, copy) for client in wanted)

    def subscribers(self, topic: str) -> int:
        return len(self._subscribed(topic))

    def disconnect(self, peer: Peer, reason: str) -> None:
        if (client := self._clients.get(peer.id)) is not None:
            self.end(client, reason, muted=True)

    @property
    def address(self) -> str:
        return f"memory:{self._name}"

    def arrived(self, client: MemoryClient) -> None:
        """Wake the receiving thread for a packet in the client's ``outgoing`` queue."""
        self._inbox.put((client, client.pass_on))

    def may_subscribe(self, client: MemoryClient, topic: str) -> bool:
        """Return whether a client may subscribe to a topic. If not, report a malformed request to the handler."""
        problem = self._handler.topic_problem(topic) if self._handler is not None else ""
        if len(client.topics) >= MAX_SUBSCRIPTIONS:
            problem = problem or too_many_topics(topic)
        if problem:
            self._inbox.put((client, lambda handler: client.report(handler, problem)))
        return not problem

    def end(self, client: MemoryClient, reason: str, *, muted: bool) -> None:
        """End a connection. ``muted``: drop the client's undelivered packets. Idempotent."""
        with self._lock:
            if self._clients.pop(client.peer.id, None) is None:
                return
            client.muted = muted
            client.end(reason)
            self._inbox.put((client, lambda handler: handler.peer_left(client.peer, client.reason)))

    def _subscribed(self, topic: str) -> list[MemoryClient]:
        return [client for client in list(self._clients.values()) if topic in client.topics]

    def _receive(self, handler: ServerHandler, inbox: SimpleQueue[_Item | None]) -> None:
        while (item := inbox.get()) is not None:
            client, call = item
            try:
                call(handler)
            except Exception as error:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the server's handler failed; the connection to %s ends", client.peer.address)
                self.end(client, f"the server's handler failed: {error!r}", muted=True)


class MemoryClient(TransportClient):
    """An application's end of the transport, made by :meth:`MemoryServer.dial`."""

    def __init__(self, server: MemoryServer, peer: Peer, handler: ClientHandler, faults: Faults) -> None:
        self.peer = peer
        self.topics: set[str] = set()
        self.outgoing: deque[bytes] = deque()
        self.muted = False
        self.reason = ""
        self._server = server
        self._handler = handler
        self._up = FaultInjector(faults, f"{peer.id}/up")
        self._down = FaultInjector(faults, f"{peer.id}/down")
        self._up_lock = threading.Lock()
        self._down_lock = threading.Lock()
        # Items: a packet, the name of a camera that has a frame to deliver, or None once the connection has ended.
        self._inbox: SimpleQueue[bytes | str | None] = SimpleQueue()
        self._frames: dict[str, deque[_Frame]] = {}
        self._ended = False  # whether either end has ended the connection, so that nothing more can be sent
        self._closing = False  # whether this end has closed the connection and therefore delivers nothing more
        self._thread = threading.Thread(target=self._receive, name=f"skyloop-memory-client-{peer.id}", daemon=True)

    def begin(self) -> None:
        """Start the receiving thread."""
        self._thread.start()

    def pass_on(self, handler: ServerHandler) -> None:
        """Give the server's handler the next outgoing packet."""
        packet = self.outgoing.popleft()
        if not self.muted:
            handler.packet(self.peer, packet)

    def report(self, handler: ServerHandler, problem: str) -> None:
        """Report a malformed request to the server's handler."""
        if not self.muted:
            handler.malformed(self.peer, problem)

    def send(self, packet: bytes) -> bool:
        check_packet(packet)
        with self._up_lock:
            if self._ended or len(self.outgoing) >= DEPTH:
                return False
            for arriving in self._up.packets(packet):
                self.outgoing.append(arriving)
                self._server.arrived(self)
        return True

    def subscribe(self, topic: str, on: bool = True) -> None:
        check_topic(topic)
        if on:
            if topic not in self.topics and self._server.may_subscribe(self, topic):
                self.topics.add(topic)
        else:
            self.topics.discard(topic)

    def close(self) -> None:
        self._closing = True
        self._server.end(self, "closed by the application", muted=False)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    @property
    def same_clock(self) -> bool:
        return True

    @property
    def address(self) -> str:
        return self._server.address

    def deliver(self, packet: bytes) -> bool:
        """Queue a packet from the server; return False if the connection has ended or the queue is full."""
        with self._down_lock:
            if self._ended or self._inbox.qsize() >= DEPTH:
                return False
            for arriving in self._down.packets(packet):
                self._inbox.put(arriving)
        return True

    def deliver_frame(self, header: FrameHeader, pixels: Pixels) -> bool:
        """Queue a frame from the server. Return False if it replaced another, or if the connection has ended."""
        room = True
        with self._down_lock:
            if self._ended:
                return False
            waiting = self._frames.setdefault(header.camera, deque())
            for frame in self._down.items((header, pixels)):
                if len(waiting) >= FRAME_DEPTH:
                    waiting[-1] = frame
                    room = False
                else:
                    waiting.append(frame)
                    self._inbox.put(header.camera)
        return room

    def end(self, reason: str) -> None:
        """Mark the connection as ended; called once, by the server."""
        with self._up_lock, self._down_lock:
            self._ended = True
            self.reason = reason
            self._inbox.put(None)

    def _receive(self) -> None:
        while (item := self._inbox.get()) is not None:
            if self._closing:
                continue
            try:
                self._deliver_one(item)
            except Exception as error:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the client's handler failed; its connection ends")
                self._closing = True
                self._server.end(self, f"the client's handler failed: {error!r}", muted=False)
        try:
            self._handler.closed(self.reason)
        except Exception:  # noqa: BLE001  (a handler may raise anything)
            _log.exception("the client's handler failed in closed()")

    def _deliver_one(self, item: bytes | str) -> None:
        if isinstance(item, bytes):
            self._handler.packet(item)
            return
        with self._down_lock:
            header, pixels = self._frames[item].popleft()
        self._handler.frame(header, pixels)
