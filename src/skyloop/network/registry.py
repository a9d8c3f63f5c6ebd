"""Manage a proxy's connections: admit applications and end connections.

A connection is ended if its application has ended, has lost its rights, or acknowledges nothing.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Hashable
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Generic, TypeVar

import msgspec

from skyloop.errors import DecodeError, LinkError
from skyloop.network import layout, packets
from skyloop.network.admission import MAX_CLIENTS, Admission, Tokens, admit, no_place_reason
from skyloop.network.connection import Publisher, Sender, ServerConnection
from skyloop.network.sealing import Seal, TopicSeal
from skyloop.network.session import load
from skyloop.transport.base import NOBODY, Peer, ServerHandler

if TYPE_CHECKING:
    import zenoh

    from skyloop.network.keys import KeyRing

CONFIRM_S: Final = 3.0  #: time for an admitted application to declare its token
#: Disconnect an application that acknowledges nothing for this long. The application's transport acknowledges at once,
#: no matter how slow the application's own code is.
STALLED_S: Final = 3.0
_SHUT_OUT: Final = "its key was revoked, or its rights were changed"

T = TypeVar("T")
#: After this number of consecutive commands, handle one other packet, so that endless commands can't stop others from
#: requesting authority.
IN_A_ROW: Final = 16

#: Items for the thread that calls the handler: a packet, True if the application has joined, or False if it has left.
Item = tuple[ServerConnection, bytes | bool]


class ConnectionRegistry:
    """The connections of one transport server. Thread-safe, except for :meth:`check`.

    Without keys, ``ring`` and ``topic_keys`` are None. ``excused_s``: additional time to wait, beyond
    :data:`STALLED_S`, before a silent application is disconnected [s].
    """

    def __init__(
        self,
        name: str,
        run: str,
        ring: KeyRing | None,
        topic_keys: TopicSeal | None,
        *,
        publisher: Publisher,
        sender: Sender,
        queue: HandlerQueue[Item],
        excused_s: float = 0.0,
    ) -> None:
        self._name = name
        self._run = run
        self._ring = ring
        self._topic_keys = topic_keys
        self._publisher = publisher
        self._sender = sender
        self._queue = queue
        self._stalled_s = STALLED_S + excused_s
        self._lock = threading.RLock()  # guards the following attributes
        self._open = False
        self._tokens = Tokens(by_key=ring is not None)  # tokens of live connections
        self._connections: dict[str, ServerConnection] = {}
        self._peers: dict[int, ServerConnection] = {}
        self._left = threading.Condition()  # notified when a connection has ended
        self._last_id = 0
        self._shut: frozenset[str] = frozenset()  # identities that were excluded when the topic key was made
        self.dropped = 0  #: number of applications that were disconnected because they acknowledged nothing
        self.turned_away = 0  #: number of connections and tokens that were refused because of the limits
        self._away = ""  # why connections were turned away, until the handler has been notified
        self.strays = 0  #: number of samples and queries that belong to no connection
        self._stray_commands = 0  # number of commands and requests among those packets, not yet reported to the handler

    def open(self) -> None:
        with self._lock:
            self._open = True

    def farewell(self, reason: str, within_s: float) -> None:
        """Stop admitting, disconnect all applications and wait until they are gone."""
        with self._lock:
            self._open = False
        for connection in self.connections:
            self.disconnect(connection, reason, forget=False)
        with self._left:
            self._left.wait_for(
                lambda: not self._tokens.any_of({each.id: each.who for each in self.connections}), within_s
            )

    @property
    def connections(self) -> list[ServerConnection]:
        """A copy of the current connections."""
        return list(self._connections.values())

    def of_peer(self, peer: Peer) -> ServerConnection | None:
        return self._peers.get(peer.id)

    def of_sender(self, sender: layout.Sender) -> ServerConnection:
        """Return the connection that a key belongs to. Raises :class:`DecodeError` if none has this id and identity."""
        connection = self._connections.get(sender.id)
        if connection is None or connection.who != sender.who:
            raise DecodeError("it is not connected")
        return connection

    def is_shut_out(self, connection: ServerConnection) -> bool:
        """Return whether a newer roster excludes the key of a connection. If one does, end the connection."""
        if self._ring is None or connection.who not in self._ring.shut_out:
            return False
        self._shut_out(connection, _SHUT_OUT)
        return True

    def stray(self, key: str) -> None:
        """Count a packet without a connection, given the key that it arrived on."""
        self.strays += 1
        if f"/{layout.ASK}/" not in key:  # an application's last packets may arrive after it has left
            self._stray_commands += 1

    # --- callbacks, on Zenoh's threads ---

    def on_token(self, sample: zenoh.Sample) -> None:
        """Record that an application's token has appeared or disappeared. Called on Zenoh's threads."""
        try:
            sender = layout.parse_sender(str(sample.key_expr))
        except DecodeError:
            self.strays += 1
            return
        connection = self._connections.get(sender.id)
        if sample.kind == load().SampleKind.PUT:
            if not self._tokens.add(sender.who, sender.id):
                self._turn_away(f"the key of {sender.who!r} has more tokens than it may have connections")
            if connection is not None:
                connection.confirmed = True
            return
        self._tokens.discard(sender.who, sender.id)
        with self._left:
            self._left.notify_all()
        if connection is not None and connection.who == sender.who:
            self.end(connection, f"the application is gone ({connection.peer.address})")

    def on_join(self, query: zenoh.Query) -> None:
        """Answer an application's request to join. Called on Zenoh's threads."""
        with query:
            try:
                sender = layout.parse_sender(str(query.key_expr))
                request = packets.decode_join(packets.copied(query.payload, packets.MAX_OWN))
            except (DecodeError, msgspec.DecodeError):
                self.strays += 1
                return
            if request.run != self._run:
                return  # intended for another proxy with this name
            try:
                admission = self._admit(sender, request)
                problem = self._join(sender, request, admission)
            except LinkError as error:
                problem = str(error)
            if problem:
                query.reply_err(problem)
                return
            connection = self._connections.get(sender.id)
            query.reply(query.key_expr, (connection.admission if connection else admission).welcome)
            if connection is not None and self._topic_keys is not None:
                self._send_topic_key(connection, self._topic_keys.newest)

    def _admit(self, sender: layout.Sender, request: packets.Join) -> Admission:
        if self._ring is not None and sender.who in self._ring.shut_out:
            raise LinkError(_SHUT_OUT)
        newest = self._topic_keys.newest if self._topic_keys else None
        return admit(self._ring, self._name, self._run, sender, request, newest)

    def _join(self, sender: layout.Sender, request: packets.Join, admission: Admission) -> str:
        """Admit an application. Return why it was refused, or an empty string."""
        if request.revision != packets.REVISION:
            return f"it uses revision {request.revision} of the fabric transport, this proxy {packets.REVISION}"
        with self._lock:
            if not self._open:
                return "the proxy is about to stop"
            if sender.id in self._connections:
                before = self._connections[sender.id]  # the request was repeated, or arrived by two paths
                same = before.who == sender.who and before.admission.offer == request.proof
                return "" if same else "its number is taken"
            address = f"{sender.who} at {request.host[:64] or '?'}"
            if problem := self._no_place(sender.who):
                self._turn_away(f"{address} was not admitted: {problem}")
                return problem
            self._last_id += 1
            peer = Peer(self._last_id, f"{address} (pid {request.pid})")
            connection = ServerConnection(peer, sender.who, sender.id, time.monotonic(), admission)
            connection.confirmed = self._tokens.has(sender.who, sender.id)
            self._connections[sender.id] = connection
            self._peers[connection.peer.id] = connection
            self._queue.put(connection, (connection, True))
        return ""

    def _no_place(self, who: str) -> str:
        """Return why there is no room for another connection. Without keys, only the total number is limited."""
        if self._ring is None:
            full = len(self._connections) >= MAX_CLIENTS
            return f"fabric:{self._name} already has its maximum of {MAX_CLIENTS} connections" if full else ""
        known = {entry.name: entry.identity for entry in self._ring.roster.entries}

        def may_fly(name: str) -> bool:
            return name in known and known[name].may_fly(self._name)

        return no_place_reason(who, may_fly(who), [(each.who, may_fly(each.who)) for each in self.connections])

    def _turn_away(self, reason: str) -> None:
        self.turned_away += 1
        self._away = reason

    # --- periodic checks, on the thread that calls the handler ---

    def check(self, handler: ServerHandler) -> None:
        """End invalid connections. Must be called periodically on the thread that calls the handler.

        A connection is invalid if its application never declared its token, acknowledges nothing, or has lost its
        rights. Notify the handler of commands from unknown applications and of refused connections.
        """
        self._check_keys()
        commands, self._stray_commands = self._stray_commands, 0
        if commands:
            handler.refused(NOBODY, f"{commands} commands or requests came from applications that are not connected")
        away, self._away = self._away, ""
        if away:
            handler.refused(NOBODY, away)
        now = time.monotonic()
        for connection in self.connections:
            if not connection.confirmed and now - connection.joined_s > CONFIRM_S:
                self._shut_out(connection, "its token was not seen")
            elif connection.stalled_s(now) > self._stalled_s:
                self.drop(connection, f"it acknowledged nothing for {self._stalled_s:g} s")

    def _check_keys(self) -> None:
        """End connections whose keys have been excluded or have expired.

        If there were any, create a new key for published packets, which the excluded applications can't read.
        """
        ring, keys = self._ring, self._topic_keys
        if ring is None or keys is None:
            return
        ring.refresh()
        now = datetime.now(UTC)
        gone = False
        for connection in self.connections:
            who, expires = connection.admission.identity, connection.admission.expires
            if who is not None and not ring.admits(who):
                self._shut_out(connection, _SHUT_OUT)
            elif expires is not None and now >= expires:
                self._shut_out(connection, "its key has expired")
            else:
                continue
            gone = True
        if gone or not ring.shut_out <= self._shut:
            self._shut = ring.shut_out
            with self._lock:
                keys.renew()
                staying = self.connections
            for connection in staying:
                self._send_topic_key(connection, keys.newest)

    def _send_topic_key(self, connection: ServerConnection, newest: Seal) -> None:
        if connection.admission.generation < newest.generation:
            self.send(connection, packets.key(newest.generation, newest.key))

    # --- sending to one connection, and ending it: any thread ---

    def send(self, connection: ServerConnection, packet: bytes) -> bool:
        """Send a packet that must arrive. Return False if the connection has ended, or ends now. Any thread."""
        if connection.ended:
            return False
        if problem := connection.queue(packet):
            self.drop(connection, problem)
            return False
        self._sender.wake(connection)
        return True

    def send_own(self, connection: ServerConnection, packet: bytes) -> None:
        """Send one of the transport's own packets, which may be lost; use :meth:`send` for others. Any thread."""
        connection.queue_own(packet)
        self._sender.wake(connection)

    def drop(self, connection: ServerConnection, reason: str) -> None:
        """Disconnect an application that acknowledges nothing, and count it."""
        self.dropped += connection.id in self._connections
        self.disconnect(connection, reason)

    def disconnect(self, connection: ServerConnection, reason: str, *, forget: bool = True) -> None:
        """Disconnect an application and drop its unhandled packets. Any thread.

        With ``forget=False``, the connection is removed only when the application answers or its token disappears.
        """
        self._hang_up(connection, reason)
        connection.ended = True
        if forget:
            self.end(connection, reason)

    def end(self, connection: ServerConnection, reason: str) -> None:
        """Remove a connection. The handler is notified after the connection's last packet. Any thread."""
        with self._lock:
            if self._connections.pop(connection.id, None) is None:
                return
            self._peers.pop(connection.peer.id, None)
            connection.reason = connection.reason or reason
            self._publisher.leave(connection)
            self._queue.put(connection, (connection, False))
        with self._left:
            self._left.notify_all()

    def _shut_out(self, connection: ServerConnection, reason: str) -> None:
        """Disconnect an application. Packets that it sent earlier are still handled."""
        self._hang_up(connection, reason)
        self.end(connection, reason)

    def _hang_up(self, connection: ServerConnection, reason: str) -> None:
        if not connection.ended:
            connection.reason = connection.reason or reason
            self.send_own(connection, packets.bye(reason))


# The queue for the thread that calls the handler -------------------------------------------------------------------


class _TurnQueue(Generic[T]):
    """One queue per connection. The connections take turns, so that one with many items doesn't delay others."""

    def __init__(self) -> None:
        self._order: deque[Hashable] = deque()
        self._waiting: dict[Hashable, deque[T]] = {}

    def __bool__(self) -> bool:
        return bool(self._order)

    def count(self, of: Hashable) -> int:
        return len(self._waiting.get(of, ()))

    def put(self, of: Hashable, item: T) -> None:
        waiting = self._waiting.get(of)
        if waiting is None:
            self._waiting[of] = deque((item,))
            self._order.append(of)
        else:
            waiting.append(item)

    def get(self) -> T:
        of = self._order.popleft()
        waiting = self._waiting[of]
        item = waiting.popleft()
        if waiting:
            self._order.append(of)
        else:
            del self._waiting[of]
        return item


class HandlerQueue(Generic[T]):
    """The queue of packets for the thread that calls a handler. Commands come first, and connections take turns.

    Items of equal urgency from one connection stay in order.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.Lock())
        self._urgent: _TurnQueue[T] = _TurnQueue()
        self._others: _TurnQueue[T] = _TurnQueue()
        self._in_a_row = 0
        self._closed = False

    def put(self, of: Hashable, item: T, *, urgent: bool = False, at_most: int | None = None) -> bool:
        """Queue a connection's item, urgent items first. Refuse it if ``at_most`` are waiting. Any thread."""
        with self._changed:
            queue = self._urgent if urgent else self._others
            if at_most is not None and queue.count(of) >= at_most:
                return False
            queue.put(of, item)
            self._changed.notify()
            return True

    def waiting(self, of: Hashable) -> int:
        """Return how many of a connection's queued items are not urgent."""
        with self._changed:
            return self._others.count(of)

    def close(self) -> None:
        """Stop :meth:`get` from waiting. Items that are already queued are still returned."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def get(self, timeout_s: float) -> T | None:
        """Return the next item; None after the time-out, or if the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._urgent or self._others or self._closed, timeout_s)
            if self._urgent and not (self._others and self._in_a_row >= IN_A_ROW):
                self._in_a_row += 1
                return self._urgent.get()
            self._in_a_row = 0
            return self._others.get() if self._others else None

    @property
    def over(self) -> bool:
        """Whether the queue is closed and contains no more items."""
        with self._changed:
            return self._closed and not self._urgent and not self._others
