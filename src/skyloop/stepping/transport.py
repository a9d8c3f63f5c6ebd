"""A single-threaded transport in simulated time: each packet reaches the other end before anything else happens.

Time advances while the application waits and stops while the application's code runs.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Final, Protocol

import numpy as np

from skyloop.client.channels import Notifier
from skyloop.client.connection import ConnectionSupervisor, ProxyConnection, Scheduler
from skyloop.clock import NS_PER_S, ManualClock, nanoseconds
from skyloop.errors import LinkError, UsageError
from skyloop.messages import FrameHeader, LinkState
from skyloop.proxy.core.autopilot import PERIOD_S
from skyloop.proxy.proxy import Proxy
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
    """A thread that runs everything except the application's own code, in the order in which it is posted."""

    def __init__(self, name: str) -> None:
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def is_current(self) -> bool:
        """Whether this is the executor's thread."""
        return threading.current_thread() is self._thread

    def post(self, job: Job) -> None:
        """Queue a job; exceptions that it raises are logged."""
        self._jobs.put(job)

    def call(self, job: Job, interrupt: Job) -> None:
        """Queue a job and wait until it has returned; exceptions of the job are raised here.

        If Ctrl-C is pressed, ``interrupt`` is called on this thread to make the job return.
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
        """Run all posted jobs, including jobs that they post. Call this only on the executor's thread."""
        while True:
            try:
                job = self._jobs.get_nowait()
            except Empty:
                return
            if job is None:
                self._jobs.put(None)  # which ends the thread later
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
    except Exception:  # noqa: BLE001 (the next step may succeed)
        _log.exception("a step in simulated time failed")


ADDRESS: Final = "this process, in step with one application"


class SteppedServer(TransportServer):
    """The proxy's side, which serves one client at a time. Handlers are called on the executor's thread."""

    def __init__(self, executor: StepExecutor) -> None:
        self._executor = executor
        self._handler: ServerHandler | None = None
        self._client: SteppedClient | None = None
        self._number = 0

    def dial(self, handler: ClientHandler) -> TransportClient:
        """Connect the only client; its handler runs on the executor's thread.

        Raises LinkError if a client is connected already, or the server has been stopped.
        """
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
        """End a connection that has not ended yet; each side's handler is called after all earlier packets."""
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
    """The client's side of the transport."""

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
        """Notify the handler, only once, that the connection has ended."""
        self._handler.closed(reason)
        self._closed.set()


AFTER_NS: Final = 60 * NS_PER_S  #: a wait without a time limit gives up this long after the end of the recording
_TICK_NS: Final = nanoseconds(PERIOD_S)
_NEVER_NS: Final = 1 << 62  # later than any time of the clock


class StepSource(Protocol):
    """The events that drive simulated time: a recording's samples or a simulated world's steps."""

    @property
    def due_ns(self) -> int | None:
        """Time at which the next event is due; None after the last one."""

    def step(self) -> None:
        """Publish the sample or run the step that is due now."""


class StepScheduler(Scheduler):
    """Simulated time, which advances only while the application waits."""

    in_step = True

    def __init__(
        self,
        clock: ManualClock,
        executor: StepExecutor,
        proxy: Proxy,
        source: Callable[[], StepSource | None],
        begin_ns: int,
    ) -> None:
        """Set up simulated time; ``source`` returns the source of samples or steps, or None while there is none."""
        super().__init__(clock)
        self._time = clock
        self._executor = executor
        self._proxy = proxy
        self._source = source
        self._begin_ns = begin_ns
        self._supervisor: ConnectionSupervisor | None = None
        self._supervisor_due_ns = 0
        self._tick_due_ns = clock.now_ns
        self._begun = False  # whether the application is connected and the recording has started
        self._end_ns = _NEVER_NS
        self._turn = threading.Lock()  # held by the thread that is currently advancing time
        self._interrupted = False

    def notifier(self) -> Notifier:
        return StepNotifier(self)

    def sample_notifier(self, connection: ProxyConnection) -> Notifier:  # noqa: ARG002
        return StepNotifier(self)

    def begin(self, supervisor: ConnectionSupervisor) -> None:
        self._supervisor = supervisor

    def opened(self) -> None:
        """Advance to the recording's start and start publishing its samples."""
        self.wait_for(lambda: False, (self._begin_ns - self._time.now_ns) / NS_PER_S, lambda: False)
        self._begun = True

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None, sleep: Callable[[], bool]) -> bool:
        """Advance simulated time until ``ready()``, evaluated on the executor's thread after each step, is true.

        If another thread is already advancing time, the calling thread just waits in ``sleep()``, in real time. The
        limit is in simulated time; None means wait until 60 s after the end of the recording. Raises UsageError on the
        executor's thread, for example in an inline callback.
        """
        if self._executor.is_current:
            raise UsageError("a callback can't wait for the next sample: time does not advance until it returns")
        if not self._turn.acquire(blocking=False):
            return sleep()
        try:
            until_ns = _NEVER_NS if timeout_s is None else self._time.now_ns + nanoseconds(max(0.0, timeout_s))
            found: list[bool] = []
            self._interrupted = False
            self._executor.call(lambda: found.append(self._advance(ready, until_ns)), self._interrupt)
            return found[0]
        finally:
            self._turn.release()

    # On the executor's thread -------------------------------------------------------------------------------------

    def _advance(self, ready: Callable[[], bool], until_ns: int) -> bool:
        self._executor.run_pending()
        while not ready():
            if self._interrupted or not self._step(until_ns):
                return ready()
            self._executor.run_pending()
        return True

    def _step(self, until_ns: int) -> bool:
        """Process the next event; return False if there is none, or if it is due later than the given time."""
        supervisor, steps, time = self._supervisor, self._source(), self._time
        if supervisor is not None and (supervisor.connection.poked or self._supervisor_due_ns <= time.now_ns):
            self._attend(supervisor)
            return True
        recorded_ns = steps.due_ns if self._begun and steps is not None else None
        due_ns = min(self._tick_due_ns, self._supervisor_due_ns if supervisor is not None else _NEVER_NS)
        if recorded_ns is not None:
            due_ns = min(due_ns, recorded_ns)
        elif self._begun and self._end_ns == _NEVER_NS:
            self._end_ns = time.now_ns + AFTER_NS
        if due_ns > min(until_ns, self._end_ns):
            time.now_ns = max(time.now_ns, min(until_ns, self._end_ns))
            return False
        time.now_ns = max(time.now_ns, due_ns)
        if recorded_ns == due_ns and steps is not None:
            steps.step()
        elif self._tick_due_ns == due_ns:
            self._tick_due_ns += _TICK_NS
            self._proxy.tick(time.now_ns)
        elif supervisor is not None:
            self._attend(supervisor)
        return True

    def _attend(self, supervisor: ConnectionSupervisor) -> None:
        if supervisor.connection.state is LinkState.CLOSED:
            self._supervisor = None
            return
        pause_s = supervisor.attend()
        self._supervisor_due_ns = self._time.now_ns + max(1, nanoseconds(pause_s))

    def _interrupt(self) -> None:
        self._interrupted = True


class StepNotifier(Notifier):
    """A notifier whose waits advance simulated time."""

    __slots__ = ("_scheduler",)

    def __init__(self, scheduler: StepScheduler) -> None:
        super().__init__()
        self._scheduler = scheduler

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until ``ready()``, evaluated after each step, is true; return whether it became true in time."""
        return ready() or self._scheduler.wait_for(
            ready, timeout_s, lambda: super(StepNotifier, self).wait_for(ready, timeout_s)
        )
