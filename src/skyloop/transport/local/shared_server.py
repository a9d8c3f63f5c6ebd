"""The proxy's end of the local transport in a process with many proxies: all of them receive on one thread."""

from __future__ import annotations

import logging
import threading
from typing import Final

from skyloop.transport.base import MAX_PACKET, ServerHandler
from skyloop.transport.local import packets
from skyloop.transport.local.connection import ServerConnection
from skyloop.transport.local.reactor import Reactor, Source, receiving
from skyloop.transport.local.server import HELLO_S, LocalServer
from skyloop.transport.local.sockets import RECEIVE_FLAGS, Socket
from skyloop.transport.priority import Lane
from skyloop.transport.priority_lock import is_command

_LOOK_S: Final = 0.1  # how often a wait for connections looks whether their thread has ended
_log = logging.getLogger(__name__)


class SharedLocalServer(LocalServer):
    """A :class:`LocalServer` that shares its receiving thread with others.

    Its handler has to return quickly as ever: what it delays is delayed for all of them, until somebody calls
    :meth:`Reactor.split`.

    Args:
        name: The proxy's name.
        reactor: Receives for it, until it is split.
        group: A group of users whose members may connect as well (default: the variable ``SKYLOOP_GROUP``).

    Raises:
        UsageError: The name or the group is not valid, or the socket's path would be too long.
    """

    def __init__(self, name: str, reactor: Reactor, *, group: str | None = None) -> None:
        super().__init__(name, group=group)
        self.reactor = reactor  #: which receives for it now
        self._handler: ServerHandler | None = None
        self._listening: Source | None = None
        self._inode = 0
        self._served: set[ServerConnection] = set()
        self._left = threading.Condition()  # guards the set, and is notified when a connection has gone

    def _begin(self, handler: ServerHandler, listener: Socket, inode: int) -> None:
        listener.setblocking(False)
        self._handler = handler
        self._inode = inode
        self._listening = Source(self, sock=listener)
        self.reactor.add(self._listening)

    def _finish(self, listener: Socket) -> None:  # noqa: ARG002  (the source has it)
        source, self._listening = self._listening, None
        if source is not None:
            self._drop(source)
        self._directory.remove(self._name, self._inode)
        for connection in list(self._connections):
            connection.hang_up("the proxy stopped")
        if not receiving():  # a handler that stops its own server does not wait for itself
            with self._left:
                while self._served and not self.reactor.over:
                    self._left.wait(_LOOK_S)
            with self._lock:
                for left in self.reactor.left_of(self):  # its thread ended first: nobody else gives them back
                    assert left.connection is not None
                    self._finish_connection(left, left.connection, "the proxy stopped")

    def _drop(self, source: Source) -> None:
        """Let no reactor wait for a socket any more."""
        source.ended = True
        self.reactor.remove(source)  # one that is on its way to another reactor is dropped there, at first sight

    # --- the reactor's thread ---

    def receive(self, reactor: Reactor, source: Source, at_once: bool) -> bool:
        """Take in a caller, or a packet of a connection.

        Args:
            reactor: Whose thread it is.
            source: Is readable.
            at_once: Whether nothing else waits for the thread, so that a command is handled here.

        Returns:
            Whether the packet waits for :meth:`deliver`, and more may wait behind it.
        """
        with self._lock:  # from receiving to handling, so that after a split nothing overtakes what this thread has
            if not self._is_mine(reactor, source):
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
                return False  # after a reset, what was sent before it still comes, and then the end
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
        """Handle the first packet that waits in a source.

        Args:
            reactor: Whose thread it is.
            source: Was in this lane.
            lane: The lane.

        Returns:
            The lane that the source is to be put in again; None: in none.
        """
        with self._lock:
            if not self._is_mine(reactor, source) or source.lane is not lane:
                return None  # else it has become more urgent, and was in that lane
            source.lane = None
            connection = source.connection
            if connection is None or not connection.backlog:
                return None
            self._handle(source, connection, connection.backlog.get())
            return None if source.ended else self._lane(source, connection)

    def _lane(self, source: Source, connection: ServerConnection) -> Lane | None:
        """Return the lane that a source is to be put in; None: nothing waits, or it is in that lane already."""
        lane = connection.backlog.lane
        if lane is Lane.URGENT and not connection.pilot:
            lane = Lane.STEERING  # it will be refused
        if lane is None or (source.lane is not None and source.lane <= lane):
            return None
        source.lane = lane
        return lane

    def end_silent(self, reactor: Reactor, source: Source, now_s: float) -> None:
        """End a connection that takes too long to send its first packet."""
        with self._lock:
            connection = source.connection
            if connection is None or now_s - source.since_s <= HELLO_S or not self._is_mine(reactor, source):
                return
            self._finish_connection(source, connection, f"it sent no Hello within {HELLO_S:g} s")

    def _is_mine(self, reactor: Reactor, source: Source) -> bool:
        """Return whether this reactor still receives from it; pass it on or drop it if not."""
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
        except OSError as error:
            if not self._stopping.is_set() and not isinstance(error, ConnectionError):
                _log.warning("%s cannot accept: %s", self.address, error)  # out of descriptors or memory
                reactor.mute(source)
            return
        connection = self._let_in(Socket(accepted.detach()))
        if connection is not None:
            with self._left:
                self._served.add(connection)
            reactor.add(Source(self, connection=connection))
            if self._stopping.is_set():  # it came while the others were sent away
                connection.hang_up("the proxy stopped")

    def _handle(self, source: Source, connection: ServerConnection, packet: bytes) -> None:
        """Handle one packet, whatever the handler raises."""
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
