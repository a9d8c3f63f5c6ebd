"""The proxy's end of the fabric transport.

Zenoh's threads only sort what arrives; one thread of this end calls the handler, so that a handler that takes its time
delays no sign of life.
"""

from __future__ import annotations

import getpass
import logging
import os
import platform
import threading
import time
from collections.abc import Hashable
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final

import msgspec

from skyloop.errors import DecodeError, NameTakenError, UsageError
from skyloop.messages import FrameHeader, encode
from skyloop.transport.base import (
    FEEDBACK,
    MAX_PACKET,
    NOBODY,
    Peer,
    Pixels,
    ServerEnd,
    ServerHandler,
    check_frame,
    check_packet,
    video,
)
from skyloop.transport.fabric import finding, layout, packets, rights
from skyloop.transport.fabric.config import Part
from skyloop.transport.fabric.connection import MAX_SUBSCRIPTIONS, ServerConnection
from skyloop.transport.fabric.frames import Variant, Video
from skyloop.transport.fabric.session import Session, acquire, load, release, undeclare
from skyloop.transport.fabric.settings import FabricSettings
from skyloop.transport.fabric.window import DEPTH
from skyloop.transport.names import check_name

if TYPE_CHECKING:
    import zenoh

MAX_CLIENTS: Final = 256
CONFIRM_S: Final = 3.0  #: how long an application may take to show its token after it was let in
FAREWELL_S: Final = 0.5  #: how long a server end that stops waits for its applications to hear why
_LOOK_S: Final = 0.5
_VIDEO: Final = video("")
_log = logging.getLogger(__name__)
#: For the thread that calls the handler: a packet with its number, or True: joined, False: left.
_Item = tuple[ServerConnection, bytes | bool, int]


class FabricServer(ServerEnd):
    """A proxy's end, found on the network by its name. Started once.

    ``vehicle`` is told to whoever asks who has the name. Raises :class:`UsageError` for a name that can't be one;
    :meth:`start` raises :class:`NameTakenError` where a proxy that can be reached has it, :class:`LinkError` where the
    network can't be joined, and :class:`MissingExtraError` without the optional part.
    """

    def __init__(self, name: str, settings: FabricSettings | None = None, *, vehicle: str = "") -> None:
        check_name(name)
        load()
        self._name = name
        self._settings = settings or FabricSettings()
        self._ring = self._settings.ring
        if self._settings.identity is not None:
            self._settings.identity.require_proxy(name)
        self._vehicle = vehicle
        self._run = layout.new_id()
        self._run_bytes = bytes.fromhex(self._run)
        self._session: Session | None = None
        self._held: list[Any] = []  # what was declared
        self._tokens: set[str] = set()  # connections whose tokens are seen
        self._connections: dict[str, ServerConnection] = {}
        self._peers: dict[int, ServerConnection] = {}
        self._topics: dict[str, tuple[ServerConnection, ...]] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._numbers: dict[str, int] = {}  # of the last packet of each topic
        self._lock = threading.RLock()  # guards all of the above
        self._left = threading.Condition()  # told when a connection has gone
        self._inbox: SimpleQueue[_Item | None] = SimpleQueue()
        self._video = Video(self._send_frame, name)
        self._last_id = 0
        self._started = False
        self._thread: threading.Thread | None = None
        self.refused = 0  #: packets that came by a key that gives no right to them
        self.strays = 0  #: samples and queries that came from nobody that is connected
        self._stray_orders = 0  # commands and orders among them that were not told yet

    def start(self, handler: ServerHandler) -> None:
        with self._lock:
            if self._started:
                raise UsageError(f"fabric:{self._name} was started before: make a new {type(self).__name__}")
            self._started = True
        self._check_free()
        session = self._session = acquire(self._settings, Part.PROXY)
        self._since_ns = time.time_ns()
        self._thread = threading.Thread(
            target=self._serve, args=(handler,), name=f"skyloop-{self._name}-fabric", daemon=True
        )
        self._thread.start()
        self._declare(session)

    def _check_free(self) -> None:
        for taken in finding.ask(self._settings, self._name):
            raise NameTakenError(
                f"the name {self._name!r} is in use on the network by the proxy of {taken.vehicle or 'a vehicle'} on "
                f"{taken.host} (pid {taken.pid}): choose another, or stop that one"
            )

    def _declare(self, session: Session) -> None:
        z, name, call = session.zenoh, self._name, session.callback
        self._held = [z.declare_subscriber(layout.upward(way, name, "*", "*"), call(self._heard)) for way in _WAYS]
        self._held.append(z.declare_queryable(layout.info(name), call(self._tell_info)))
        self._held.append(z.declare_queryable(layout.join(name, "*", "*"), call(self._let_in)))
        tokens = layout.app(name, "*", "*")
        self._held.append(z.liveliness().declare_subscriber(tokens, call(self._token), history=True))
        self._held.append(z.liveliness().declare_token(layout.alive(name, self._run)))

    def stop(self) -> None:
        with self._lock:
            thread, self._thread = self._thread, None
            session = self._session
        if thread is None or session is None:
            return
        for connection in list(self._connections.values()):
            self._hang_up(connection, "the proxy stopped")
            connection.ended = True
        with self._left:
            self._left.wait_for(lambda: not self._tokens.intersection(self._connections), FAREWELL_S)
        self._video.end()
        undeclare(
            reversed(self._held)
        )  # not publishers: one that a thread puts by refuses, and ends with its last user
        for connection in list(self._connections.values()):
            self._end(connection, "the proxy stopped")
        self._inbox.put(None)
        if thread is not threading.current_thread():
            thread.join()
        with self._lock:
            self._session = None
            self._publishers.clear()
            self._held.clear()
        release(session, linger=False)

    def send(self, peer: Peer, packet: bytes) -> bool:
        check_packet(packet)
        connection = self._peers.get(peer.id)
        if connection is None or connection.ended:
            return False
        with connection.lock:  # held while it is sent, so that packets travel in the order of their numbers
            number = connection.window.send(len(packet))
            return number > 0 and self._put_to(connection, packet, number)

    def publish(self, topic: str, packet: bytes) -> int:
        check_packet(packet)
        with self._lock:
            subscribed = self._topics.get(topic)
            session = self._session
            if not subscribed or session is None:
                return 0
            number = self._numbers[topic] = self._numbers[topic] + 1
            publisher = self._publishers.get(topic)
            if publisher is None:
                publisher = self._publishers[topic] = self._declare_publisher(session, topic)
        try:
            publisher.put(packet, attachment=packets.published(self._run_bytes, number))
        except load().ZError:
            return len(subscribed)  # it is being stopped
        return sum(connection.missed(topic, number) for connection in subscribed)

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        check_frame(header, pixels)
        return self._video.publish(header, pixels)

    def subscribers(self, topic: str) -> int:
        """How many want this topic; of a camera's plain topic, how many want its frames in whatever form."""
        if topic.startswith(_VIDEO) and "?" not in topic:
            return self._video.readers(topic.removeprefix(_VIDEO))
        return len(self._topics.get(topic, ()))

    def disconnect(self, peer: Peer, reason: str) -> None:
        connection = self._peers.get(peer.id)
        if connection is not None:
            self._hang_up(connection, reason)
            connection.ended = True
            self._end(connection, reason)

    @property
    def address(self) -> str:
        session = self._session
        listens = session.listens if session is not None else self._settings.listen
        return f"fabric:{self._name}" + (f" ({', '.join(listens)})" if listens else "")

    # --- sending ---

    def _declare_publisher(self, session: Session, topic: str) -> zenoh.Publisher:
        z = load()
        newest_wins = topic == FEEDBACK
        return session.zenoh.declare_publisher(
            layout.topic(self._name, topic),
            congestion_control=z.CongestionControl.DROP,
            priority=z.Priority.REAL_TIME if newest_wins else z.Priority.DATA,
            reliability=z.Reliability.BEST_EFFORT if newest_wins else z.Reliability.RELIABLE,
            express=True,
        )

    def _put_to(self, connection: ServerConnection, packet: bytes, number: int) -> bool:
        z, session = load(), self._session
        if session is None:
            return False
        try:
            session.zenoh.put(
                layout.to(self._name, connection.id),
                packet,
                attachment=packets.number(number),
                congestion_control=z.CongestionControl.BLOCK,
                priority=z.Priority.DATA_HIGH,
                express=True,
            )
        except z.ZError as error:
            _log.debug("%s: not sent to %s: %s", self.address, connection.peer.address, error)
            return False
        return True

    def _send_frame(
        self, variant: Variant, number: int, header: FrameHeader, data: bytes, to: tuple[Hashable, ...] | None
    ) -> None:
        z, session, request = load(), self._session, variant.request
        if session is None:
            return
        camera, form = request.camera, request.variant
        keys = (
            [layout.video(self._name, camera, form)]
            if to is None
            else [layout.video_for(self._name, camera, form, str(connection)) for connection in to]
        )
        attachment = packets.frame(self._run_bytes, number, encode(header))
        payload = z.ZBytes(data)
        for key in keys:
            session.zenoh.put(
                key,
                payload,
                attachment=attachment,
                congestion_control=z.CongestionControl.DROP,
                priority=z.Priority.DATA_LOW,
                express=True,
            )

    # --- what Zenoh calls, on its own threads ---

    def _heard(self, sample: zenoh.Sample) -> None:
        """A packet of an application."""
        try:
            sender = layout.parse_sender(str(sample.key_expr))
            connection = self._connections.get(sender.id)
            if connection is None or connection.who != sender.who:
                raise DecodeError("it is not connected")
            if self._ring is not None and sender.who in self._ring.shut_out:
                self._hang_up(connection, _SHUT_OUT)
                self._end(connection, _SHUT_OUT)
                return
            number = packets.parse_number(bytes(sample.attachment or b""))
            packet = bytes(sample.payload)
        except DecodeError:
            self.strays += 1
            if f"/{layout.ASK}/" not in str(sample.key_expr):  # what an application says when it leaves may come late
                self._stray_orders += 1
            return
        if not 0 < len(packet) <= MAX_PACKET:
            self.strays += 1
        elif not rights.allows(sender.way, packet):
            self.refused += 1
            if connection.waiting < 2 * DEPTH:
                connection.waiting += 1
                self._inbox.put((connection, _REFUSED, 0))
        elif (
            connection.waiting < 2 * DEPTH
            and not self._understood(connection, packet)
            and connection.recent.is_new(number, packet)
        ):
            connection.waiting += 1
            self._inbox.put((connection, packet, number))

    def _understood(self, connection: ServerConnection, packet: bytes) -> bool:
        """Take one of the transport's own packets. What makes no sense is left to the handler, as any garbage is."""
        if not packets.is_own(packet):
            return False
        try:
            message = packets.parse(packet)
        except DecodeError:
            return False
        if isinstance(message, packets.Taken):
            connection.took(message.topic, message.number)
        elif isinstance(message, packets.Seen):
            self._video.took(connection.id, message.topic, message.number)
        elif isinstance(message, packets.Subscribe):
            return self._subscribe(connection, message)
        else:
            self._put_to(connection, packets.bye(message.reason), 0)
            self._end(connection, message.reason)
        return True

    def _subscribe(self, connection: ServerConnection, wish: packets.Subscribe) -> bool:
        topic = wish.topic
        with self._lock, connection.lock:
            if connection.ended or wish.on == (topic in connection.topics):
                return True
            if not wish.on:
                self._forget_topic(connection, topic)
                self._video.unsubscribe(connection.id, topic)
                return True
            if len(connection.topics) >= MAX_SUBSCRIPTIONS:
                return False
            if topic.startswith(_VIDEO) and not self._video.subscribe(connection.id, topic):
                return False
            connection.topics[topic] = self._numbers.setdefault(topic, 0)
            self._topics[topic] = (*self._topics.get(topic, ()), connection)
            return True

    def _forget_topic(self, connection: ServerConnection, topic: str) -> None:
        connection.topics.pop(topic, None)
        remaining = tuple(other for other in self._topics.get(topic, ()) if other is not connection)
        if remaining:
            self._topics[topic] = remaining
        else:
            self._topics.pop(topic, None)

    def _token(self, sample: zenoh.Sample) -> None:
        """An application lives, or does no longer."""
        try:
            sender = layout.parse_sender(str(sample.key_expr))
        except DecodeError:
            self.strays += 1
            return
        connection = self._connections.get(sender.id)
        if sample.kind == load().SampleKind.PUT:
            if len(self._tokens) < 16 * MAX_CLIENTS:
                self._tokens.add(sender.id)
            if connection is not None:
                connection.confirmed = True
            return
        self._tokens.discard(sender.id)
        with self._left:
            self._left.notify_all()
        if connection is not None and connection.who == sender.who:
            self._end(connection, f"the application is gone ({connection.peer.address})")

    def _tell_info(self, query: zenoh.Query) -> None:
        with query:
            about = packets.ProxyInfo(
                self._name, self._run, self._since_ns, host_name(), os.getpid(), self._vehicle, self.address
            )
            query.reply(layout.info(self._name), packets.encode_own(about))

    def _let_in(self, query: zenoh.Query) -> None:
        """An application asks to be let in."""
        with query:
            try:
                sender = layout.parse_sender(str(query.key_expr))
                wish = packets.decode_join(bytes(query.payload or b""))
            except (DecodeError, msgspec.DecodeError):
                self.strays += 1
                return
            if wish.run != self._run:
                return  # another proxy of this name is meant
            problem = self._join(sender, wish)
            if problem:
                query.reply_err(problem)
            else:
                query.reply(query.key_expr, packets.encode_own(packets.Welcome(packets.REVISION, self._run)))

    def _join(self, sender: layout.Sender, wish: packets.Join) -> str:
        """Let it in, or say why not."""
        if wish.revision != packets.REVISION:
            return f"it speaks revision {wish.revision} of the fabric transport, and this proxy {packets.REVISION}"
        with self._lock:
            if self._thread is None:
                return "the proxy is about to stop"
            if self._ring is not None and sender.who in self._ring.shut_out:
                return _SHUT_OUT
            if len(self._connections) >= MAX_CLIENTS:
                return f"{self.address} has {MAX_CLIENTS} connections already, and takes no more"
            if sender.id in self._connections:
                return "" if self._connections[sender.id].who == sender.who else "its number is taken"
            self._last_id += 1
            address = f"{sender.who} at {wish.host[:64] or '?'} (pid {wish.pid})"
            connection = ServerConnection(Peer(self._last_id, address), sender.who, sender.id, time.monotonic())
            connection.confirmed = sender.id in self._tokens
            self._connections[sender.id] = connection
            self._peers[connection.peer.id] = connection
            self._inbox.put((connection, True, 0))
        return ""

    # --- ends of connections ---

    def _hang_up(self, connection: ServerConnection, reason: str) -> None:
        """Tell the application that it is over."""
        if not connection.ended:
            connection.reason = connection.reason or reason
            self._put_to(connection, packets.bye(reason), 0)

    def _end(self, connection: ServerConnection, reason: str) -> None:
        """Forget it; the handler is told after its last packet. Any thread."""
        with self._lock, connection.lock:
            if self._connections.pop(connection.id, None) is None:
                return
            self._peers.pop(connection.peer.id, None)
            connection.reason = connection.reason or reason
            for topic in list(connection.topics):
                self._forget_topic(connection, topic)
            self._video.leave(connection.id)
            self._inbox.put((connection, False, 0))
        with self._left:
            self._left.notify_all()

    # --- the thread that calls the handler ---

    def _serve(self, handler: ServerHandler) -> None:
        looked = time.monotonic()
        while True:
            if time.monotonic() - looked >= _LOOK_S:
                looked = time.monotonic()
                self._look(handler)
            try:
                item = self._inbox.get(timeout=_LOOK_S)
            except Empty:
                continue
            if item is None:
                return
            connection, what, number = item
            try:
                if what is True:
                    handler.peer_joined(connection.peer)
                elif what is False:
                    connection.ended = True
                    handler.peer_left(connection.peer, connection.reason)
                else:
                    self._deliver(handler, connection, what, number)
            except Exception as error:  # noqa: BLE001  (a handler may raise anything)
                _log.exception("the handler of %s failed; %s is disconnected", self.address, connection.peer.address)
                reason = f"the proxy's handler failed: {error!r}"
                self._hang_up(connection, reason)
                connection.ended = True
                self._end(connection, reason)

    def _deliver(self, handler: ServerHandler, connection: ServerConnection, packet: bytes, number: int) -> None:
        connection.waiting -= 1
        if connection.ended:
            return
        if packet == _REFUSED:
            handler.refused(connection.peer, "it sent what its keys give it no right to")
            return
        handler.packet(connection.peer, packet)
        if number and connection.taker.took(number, len(packet)):
            self._put_to(connection, packets.taken("", number), 0)

    def _look(self, handler: ServerHandler) -> None:
        """Tell of orders from nobody; end connections whose application was let in and never showed that it lives."""
        orders, self._stray_orders = self._stray_orders, 0
        if orders:
            handler.refused(NOBODY, f"{orders} commands or orders came from nobody that is connected")
        now = time.monotonic()
        for connection in list(self._connections.values()):
            if not connection.confirmed and now - connection.joined_s > CONFIRM_S:
                self._hang_up(connection, "no token of it was seen")
                self._end(connection, "no token of it was seen")


_SHUT_OUT: Final = "its key was revoked, or its rights were changed"
_REFUSED: Final = b""  # in place of a packet that was
_WAYS: Final = (layout.ASK, layout.ORDER, layout.COMMAND)


def host_name() -> str:
    """The name of this host, for people."""
    return platform.node()[:64] or "?"


def user_name() -> str:
    """The name of the user, for people."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.geteuid())
