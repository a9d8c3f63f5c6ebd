"""The proxy's end of the fabric transport.

Zenoh's threads only sort incoming packets. A separate thread calls the handler, commands first, so that a slow handler
does not delay keep-alive packets. A third thread sends to individual applications, so that an application that
acknowledges nothing does not delay the handler. Sending never blocks on an application.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from skyloop.errors import DecodeError, NameTakenError, UsageError
from skyloop.messages import FrameHeader
from skyloop.network import discovery, layout, packets
from skyloop.network.config import FabricSettings, Part
from skyloop.network.connection import MAX_WAITING, Publisher, Sender, ServerConnection
from skyloop.network.registry import ConnectionRegistry, HandlerQueue, Item
from skyloop.network.sealing import PLAIN, TopicSeal, contents
from skyloop.network.session import FabricSession, acquire, host_name, load, release, undeclare
from skyloop.transport.base import Peer, Pixels, ServerHandler, TransportServer, check_frame, check_name, check_packet
from skyloop.transport.composite import CompositeServer
from skyloop.transport.priority import SUPERSEDED, is_command

if TYPE_CHECKING:
    import zenoh

FAREWELL_S: Final = 0.5  #: time for applications to receive the reason when a transport server stops
_POLL_S: Final = 0.5  # interval between checks of the connections
_REFUSED: Final = b""  # represents a packet that was refused
_COMMAND: Final = b"c"  # represents a command: the first command in the connection's backlog
_log = logging.getLogger(__name__)


class FabricServer(TransportServer):
    """A proxy's end, which applications find on the network by its name. It can be started only once.

    :meth:`start` raises :class:`NameTakenError` if a reachable proxy already has the name, and :class:`LinkError` if
    joining the network fails. ``vehicle``: the vehicle's address, which is sent to anyone who searches for the proxy.
    """

    def __init__(self, name: str, settings: FabricSettings | None = None, *, vehicle: str = "") -> None:
        check_name(name)
        load()
        self._name = name
        self._settings = settings or FabricSettings()
        if self._settings.identity is not None:
            self._settings.identity.require_proxy(name)
        self._vehicle = vehicle
        self._run = layout.new_id()
        ring = self._settings.ring
        topic_keys = None if ring is None else TopicSeal()
        self._commands_lock = threading.Lock()  # guards the connections' backlogs of commands
        self._superseded = 0  # number of queued commands that newer commands have superseded
        self._queue: HandlerQueue[Item] = HandlerQueue()
        self._sender = Sender(self._put_to, name)
        self._publisher = Publisher(name, self._run, topic_keys or PLAIN)
        self._registry = ConnectionRegistry(
            name,
            self._run,
            ring,
            topic_keys,
            publisher=self._publisher,
            sender=self._sender,
            queue=self._queue,
            excused_s=self._settings.excused_s,
        )
        self._lock = threading.Lock()  # guards starting and stopping
        self._started = False
        self._since_ns = 0  # wall-clock time when it started
        self._session: FabricSession | None = None
        self._declared: list[Any] = []
        self._thread: threading.Thread | None = None
        self.refused = 0  #: number of packets that were not allowed on their key

    def start(self, handler: ServerHandler) -> None:
        with self._lock:
            if self._started:
                raise UsageError(f"fabric:{self._name} was started before: create a new {type(self).__name__}")
            self._started = True
        self._check_free()
        session = self._session = acquire(self._settings, Part.PROXY)
        self._since_ns = time.time_ns()
        self._thread = threading.Thread(
            target=self._serve, args=(handler,), name=f"skyloop-{self._name}-fabric", daemon=True
        )
        try:
            self._publisher.open(session, handler.topic_problem)
            self._registry.open()
            self._thread.start()
            self._sender.start()
            self._declare(session)
        except BaseException:
            self.stop()
            raise

    def _check_free(self) -> None:
        for taken in discovery.ask(self._settings, self._name):
            raise NameTakenError(
                f"the name {self._name!r} is in use on the network by the proxy of {taken.vehicle or 'a vehicle'} on "
                f"{taken.host} (pid {taken.pid}): choose another, or stop that one"
            )

    def _declare(self, session: FabricSession) -> None:
        z, name, call = session.zenoh, self._name, session.callback
        for way in layout.WAYS:
            self._declared.append(z.declare_subscriber(layout.upward(way, name, "*", "*"), call(self._on_packet)))
        self._declared.append(z.declare_queryable(layout.info(name), call(self._answer_info)))
        self._declared.append(z.declare_queryable(layout.join(name, "*", "*"), call(self._registry.on_join)))
        tokens = layout.app(name, "*", "*")
        self._declared.append(z.liveliness().declare_subscriber(tokens, call(self._registry.on_token), history=True))
        self._declared.append(z.liveliness().declare_token(layout.alive(name, self._run)))

    def stop(self) -> None:
        with self._lock:
            thread, self._thread = self._thread, None
            session = self._session
        if thread is None or session is None:
            return
        self._registry.farewell("the proxy stopped", FAREWELL_S)
        self._publisher.video.end()
        undeclare(reversed(self._declared))
        for connection in self._registry.connections:
            self._registry.end(connection, "the proxy stopped")
        self._queue.close()
        if thread.is_alive() and thread is not threading.current_thread():
            thread.join()
        self._sender.end()
        self._publisher.close()
        self._session = None
        self._declared.clear()
        release(session, linger=False)

    def send(self, peer: Peer, packet: bytes) -> bool:
        check_packet(packet)
        connection = self._registry.of_peer(peer)
        return connection is not None and self._registry.send(connection, packet)

    def publish(self, topic: str, packet: bytes) -> int:
        check_packet(packet)
        return self._publisher.publish(topic, packet)

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        check_frame(header, pixels)
        return self._publisher.video.publish(header, pixels)

    def subscribers(self, topic: str) -> int:
        return self._publisher.subscribers(topic)

    def disconnect(self, peer: Peer, reason: str) -> None:
        if (connection := self._registry.of_peer(peer)) is not None:
            self._registry.disconnect(connection, reason)

    @property
    def counters(self) -> dict[str, float]:
        return {
            SUPERSEDED: self._superseded,
            "network.dropped": self._registry.dropped,
            "network.held_back": self._publisher.held_back,
            "network.refused": self.refused,
            "network.strays": self.strays,
            "network.turned_away": self._registry.turned_away,
        }

    @property
    def restricted(self) -> bool:
        return self._settings.ring is not None

    @property
    def strays(self) -> int:
        """Number of samples and queries without a connection."""
        return self._registry.strays

    @property
    def address(self) -> str:
        session = self._session
        listens = session.listens if session is not None else self._settings.listen
        return f"fabric:{self._name}" + (f" ({', '.join(listens)})" if listens else "")

    def _put_to(self, connection: ServerConnection, packet: bytes, number: int) -> bool:
        """Send a packet to one application. Called on the sender's thread."""
        session = self._session
        if session is None:
            return False
        key = layout.to(self._name, connection.id)
        sealed = connection.admission.sealer.seal(key, packets.number(number), packet)
        try:
            session.put(key, *sealed, "DATA_HIGH")
        except load().ZError as error:
            _log.debug("%s: not sent to %s: %s", self.address, connection.peer.address, error)
            return False
        return True

    # --- callbacks, on Zenoh's threads ---

    def _answer_info(self, query: zenoh.Query) -> None:
        with query:
            about = packets.ProxyInfo(
                self._name, self._run, self._since_ns, host_name(), os.getpid(), self._vehicle, self.address
            )
            query.reply(layout.info(self._name), packets.encode_own(about))

    def _on_packet(self, sample: zenoh.Sample) -> None:
        try:
            sender = layout.parse_sender(str(sample.key_expr))
            connection = self._registry.of_sender(sender)
            if self._registry.is_shut_out(connection):
                return
            opened = contents(connection.admission.opener, sample)
            if opened is None:
                return  # the packet was already received by another path
            packet, attachment = opened
            number = packets.parse_number(attachment)
        except DecodeError:
            self._registry.stray(str(sample.key_expr))
            return
        if not layout.allows(sender.way, packet) or not (
            sender.way == layout.ASK or connection.may_command(self._name)
        ):
            self.refused += 1
            packet = _REFUSED
        control = partial(self._control, connection)
        if number:
            taken = connection.receiver.receive_numbered(
                number,
                packet,
                has_room=lambda: self._queue.waiting(connection) < MAX_WAITING,
                control=control,
                deliver=lambda each: self._queue.put(connection, (connection, each)),
            )
            connection.acknowledge(taken)
            self._sender.wake(connection)
        elif packet == _REFUSED:
            self._enqueue(connection, packet)
        else:
            connection.receiver.receive(packet, control=control, deliver=partial(self._enqueue, connection))

    def _enqueue(self, connection: ServerConnection, packet: bytes) -> None:
        if not (is_command(packet) and connection.announced):
            self._queue.put(connection, (connection, packet), at_most=MAX_WAITING)
            return
        with self._commands_lock:
            if connection.commands.full:
                return
            superseded = connection.commands.put(packet)
            self._superseded += superseded
        if not superseded:  # otherwise the packet takes the turn of the packet that it replaces
            self._queue.put(connection, (connection, _COMMAND), urgent=True)

    def _control(self, connection: ServerConnection, message: packets.Message) -> bool:
        """Handle one of the transport's own packets. Return False if the handler must handle the packet (garbage)."""
        if isinstance(message, packets.Taken):
            if connection.took(message.topic, message.number, time.monotonic()):
                self._sender.wake(connection)
        elif isinstance(message, packets.Seen):
            self._publisher.video.taken(connection.id, message.topic, message.number)
        elif isinstance(message, packets.Subscribe):
            return self._publisher.subscribe(connection, message)
        elif isinstance(message, packets.Key):
            return False  # only proxies send packets of this kind
        else:
            self._registry.send_own(connection, packets.bye(message.reason))
            self._registry.end(connection, message.reason)
        return True

    # --- on the thread that calls the handler ---

    def _serve(self, handler: ServerHandler) -> None:
        checked = time.monotonic()
        while True:
            if time.monotonic() - checked >= _POLL_S:
                checked = time.monotonic()
                try:
                    self._registry.check(handler)
                except Exception:  # noqa: BLE001  this thread must continue: no other receives from the applications
                    _log.exception("checking the connections of %s failed; retrying", self.address)
            item = self._queue.get(_POLL_S)
            if item is None:
                if self._queue.over:
                    return
                continue
            connection, what = item
            try:
                if what is True:
                    handler.peer_joined(connection.peer)
                    connection.announced = True
                elif what is False:
                    connection.ended = True
                    handler.peer_left(connection.peer, connection.reason)
                elif not connection.ended:
                    if what is _COMMAND:
                        with self._commands_lock:
                            if not connection.commands:
                                continue  # one command superseded two commands
                            what = connection.commands.get()
                    self._handle(handler, connection, what)
            except Exception as error:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the handler of %s failed; disconnecting %s", self.address, connection.peer.address)
                self._registry.disconnect(connection, f"the proxy's handler failed: {error!r}")

    def _handle(self, handler: ServerHandler, connection: ServerConnection, packet: bytes) -> None:
        if packet == _REFUSED:
            handler.refused(connection.peer, "it sent a packet that its keys do not allow")
            return
        message = packets.parse_own(packet)
        if isinstance(message, packets.Subscribe):  # the earlier subscription had failed
            handler.malformed(connection.peer, self._publisher.problem(connection, message.topic))
        else:
            handler.packet(connection.peer, packet)


def beside(local: TransportServer, name: str, settings: FabricSettings, vehicle: str) -> TransportServer:
    """Return a proxy's end for both this host and the network. The other arguments are :class:`FabricServer`'s."""
    return CompositeServer([local, FabricServer(name, settings, vehicle=vehicle)])
