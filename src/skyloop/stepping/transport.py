"""A single-threaded transport: each packet reaches the other end before anything else happens."""

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
    ClientHandler,
    Peer,
    Pixels,
    ServerHandler,
    TransportClient,
    TransportServer,
    check_frame,
    check_packet,
    check_topic,
    video,
)

Job = Callable[[], None]
_log = logging.getLogger("skyloop")


class StepExecutor:
    """A thread that runs everything except the application's own code, in the order in which it was posted."""

    def __init__(self, name: str) -> None:
        """Start the thread."""
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def is_current(self) -> bool:
        """Whether this is the executor's thread."""
        return threading.current_thread() is self._thread

    def post(self, job: Job) -> None:
        """Queue a job, whose exceptions are logged."""
        self._jobs.put(job)

    def call(self, job: Job, interrupt: Job) -> None:
        """Queue a job and wait until it has returned; its exceptions are raised here.

        After Ctrl-C ``interrupt`` is called on this thread, to make the job return.
        """
        done = threading.Lock()
        done.acquire()
        raised: list[BaseException] = []

        def run() -> None:
            try:
                job()
            except BaseException as error:  # noqa: BLE001  (raised again on the calling thread)
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

    def run_pending(self) -> None:
        """Run all posted jobs, including those they post themselves. Call this only on the executor's thread."""
        while True:
            try:
                job = self._jobs.get_nowait()
            except Empty:
                return
            if job is None:
                self._jobs.put(None)
                return
            _run_logged(job)

    def close(self) -> None:
        """Run the remaining jobs, then end the thread. Idempotent."""
        self._jobs.put(None)
        if not self.is_current:
            self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            _run_logged(job)


def _run_logged(job: Job) -> None:
    try:
        job()
    except Exception:  # noqa: BLE001  (the next step may work)
        _log.exception("a step of a replay failed")


ADDRESS: Final = "this process, in step with one application"


class SteppedServer(TransportServer):
    """The proxy's end, which serves one client at a time. Handlers are called on the executor's thread."""

    def __init__(self, executor: StepExecutor) -> None:
        self._executor = executor
        self._handler: ServerHandler | None = None
        self._client: SteppedClient | None = None
        self._number = 0

    def dial(self, handler: ClientHandler) -> TransportClient:
        """Connect a client, whose handler runs on the executor's thread; LinkError for a second or after a stop."""
        server = self._handler
        if server is None:
            raise LinkError("the replay has ended")
        if self._client is not None:
            raise LinkError("a replay with speed=max is in step with one application, which is already connected")
        self._number += 1
        peer = Peer(self._number, "this process")
        client = self._client = SteppedClient(self, self._executor, peer, handler)
        self._executor.post(lambda: server.peer_joined(peer))
        return client

    def start(self, handler: ServerHandler) -> None:
        if self._handler is not None:
            raise UsageError("the replay is already being served")
        self._handler = handler

    def stop(self) -> None:
        client = self._client
        if client is not None:
            self.drop(client, "the replay has ended")
        self._handler = None

    def send(self, peer: Peer, packet: bytes) -> bool:
        check_packet(packet)
        client = self._client
        if client is None or client.peer.id != peer.id:
            return False
        self._executor.post(lambda: client.packet(packet))
        return True

    def publish(self, topic: str, packet: bytes) -> int:
        check_packet(packet)
        client = self._client
        if client is not None and topic in client.topics:
            self._executor.post(lambda: client.packet(packet))
        return 0

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        check_frame(header, pixels)
        client = self._client
        if client is not None and video(header.camera) in client.topics:
            copy = np.frombuffer(pixels.tobytes(), np.uint8)
            self._executor.post(lambda: client.frame(header, copy))
        return 0

    def subscribers(self, topic: str) -> int:
        client = self._client
        return int(client is not None and topic in client.topics)

    def disconnect(self, peer: Peer, reason: str) -> None:
        client = self._client
        if client is not None and client.peer.id == peer.id:
            self.drop(client, reason)

    @property
    def address(self) -> str:
        return ADDRESS

    def receive(self, peer: Peer, packet: bytes) -> None:
        """Handle a packet from the client. Call this only on the executor's thread."""
        if self._handler is not None:
            self._handler.packet(peer, packet)

    def drop(self, client: SteppedClient, reason: str) -> None:
        """End a connection once; each end's handler is called after all earlier packets have been delivered."""
        if self._client is not client:
            return
        self._client = None
        handler = self._handler

        def notify() -> None:
            if handler is not None:
                handler.peer_left(client.peer, reason)
            client.ended(reason)

        self._executor.post(notify)


class SteppedClient(TransportClient):
    """The client's end."""

    def __init__(self, server: SteppedServer, executor: StepExecutor, peer: Peer, handler: ClientHandler) -> None:
        self.peer = peer
        self.topics: set[str] = set()
        self._server = server
        self._executor = executor
        self._handler = handler
        self._closing = False
        self._closed = threading.Event()

    def send(self, packet: bytes) -> bool:
        check_packet(packet)
        if self._closing or self._closed.is_set():
            return False
        self._executor.post(lambda: self._server.receive(self.peer, packet))
        return True

    def subscribe(self, topic: str, on: bool = True) -> None:
        check_topic(topic)
        if on:
            self.topics.add(topic)
        else:
            self.topics.discard(topic)

    def close(self) -> None:
        self._closing = True
        self._server.drop(self, "closed by the application")
        if not self._executor.is_current:
            self._closed.wait()

    @property
    def same_clock(self) -> bool:
        return True

    @property
    def address(self) -> str:
        return ADDRESS

    # On the executor's thread -------------------------------------------------------------------------------------

    def packet(self, packet: bytes) -> None:
        """Deliver a packet from the server."""
        if not self._closing:
            self._handler.packet(packet)

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:  # noqa: ARG002
        """Deliver a frame from the server."""
        if not self._closing:
            self._handler.frame(header, pixels)

    def ended(self, reason: str) -> None:
        """Tell the handler once that the connection has ended."""
        self._handler.closed(reason)
        self._closed.set()
