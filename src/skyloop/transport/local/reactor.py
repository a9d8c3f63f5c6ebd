"""One thread that receives for many local transport servers. The others can leave it if one of them blocks it.

A thread per connection (:mod:`skyloop.transport.local.server`) delivers a packet with one system call fewer, which is
better for one vehicle. With a hundred vehicles, however, two hundred threads would wake one another. Here, one thread
waits for all connections (epoll), reads all available packets, and handles one packet of each connection in turn.
Landings and stops come first, then set-points, then all others. Each class gets some turns even if others are busy.

Handlers run on this thread. During a call, :attr:`Reactor.inside` is the handler's server. :attr:`Reactor.entries`
counts the calls, so that a watchdog can detect a call that does not return. It then calls :meth:`Reactor.split`, which
leaves this thread to that server and moves all other servers to a new reactor.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Iterable
from typing import Final

from skyloop.transport.base import MAX_PACKET, ServerHandler
from skyloop.transport.local import packets
from skyloop.transport.local.server import HELLO_S, LocalServer, ServerConnection
from skyloop.transport.local.system import RECEIVE_FLAGS, Listener, StrangerError, serving_side, systems
from skyloop.transport.priority import MOST_PACKETS, Lane, is_command

CHECK_S: Final = 0.5  #: interval between checks of silent connections, and of listeners that could not accept
_AFTER_FAILURE_S: Final = 0.01  # pause after a failed turn
_PAUSE_S: Final = 100e-6  # if a wait took this long, no packet was pending
_PACKETS_PER_POLL: Final = 8  # number of packets handled between checks for new ones
_FIRST_COME: Final = tuple(Lane)
#: Order in which the lanes take turns. Even if something is always urgent, the others each get one turn in four.
_ORDERS: Final = (
    _FIRST_COME,
    (Lane.STEERING, Lane.URGENT, Lane.OTHERS),
    _FIRST_COME,
    (Lane.OTHERS, Lane.URGENT, Lane.STEERING),
)
_THREAD_CHECK_S: Final = 0.1  # interval at which a wait for connections checks whether their thread has ended
_log = logging.getLogger(__name__)


class Source:
    """A socket that a reactor waits for: a server's listener (``sock``) or one of its connections."""

    def __init__(
        self, server: SharedLocalServer, sock: Listener | None = None, connection: ServerConnection | None = None
    ) -> None:
        self.server = server
        self.sock = sock
        self.connection = connection
        self.fileno = sock.fileno() if sock is not None else connection.fileno() if connection is not None else -1
        self.since_s = time.monotonic()
        self.lane: Lane | None = None  #: the lane that the source waits in
        self.ended = False
        self.muted = False  #: whether the source is ignored until the next check


class _Thread(threading.Thread):
    """A reactor's thread, recognised by its type when a handler stops its own server."""


class Reactor:
    """Receives for transport servers on one thread, from construction until :meth:`close`."""

    def __init__(self) -> None:
        self.inside: SharedLocalServer | None = None  #: the server whose handler is running, or may be running
        self.entries = 0  #: number of times that :attr:`inside` was set
        self._lock = threading.Lock()  # guards the table
        self._sources: dict[int, Source] = {}  # by file descriptor
        self._poller = systems()[serving_side()].new_poller()
        self._closing = False
        self._lanes: tuple[deque[Source], ...] = tuple(deque() for _ in Lane)  # sources that have packets to handle
        self._resumed: deque[Source] = deque()
        self._turns = 0
        self._thread = _Thread(target=self._run, name="skyloop-reactor", daemon=True)
        self._thread.start()

    def add(self, source: Source) -> None:
        """Start waiting for a socket. Thread-safe. Raises ``OSError`` beyond the system's limit."""
        with self._lock:
            self._poller.register(source.fileno)
            self._sources[source.fileno] = source

    def remove(self, source: Source) -> bool:
        """Stop waiting for a socket; return whether this reactor was waiting for it. Thread-safe."""
        with self._lock:
            if self._sources.get(source.fileno) is not source:
                return False
            del self._sources[source.fileno]
            self._poller.unregister(source.fileno)
            return True

    @property
    def over(self) -> bool:
        """Whether the reactor's thread has ended, in which case nothing is received for its servers."""
        return not self._thread.is_alive()

    def remaining_of(self, server: SharedLocalServer) -> list[Source]:
        """Return the sockets that a server left over when its thread ended; none while the thread runs. Thread-safe."""
        with self._lock:
            return [source for source in self._sources.values() if source.server is server] if self.over else []

    @property
    def empty(self) -> bool:
        """Whether the reactor has no sockets."""
        return not self._sources

    def split(self, stuck: SharedLocalServer) -> Reactor:
        """Leave this reactor to the server whose handler blocks it; return a new one for all the others. Thread-safe.

        No packet is lost or delivered twice, and the packets of each connection keep their order.
        """
        with self._lock:
            moved = [source for source in self._sources.values() if source.server is not stuck]
        new = Reactor()
        for server in {source.server for source in moved}:
            server.reactor = new  # from here on, this thread doesn't handle any of their packets
        for source in moved:
            self.hand_over(source, new)
        new.resume(source for source in moved if source.lane is not None)
        return new

    def hand_over(self, source: Source, other: Reactor) -> None:
        """Move a socket to another reactor. Thread-safe."""
        if self.remove(source):
            other.add(source)

    def resume(self, sources: Iterable[Source]) -> None:
        """Handle packets that another reactor has received. Thread-safe."""
        self._resumed.extend(sources)
        self._poller.wake()

    def close(self) -> None:
        """End the thread after its current task. Stop its servers first. Idempotent."""
        if not self._closing:
            self._closing = True
            self._poller.wake()
        if threading.current_thread() is not self._thread and self.inside is None:
            self._thread.join()

    # --- on its thread ---

    def _run(self) -> None:
        checked_s, poll = time.monotonic(), self._poller.poll
        while not self._closing:
            busy = any(self._lanes)
            if not busy:
                self.inside = None
            begun_s = time.monotonic()
            try:
                ready = poll(0 if busy else CHECK_S)
                # After a pause, a packet is most likely the only one. If there are many, checking each socket for
                # another one would cost a system call each; instead, all are polled together until nothing new arrives.
                waited = time.monotonic() - begun_s > _PAUSE_S
                if self._receive(ready, at_once=waited and len(ready) == 1):
                    for _ in range(MOST_PACKETS):
                        if not self._receive(poll(0), at_once=False):
                            break
                for _ in range(_PACKETS_PER_POLL):
                    if not any(self._lanes):
                        break
                    self._deliver()
                if time.monotonic() - checked_s >= CHECK_S:
                    checked_s = time.monotonic()
                    self._check()
            except Exception:  # noqa: BLE001  nothing else receives for these servers: this thread must continue
                _log.exception("a turn of the receiving thread failed; it continues")
                time.sleep(_AFTER_FAILURE_S)  # the cause may persist, and must not use up all processor time
        self.inside = None
        self._poller.close()

    def _receive(self, ready: list[tuple[int, int]], *, at_once: bool) -> bool:
        """Read a packet from each socket to see which are urgent or superseded; return whether more may wait."""
        sources, more = self._sources, False
        for fileno, _ in ready:
            source = sources.get(fileno)
            if source is not None:
                self._enter(source.server)
                more = source.server.receive(self, source, at_once) or more
            elif fileno == self._poller.waker:
                self._poller.drain()
                while self._resumed:
                    source = self._resumed.popleft()
                    self.line_up(source, source.lane)
        return more

    def line_up(self, source: Source, lane: Lane | None) -> None:
        """Queue a source for a turn in a lane; do nothing if the lane is None. Called on the reactor's thread."""
        if lane is not None:
            self._lanes[lane].append(source)

    def _deliver(self) -> None:
        """Handle one packet from the source whose turn it is."""
        self._turns += 1
        for lane in _ORDERS[self._turns % len(_ORDERS)]:
            waiting = self._lanes[lane]
            if waiting:
                source = waiting.popleft()
                self._enter(source.server)
                self.line_up(source, source.server.deliver(self, source, lane))
                return

    def _enter(self, server: SharedLocalServer) -> None:
        self.inside = server
        self.entries += 1

    def mute(self, source: Source) -> None:
        """Ignore a listener until the next check, because it can't accept connections but would always be ready."""
        source.muted = True
        with self._lock, contextlib.suppress(OSError):
            self._poller.mute(source.fileno, True)

    def _check(self) -> None:
        """End connections that have sent nothing, and retry listeners that failed."""
        now_s = time.monotonic()
        with self._lock:
            sources = list(self._sources.values())
        for source in sources:
            if source.muted:
                with self._lock, contextlib.suppress(OSError):
                    self._poller.mute(source.fileno, False)
                    source.muted = False  # otherwise, it is retried
            elif source.connection is not None and not source.connection.joined:
                self._enter(source.server)
                source.server.end_silent(self, source, now_s)


class SharedLocalServer(LocalServer):
    """A :class:`LocalServer` that shares its receiving thread with others.

    The handler must return quickly, because a delay affects all of these servers until :meth:`Reactor.split` is called.
    """

    def __init__(self, name: str, reactor: Reactor, *, group: str | None = None) -> None:
        super().__init__(name, group=group)
        self.reactor = reactor  #: the reactor that currently receives for this server
        self._handler: ServerHandler | None = None
        self._listening: Source | None = None
        self._inode = 0
        self._served: set[ServerConnection] = set()
        self._left = threading.Condition()  # guards the set; notified when a connection has ended

    def _begin(self, handler: ServerHandler, listener: Listener, inode: int) -> None:
        listener.setblocking(False)
        self._handler = handler
        self._inode = inode
        self._listening = Source(self, sock=listener)
        self.reactor.add(self._listening)

    def _finish(self, listener: Listener) -> None:
        source, self._listening = self._listening, None
        if source is not None:
            self._drop(source)
        self._directory.remove(self._name, self._inode, listener)
        for connection in list(self._connections):
            connection.hang_up("the proxy stopped")
        # A handler that stops its own server must not wait for itself.
        if not isinstance(threading.current_thread(), _Thread):
            with self._left:
                while self._served and not self.reactor.over:
                    self._left.wait(_THREAD_CHECK_S)
            with self._lock:
                for left in self.reactor.remaining_of(self):  # the thread ended first, and nothing else returns these
                    assert left.connection is not None
                    self._finish_connection(left, left.connection, "the proxy stopped")

    def _drop(self, source: Source) -> None:
        source.ended = True
        self.reactor.remove(source)  # if a socket moves to another reactor, this one drops it as soon as it notices

    # --- on the reactor's thread ---

    def receive(self, reactor: Reactor, source: Source, at_once: bool) -> bool:
        """Accept a connection, or read a packet from one; return whether more packets may be waiting.

        ``at_once``: nothing else is waiting for this thread, so a command is handled right here and not by
        :meth:`deliver`.
        """
        with self._lock:  # held from receiving to handling, so that nothing overtakes this packet after a split
            if not self._is_current(reactor, source):
                return False
            connection = source.connection
            if connection is None:
                self._accept_shared(reactor, source)
                return False
            backlog = connection.backlog
            if backlog.full or (backlog and not connection.pilot):
                return False
            try:
                packet = connection.receive(MAX_PACKET + 1, RECEIVE_FLAGS)
            except (BlockingIOError, ConnectionResetError):
                return False  # after a reset, packets sent earlier still arrive, followed by the end
            except OSError as error:
                self._finish_connection(source, connection, f"receiving failed: {error}")
                return False
            if packet == packets.WAKE and connection.joined:
                return False
            if at_once and not backlog and is_command(packet) and not connection.more():
                self._handle(source, connection, packet)
                return False
            self._superseded += backlog.put(packet)
            reactor.line_up(source, self._lane(source, connection))
            return connection.pilot and bool(packet)

    def deliver(self, reactor: Reactor, source: Source, lane: Lane) -> Lane | None:
        """Handle the first waiting packet of a source from this lane; return the lane that the source waits in next."""
        with self._lock:
            if not self._is_current(reactor, source) or source.lane is not lane:
                return None  # the source has become more urgent and moved to that lane
            source.lane = None
            connection = source.connection
            if connection is None or not connection.backlog:
                return None
            self._handle(source, connection, connection.backlog.get())
            return None if source.ended else self._lane(source, connection)

    def _lane(self, source: Source, connection: ServerConnection) -> Lane | None:
        """Return the lane in which to queue a source; None if it has no packets or is already in that lane."""
        lane = connection.backlog.lane
        if lane is Lane.URGENT and not connection.pilot:
            lane = Lane.STEERING  # the request will be refused
        if lane is None or (source.lane is not None and source.lane <= lane):
            return None
        source.lane = lane
        return lane

    def end_silent(self, reactor: Reactor, source: Source, now_s: float) -> None:
        """End a connection whose first packet takes too long."""
        with self._lock:
            connection = source.connection
            if connection is None or now_s - source.since_s <= HELLO_S or not self._is_current(reactor, source):
                return
            self._finish_connection(source, connection, f"it sent no Hello within {HELLO_S:g} s")

    def _is_current(self, reactor: Reactor, source: Source) -> bool:
        """Return whether this reactor still receives from a source. If not, pass the source on or drop it."""
        if source.ended:
            reactor.remove(source)
            return False
        if self.reactor is not reactor:
            reactor.hand_over(source, self.reactor)
            if source.lane is not None:
                self.reactor.resume((source,))
            return False
        return True

    def _accept_shared(self, reactor: Reactor, source: Source) -> None:
        assert source.sock is not None
        try:
            accepted, _ = source.sock.accept()
        except BlockingIOError:
            return
        except StrangerError as error:
            assert self._handler is not None
            self._refuse(self._handler, error)
            return
        except OSError as error:
            if not self._stopping.is_set() and not isinstance(error, ConnectionError):
                _log.warning("%s cannot accept: %s", self.address, error)  # out of descriptors or memory
                reactor.mute(source)
            return
        connection = self._let_in(accepted)
        if connection is not None:
            with self._left:
                self._served.add(connection)
            own = Source(self, connection=connection)
            try:
                reactor.add(own)
            except OSError as error:
                self._finish_connection(own, connection, f"{self.address} can't receive from it: {error.strerror}")
                return
            if self._stopping.is_set():  # an application that connected while the others were being disconnected
                connection.hang_up("the proxy stopped")

    def _handle(self, source: Source, connection: ServerConnection, packet: bytes) -> None:
        """Handle one packet, and survive any error that the handler raises."""
        handler = self._handler
        assert handler is not None
        try:
            reason = self._take(handler, connection, packet)
        except Exception as error:  # noqa: BLE001  (a handler may raise anything)
            _log.exception("the handler of %s failed; %s is disconnected", self.address, connection.peer.address)
            reason = f"the proxy's handler failed: {error!r}"
        if reason:
            self._finish_connection(source, connection, reason)

    def _finish_connection(self, source: Source, connection: ServerConnection, reason: str) -> None:
        handler = self._handler
        assert handler is not None
        self._drop(source)
        self._end(handler, connection, reason)
        with self._left:
            self._served.discard(connection)
            self._left.notify_all()
