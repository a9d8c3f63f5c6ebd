"""A transport within one thread: what one end sends, the other has before anything else happens."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Final

import numpy as np

from skyloop.errors import LinkError, UsageError
from skyloop.messages import FrameHeader
from skyloop.transport.base import (
    ClientEnd,
    ClientHandler,
    Peer,
    Pixels,
    ServerEnd,
    ServerHandler,
    check_frame,
    check_packet,
    check_topic,
    video,
)

Job = Callable[[], None]
ADDRESS: Final = "this process, in step with one application"
_log = logging.getLogger("skyloop")


class World:
    """One thread on which everything happens but what the application does, in the order in which it was asked for."""

    def __init__(self, name: str) -> None:
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def here(self) -> bool:
        """Whether this is its thread."""
        return threading.current_thread() is self._thread

    def post(self, job: Job) -> None:
        """Do it after what was asked for before. It must not raise."""
        self._jobs.put(job)

    def call(self, job: Job, interrupt: Job) -> None:
        """Do it, and wait until it is done; what it raises comes out here. ``interrupt`` is to end it on Ctrl-C."""
        done = threading.Lock()
        done.acquire()
        raised: list[BaseException] = []

        def run() -> None:
            try:
                job()
            except BaseException as error:  # noqa: BLE001  (it comes out where it was asked for)
                raised.append(error)
            finally:
                done.release()

        self.post(run)
        try:
            done.acquire()
        except BaseException:  # Ctrl-C
            interrupt()
            done.acquire()
            raise
        if raised:
            raise raised[0]

    def settle(self) -> None:
        """Do all that is still to be done, and what follows from it. On its thread."""
        while True:
            try:
                job = self._jobs.get_nowait()
            except Empty:
                return
            if job is None:
                self._jobs.put(None)
                return
            _do(job)

    def end(self) -> None:
        """End the thread after what was asked for before. Idempotent."""
        self._jobs.put(None)
        if not self.here:
            self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            _do(job)


def _do(job: Job) -> None:
    try:
        job()
    except Exception:  # noqa: BLE001  (the next step may work)
        _log.exception("a step of a replay failed")


class InStepServer(ServerEnd):
    """A proxy's end, for one application at a time. Handlers are called on the world's thread."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._handler: ServerHandler | None = None
        self._client: InStepClient | None = None
        self._number = 0

    def dial(self, handler: ClientHandler) -> ClientEnd:
        """Connect. Raises :class:`LinkError` for a second application, and after the end."""
        server = self._handler
        if server is None:
            raise LinkError("the replay has ended")
        if self._client is not None:
            raise LinkError(
                "a replay with speed=max is in step with one application, and that one is connected already"
            )
        self._number += 1
        peer = Peer(self._number, "this process")
        client = self._client = InStepClient(self, self._world, peer, handler)
        self._world.post(lambda: server.peer_joined(peer))
        return client

    def start(self, handler: ServerHandler) -> None:
        if self._handler is not None:
            raise UsageError("the replay is served already")
        self._handler = handler

    def stop(self) -> None:
        client = self._client
        if client is not None:
            self.part(client, "the replay has ended")
        self._handler = None

    def send(self, peer: Peer, packet: bytes) -> bool:
        check_packet(packet)
        client = self._client
        if client is None or client.peer.id != peer.id:
            return False
        self._world.post(lambda: client.packet(packet))
        return True

    def publish(self, topic: str, packet: bytes) -> int:
        check_packet(packet)
        client = self._client
        if client is not None and topic in client.topics:
            self._world.post(lambda: client.packet(packet))
        return 0

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        check_frame(header, pixels)
        client = self._client
        if client is not None and video(header.camera) in client.topics:
            copy = np.frombuffer(pixels.tobytes(), np.uint8)
            self._world.post(lambda: client.frame(header, copy))
        return 0

    def subscribers(self, topic: str) -> int:
        client = self._client
        return int(client is not None and topic in client.topics)

    def disconnect(self, peer: Peer, reason: str) -> None:
        client = self._client
        if client is not None and client.peer.id == peer.id:
            self.part(client, reason)

    @property
    def address(self) -> str:
        return ADDRESS

    def received(self, peer: Peer, packet: bytes) -> None:
        """A packet of the application. On the world's thread."""
        if self._handler is not None:
            self._handler.packet(peer, packet)

    def part(self, client: InStepClient, reason: str) -> None:
        """End the connection, once; each end is told after what was sent before."""
        if self._client is not client:
            return
        self._client = None
        handler = self._handler

        def tell() -> None:
            if handler is not None:
                handler.peer_left(client.peer, reason)
            client.ended(reason)

        self._world.post(tell)


class InStepClient(ClientEnd):
    """An application's end."""

    def __init__(self, server: InStepServer, world: World, peer: Peer, handler: ClientHandler) -> None:
        self.peer = peer
        self.topics: set[str] = set()
        self._server = server
        self._world = world
        self._handler = handler
        self._closing = False
        self._told = threading.Event()

    def send(self, packet: bytes) -> bool:
        check_packet(packet)
        if self._closing or self._told.is_set():
            return False
        self._world.post(lambda: self._server.received(self.peer, packet))
        return True

    def subscribe(self, topic: str, on: bool = True) -> None:
        check_topic(topic)
        if on:
            self.topics.add(topic)
        else:
            self.topics.discard(topic)

    def close(self) -> None:
        self._closing = True
        self._server.part(self, "closed by the application")
        if not self._world.here:
            self._told.wait()

    @property
    def same_clock(self) -> bool:
        return True

    @property
    def address(self) -> str:
        return ADDRESS

    # On the world's thread -------------------------------------------------------------------------------------

    def packet(self, packet: bytes) -> None:
        if not self._closing:
            self._handler.packet(packet)

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:  # noqa: ARG002
        if not self._closing:
            self._handler.frame(header, pixels)

    def ended(self, reason: str) -> None:
        self._handler.closed(reason)
        self._told.set()
