"""The proxy's end of the local transport, with one connection and one receiving thread per application.

A dedicated thread in ``recv`` delivers a packet with one system call. Waiting for all connections at once (epoll) needs
two calls, which delayed commands by a third more on an idle machine. The threads take turns calling the handler, so
that it gets one call at a time, as the contract requires. Threads with a command go first, the others in order of
arrival. A thread whose turn comes late reads all its waiting packets, and passes on only the newest of the set-points.
"""

from __future__ import annotations

import logging
import threading
from functools import partial
from typing import Final

from skyloop.child_process import leave_to_parent
from skyloop.errors import DecodeError, UsageError
from skyloop.messages import FrameHeader
from skyloop.platform import own_uid
from skyloop.transport.base import (
    MAX_PACKET,
    MAX_SUBSCRIPTIONS,
    NOBODY,
    Peer,
    Pixels,
    ServerHandler,
    TransportServer,
    check_frame,
    check_name,
    check_packet,
    too_many_topics,
    video,
)
from skyloop.transport.local import packets
from skyloop.transport.local.directory import find_directory
from skyloop.transport.local.frame_exchange import FrameExchange
from skyloop.transport.local.packets import OWN
from skyloop.transport.local.system import (
    RECEIVE_FLAGS,
    SEND_FLAGS,
    Credentials,
    Listener,
    PacketSocket,
    StrangerError,
    user_name,
)
from skyloop.transport.priority import MOST_PACKETS, SUPERSEDED, Lane, PacketBacklog, PriorityLock, is_command

MAX_CLIENTS: Final = 128  #: maximum number of connections
#: Connections allowed per process, so that no program takes them all. A cockpit page that flies has its own process.
MAX_PER_PROCESS: Final = 64
MAX_PER_USER: Final = 64  #: maximum per user who has access through a group; the proxy's own user may use all others
PILOT_PLACES: Final = 32  #: connections reserved for pilots
HELLO_S: Final = 2.0  #: time limit for the first packet, which a client sends when it connects
_RETRY_ACCEPT_S: Final = 0.2  #: pause after a failure to accept a connection
_VIDEO: Final = video("")
_log = logging.getLogger(__name__)


class ServerConnection:
    """An application's connection. Any thread may send without waiting; everything else is for its receiving thread."""

    def __init__(self, sock: PacketSocket, peer: Peer, who: Credentials) -> None:
        sock.limit_backlog()
        self.who = who  #: as the kernel reports it
        self._socket = sock
        self._send = sock.send
        self.receive = sock.recv
        self.poll = sock.poller()  #: returns whether a packet or the end is waiting; for the receiving thread
        self.backlog = PacketBacklog()  #: packets that were taken from the socket but have not been handled yet
        self.peer = peer
        self.joined = False  #: whether the application has sent Hello, so that the handler knows about it
        self.admitted = False  #: whether the application has identified itself, so that the handler has admitted it
        self.pilot = False  #: whether the application connected as a pilot
        self.ending = False  #: whether the server is ending the connection, so that earlier packets no longer count
        self.reason = ""  #: the reason why the connection ends, once either end has given one
        self.topics: set[str] = set()

    def fileno(self) -> int:
        """Return the socket's descriptor, so that several sockets can be polled together."""
        return self._socket.fileno()

    def more(self) -> bool:
        """Return whether the socket contains a pilot's packet or the end. Other clients can't command anyway."""
        return self.pilot and bool(self.poll(0))

    def take_in(self) -> int:
        """Move waiting packets from the socket to the backlog; return how many commands were superseded."""
        superseded = 0
        backlog = self.backlog
        for _ in range(MOST_PACKETS):
            if backlog.full or not self.more():
                break
            try:
                packet = self.receive(MAX_PACKET + 1, RECEIVE_FLAGS)
            except OSError:
                break  # the next read returns the same packet again
            if packet == packets.WAKE:
                continue
            superseded += backlog.put(packet)
            if not packet:
                break  # the end
        return superseded

    def limit_silence(self, seconds: float) -> None:
        """Set how long :attr:`receive` waits [s] before it raises ``BlockingIOError``. With 0, it waits forever."""
        self._socket.limit_wait(seconds)

    def transmit(self, packet: bytes) -> None:
        """Send a packet without waiting. Any thread. ``OSError``: the application has ended, or its buffer is full."""
        self._send(packet, SEND_FLAGS)

    def transmit_descriptor(self, packet: bytes, descriptor: int) -> None:
        """Send a packet with a file descriptor, like :meth:`transmit`."""
        self._socket.send_descriptor(packet, descriptor)

    def hang_up(self, reason: str) -> None:
        """End the connection with a reason. Any thread. The receiving thread treats it like any other end."""
        if not self.ending:
            self.reason = self.reason or reason
            self.ending = True
            self._socket.hang_up(packets.bye(self.reason))


class LocalServer(TransportServer):
    """A proxy's end of the local transport. Clients on this host find it by its name. It can be started only once.

    :meth:`start` raises :class:`NameTakenError` if a running proxy uses the name, and :class:`LinkError` if the
    directory of sockets is not safe. ``group``: users who may also connect (``SKYLOOP_GROUP``).
    """

    def __init__(self, name: str, *, group: str | None = None) -> None:
        check_name(name)
        self._name = name
        self._directory = find_directory(group)
        self._directory.socket_path(name)  # if the path is too long, raise here rather than in ``start``
        self._system = self._directory.serving
        self._exchange = FrameExchange(self._system.new_slot)
        # These are replaced under the lock and never changed in place, so that any thread may read them.
        self._connections: set[ServerConnection] = set()
        self._peers: dict[int, ServerConnection] = {}  # by the peer's number
        self._topics: dict[str, tuple[ServerConnection, ...]] = {}
        self._lock = PriorityLock()  # a thread must hold this lock to call the handler
        self._receivers: set[int] = set()  # identities of the threads that receive
        self._superseded = 0  # number of commands that were replaced because newer ones arrived behind them
        self._last_id = 0
        self._started = False
        self._state_lock = threading.Lock()  # guards starting and stopping
        self._stopping = threading.Event()
        self._listener: Listener | None = None
        self._thread: threading.Thread | None = None

    def start(self, handler: ServerHandler) -> None:
        with self._state_lock:
            if self._started:
                raise UsageError(f"{self.address} was started before: create a new {type(self).__name__}")
            listener, inode = self._directory.listen(self._name)
            self._started = True
            self._listener = listener
            leave_to_parent(self)
            try:
                self._begin(handler, listener, inode)
            except BaseException:
                self._listener = None
                listener.hang_up()
                self._directory.remove(self._name, inode, listener)
                raise

    def _begin(self, handler: ServerHandler, listener: Listener, inode: int) -> None:
        """Start accepting and receiving."""
        self._thread = threading.Thread(
            target=self._run, args=(handler, listener, inode), name=f"skyloop-{self._name}-server", daemon=True
        )
        self._thread.start()

    def forked(self) -> None:
        """Leave the listener, its file and all connections to the parent process."""
        self._state_lock, self._listener = threading.Lock(), None
        self._connections, self._peers, self._topics = set(), {}, {}

    def stop(self) -> None:
        with self._state_lock:
            listener, self._listener = self._listener, None
            if listener is None:
                return
            self._stopping.set()
            listener.hang_up()  # wakes the accepting thread
        self._finish(listener)

    def _finish(self, listener: Listener) -> None:  # noqa: ARG002  (the accepting thread owns it)
        """Wait until the accepting thread and all receiving threads have ended."""
        thread = self._thread
        if thread is not None and threading.get_ident() not in self._receivers:
            thread.join()  # a handler that stops its own server must not wait for itself

    def send(self, peer: Peer, packet: bytes) -> bool:
        if not 0 < len(packet) <= MAX_PACKET:
            check_packet(packet)
        connection = self._peers.get(peer.id)
        if connection is None:
            return False
        try:
            connection.transmit(packet)
        except OSError:
            return False
        return True

    def publish(self, topic: str, packet: bytes) -> int:
        if not 0 < len(packet) <= MAX_PACKET:
            check_packet(packet)
        missed = 0
        for connection in self._topics.get(topic, ()):
            try:
                connection.transmit(packet)
            except OSError:
                missed += 1
        return missed

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        check_frame(header, pixels)
        return self._exchange.publish(header, pixels)

    def subscribers(self, topic: str) -> int:
        return len(self._topics.get(topic, ()))

    def admit(self, peer: Peer, *, pilot: bool) -> str:
        with self._lock:
            connection = self._peers.get(peer.id)
            if connection is None:
                return ""
            observers = sum(other.admitted and not other.pilot for other in self._peers.values())
            if not pilot and observers >= MAX_CLIENTS - PILOT_PLACES:
                return f"{self.address} has {observers} observers; the other {PILOT_PLACES} are reserved for pilots"
            connection.admitted, connection.pilot = True, pilot
            return ""

    def disconnect(self, peer: Peer, reason: str) -> None:
        if (connection := self._peers.get(peer.id)) is not None:
            connection.hang_up(reason)

    @property
    def counters(self) -> dict[str, float]:
        return {SUPERSEDED: self._superseded}

    @property
    def address(self) -> str:
        return f"local:{self._name}"

    # --- on the accepting thread ---

    def _run(self, handler: ServerHandler, listener: Listener, inode: int) -> None:
        threads: list[threading.Thread] = []
        try:
            while not self._stopping.is_set():
                thread = self._accept(handler, listener)
                if thread is not None:
                    threads = [thread, *(other for other in threads if other.is_alive())]
        finally:
            self._directory.remove(self._name, inode, listener)
            for connection in list(self._connections):
                connection.hang_up("the proxy stopped")
            for thread in threads:
                thread.join()

    def _accept(self, handler: ServerHandler, listener: Listener) -> threading.Thread | None:
        """Accept one connection and start receiving from it. Return its receiving thread, or None."""
        try:
            accepted, _ = listener.accept()
        except StrangerError as error:
            self._refuse(handler, error)
            return None
        except OSError as error:
            if not self._stopping.is_set() and not isinstance(error, ConnectionError):
                # Out of descriptors or memory: without a pause, this thread would spin.
                _log.warning("%s cannot accept: %s", self.address, error)
                self._stopping.wait(_RETRY_ACCEPT_S)
            return None
        connection = self._let_in(accepted)
        if connection is None:
            return None
        connection.limit_silence(HELLO_S)
        thread = threading.Thread(
            target=self._serve, args=(handler, connection), name=f"skyloop-{self._name}-peer", daemon=True
        )
        try:
            thread.start()
        except RuntimeError as error:  # no more threads
            connection.hang_up(f"{self.address} cannot serve this connection: {error}")
            with self._lock:
                self._connections.discard(connection)
            return None
        return thread

    def _refuse(self, handler: ServerHandler, error: StrangerError) -> None:
        """Report a process that was not let in."""
        with self._lock:
            try:
                handler.refused(NOBODY, str(error))
            except Exception:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the handler of %s failed in refused()", self.address)

    def _let_in(self, sock: PacketSocket) -> ServerConnection | None:
        """Return the caller's connection; None if it failed, the caller may not connect, or there is no room."""
        try:
            return self._examine(sock)
        except Exception as error:  # noqa: BLE001  it must end only this connection
            _log.warning("%s could not let a connection in: %r", self.address, error)
            sock.hang_up()
            return None

    def _examine(self, sock: PacketSocket) -> ServerConnection | None:
        who = sock.who
        if not self._system.may_connect(sock, self._directory.gid):
            sock.hang_up(packets.bye(f"{who} may not connect to {self.address}"))
            return None
        if problem := self._make_room(who):
            sock.hang_up(packets.bye(problem))
            return None
        self._last_id += 1
        connection = ServerConnection(sock, Peer(self._last_id, str(who)), who)
        sock.on_room(partial(self._exchange.retry, connection))
        with self._lock:
            self._connections.add(connection)
        return connection

    def _make_room(self, who: Credentials) -> str:
        """Make room for a new connection; return why this is impossible, or an empty string.

        If all places are taken, the oldest connection that has not identified itself gives way, so that any number of
        such connections can't keep others out.
        """
        with self._lock:
            present = [connection for connection in self._connections if not connection.ending]
            # A process outside our process namespace has the number 0.
            if who.pid and sum(other.who.pid == who.pid for other in present) >= MAX_PER_PROCESS:
                return f"pid {who.pid} has {MAX_PER_PROCESS} connections to {self.address}: end some of them"
            if who.uid not in (0, own_uid()) and sum(other.who.uid == who.uid for other in present) >= MAX_PER_USER:
                return f"{user_name(who.uid)} has {MAX_PER_USER} connections to {self.address}: end some of them"
            if len(present) < MAX_CLIENTS:
                return ""
            silent = [connection for connection in present if not connection.admitted]
            if not silent:
                return f"{self.address} has {MAX_CLIENTS} connections and accepts no more"
            oldest = min(silent, key=lambda connection: connection.peer.id)
            oldest.hang_up(f"it sent no Hello, so its place at {self.address} went to a newer connection")
            return ""

    # --- on the receiving threads ---

    def _serve(self, handler: ServerHandler, connection: ServerConnection) -> None:
        """Receive from one application until its connection ends."""
        self._receivers.add(threading.get_ident())
        try:
            reason = self._receive(handler, connection)
        except Exception as error:  # noqa: BLE001  (a handler may raise anything)
            _log.exception("the handler of %s failed; %s is disconnected", self.address, connection.peer.address)
            reason = f"the proxy's handler failed: {error!r}"
        self._end(handler, connection, reason)
        self._receivers.discard(threading.get_ident())

    def _receive(self, handler: ServerHandler, connection: ServerConnection) -> str:
        """Pass packets on until the connection ends; return why it ended. Re-raises the handler's errors."""
        receive, poll, lock, backlog = connection.receive, connection.poll, self._lock, connection.backlog
        while True:
            try:
                packet = receive(MAX_PACKET + 1)
            except ConnectionResetError:
                continue  # packets sent earlier still arrive, followed by the end
            except BlockingIOError:
                return f"it sent no Hello within {HELLO_S:g} s"
            except OSError as error:
                return f"receiving failed: {error}"
            if packet == packets.WAKE and connection.joined:
                continue  # handled immediately, because a command behind it must not have to wait for it
            lock.acquire(is_command(packet))
            try:
                more = connection.pilot and poll(0)
                if more:  # the packet had to wait, so later ones may supersede it
                    backlog.put(packet)
                    packet = self._next(connection)
                reason = self._take(handler, connection, packet)
            finally:
                lock.release()
            while more and backlog and not reason:
                lock.acquire(backlog.lane is not Lane.OTHERS)
                try:
                    reason = self._take(handler, connection, self._next(connection))
                finally:
                    lock.release()
            if reason:
                return reason

    def _next(self, connection: ServerConnection) -> bytes:
        """Read all waiting packets, and return the packet to handle first. The caller holds the lock."""
        self._superseded += connection.take_in()
        return connection.backlog.get()

    def _take(self, handler: ServerHandler, connection: ServerConnection, packet: bytes) -> str:
        """Handle one packet. Return why it ends the connection, or an empty string. The caller holds the lock."""
        if not packet or connection.ending:
            # An empty packet can't be distinguished from the end of the connection, so it is treated as the end.
            return f"the application is gone ({connection.peer.address})"
        if len(packet) > MAX_PACKET:
            return f"it sent a packet of more than {MAX_PACKET} bytes"
        if not connection.joined:
            self._welcome(handler, connection, packet)
        elif packet[5:6] < OWN or not (packets.is_own(packet) and self._control(handler, connection, packet)):
            handler.packet(connection.peer, packet)
        return ""

    def _welcome(self, handler: ServerHandler, connection: ServerConnection, packet: bytes) -> None:
        """Handle a connection's first packet. A process that only checks who is listening sends no packet."""
        if packet != packets.hello():
            connection.hang_up(f"its Hello is not of revision {packets.REVISION} of the local transport")
            return
        connection.limit_silence(0.0)
        connection.joined = True
        self._peers[connection.peer.id] = connection
        handler.peer_joined(connection.peer)

    def _control(self, handler: ServerHandler, connection: ServerConnection, packet: bytes) -> bool:
        """Handle one of the transport's own packets. Return False for garbage, which is then passed to the handler."""
        try:
            message = packets.parse(packet)
        except DecodeError:
            return False
        if isinstance(message, packets.Release):
            return self._exchange.release(connection, message.slot)
        if isinstance(message, packets.Subscribe):
            self._subscribe(handler, connection, message)
            return True
        if isinstance(message, packets.Bye):
            connection.reason = connection.reason or message.reason
            return True
        return False

    def _subscribe(self, handler: ServerHandler, connection: ServerConnection, request: packets.Subscribe) -> None:
        topic = request.topic
        if request.on == (topic in connection.topics):
            return
        if request.on:
            problem = handler.topic_problem(topic) or _problem(topic, len(connection.topics))
            if problem:
                handler.malformed(connection.peer, problem)
                return
            connection.topics.add(topic)
            self._topics[topic] = (*self._topics.get(topic, ()), connection)
        else:
            connection.topics.discard(topic)
            self._forget_topic(connection, topic)
        if topic.startswith(_VIDEO):
            change = self._exchange.subscribe if request.on else self._exchange.unsubscribe
            change(connection, topic.removeprefix(_VIDEO))

    def _forget_topic(self, connection: ServerConnection, topic: str) -> None:
        remaining = tuple(other for other in self._topics[topic] if other is not connection)
        if remaining:
            self._topics[topic] = remaining
        else:
            del self._topics[topic]

    def _end(self, handler: ServerHandler, connection: ServerConnection, reason: str) -> None:
        with self._lock:
            self._connections.discard(connection)
            self._peers.pop(connection.peer.id, None)
            for topic in connection.topics:
                self._forget_topic(connection, topic)
            self._exchange.leave(connection)
            connection.hang_up(reason)
            if not connection.joined:
                return
            try:
                handler.peer_left(connection.peer, connection.reason)
            except Exception:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the handler of %s failed in peer_left()", self.address)


def _problem(topic: str, subscribed: int) -> str:
    """Return why an application with that many topics can't subscribe to another existing topic; empty if it can."""
    if topic.startswith(_VIDEO) and "?" in topic:
        return f"{topic[:64]!r}: frames are not converted on one host; subscribe to {topic.partition('?')[0][:64]!r}"
    return too_many_topics(topic) if subscribed >= MAX_SUBSCRIPTIONS else ""
