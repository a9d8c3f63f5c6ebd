"""The connections of applications at a transport server, and a thread that sends to individual applications.

Threads that answer an application only queue the answer here. The sending thread never waits for an application. An
application that acknowledges nothing uses a bounded amount of memory.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Final

from skyloop.messages import FrameHeader, encode
from skyloop.network import layout, packets
from skyloop.network.admission import Admission
from skyloop.network.delivery import DEPTH, MAX_BYTES, Outgoing, Pace, Receiver
from skyloop.network.frames import FramePublisher, FrameVariant
from skyloop.network.sealing import Sealer
from skyloop.network.session import FabricSession, Priority, load
from skyloop.transport.base import MAX_SUBSCRIPTIONS, Peer, results, stream, too_many_topics, video
from skyloop.transport.priority import PacketBacklog

if TYPE_CHECKING:
    import zenoh

#: Maximum number of packets, and of commands, from one application that may wait for the handler. Excess packets are
#: not acknowledged, so they are resent. Excess commands are dropped, since newer ones follow. Set-points count as one.
MAX_WAITING: Final = 64
POLL_S: Final = 0.05  #: interval between checks for packets to resend
_OWN_AT_MOST: Final = 8  # queued packets of the transport itself; they may be lost, and are then requested again
_log = logging.getLogger(__name__)
_VIDEO: Final = video("")
_STREAMS: Final = stream("")
_RESULTS: Final = results("")


class ServerConnection:
    """An application connected to the transport server. Its lock guards its outgoing packets and its topics."""

    def __init__(self, peer: Peer, who: str, connection: str, joined_s: float, admission: Admission) -> None:
        self.peer = peer
        self.who = who
        self.id = connection
        self.admission = admission
        self.joined_s = joined_s  #: time at which the application asked to join
        self.commands = PacketBacklog(MAX_WAITING)  #: commands that wait for the handler; the server guards them
        self.announced = False  #: the handler was told about the application
        self.confirmed = False  #: its token has been seen, so Zenoh will report when it ends
        self.ended = False  #: further packets from the application are ignored
        self.reason = ""  #: the reason why the connection ends, once either end has given one
        self.lock = threading.Lock()
        self.outgoing = Outgoing()  #: packets to the application
        self.receiver = Receiver()  #: packets from the application
        self._own: deque[bytes] = deque(maxlen=_OWN_AT_MOST)  # the transport's own packets to the application
        self._taken = 0  # acknowledge the application's packets up to this number; 0: nothing to acknowledge
        self.topics: dict[str, int] = {}  #: subscribed topics, each with the number of the last acknowledged packet
        self.paces: dict[str, Pace] = {}  #: for topics where only the newest packet matters
        self.left = False  #: the connection has ended and lost its topics, so it gets no new ones

    def may_command(self, drone: str) -> bool:
        """Return whether the application's proven identity permits more than queries about this drone."""
        identity = self.admission.identity
        return identity is None or identity.may_fly(drone)

    def lags(self, topic: str, number: int) -> bool:
        """Return whether a topic's next packet must wait, because more than :data:`DEPTH` are unacknowledged."""
        return number - self.topics.get(topic, number) > DEPTH

    def took(self, topic: str, number: int, now_s: float) -> bool:
        """Record that packets up to this number were acknowledged: a topic's, or if empty, those sent to it alone.

        Returns whether more packets that go only to this application may be waiting.
        """
        with self.lock:
            if not topic:
                self.outgoing.taken(number, now_s)
                return True
            if topic in self.topics:
                self.topics[topic] = max(number, self.topics[topic])
            if topic in self.paces:
                self.paces[topic].taken(number, now_s)
            return False

    def queue(self, packet: bytes) -> str:
        """Keep a packet until it is acknowledged. Return why there is no room for the packet, or an empty string."""
        with self.lock:
            if self.outgoing.put(packet):
                return ""
        return f"more than {DEPTH} packets, or {MAX_BYTES} bytes, are unacknowledged"

    def stalled_s(self, now_s: float) -> float:
        """Return for how long nothing has been acknowledged [s]; 0 if no packet is waiting for an acknowledgement."""
        with self.lock:
            return self.outgoing.stalled_s(now_s)

    def queue_own(self, packet: bytes) -> None:
        """Queue one of the transport's own packets. Such packets are sent only once and may be lost."""
        with self.lock:
            self._own.append(packet)

    def acknowledge(self, number: int) -> None:
        with self.lock:
            self._taken = max(self._taken, number)

    def due(self, now_s: float) -> tuple[list[tuple[int, bytes]], bool]:
        """Return the packets to send now (number 0: the transport's own), and whether others may become due later."""
        with self.lock:
            found = [(number, packet) for number, packet, _ in self.outgoing.due(now_s)]
            if self._taken:
                found.insert(0, (0, packets.taken("", self._taken)))
                self._taken = 0
            found += [(0, packet) for packet in self._own]  # a bye is always the last packet
            self._own.clear()
            return found, self.outgoing.under_way and not self.ended


#: Sends a packet to an application. The number is 0 if the packet may be lost.
Put = Callable[[ServerConnection, bytes, int], object]


class Sender:
    """Sends the connections' packets with ``put`` on a separate thread, and resends unacknowledged ones."""

    def __init__(self, put: Put, name: str) -> None:
        self._put = put
        self._changed = threading.Condition(threading.Lock())
        self._ready: dict[ServerConnection, None] = {}  # in order of arrival
        self._waiting: set[ServerConnection] = set()  # those with unacknowledged packets; used only by this thread
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=f"skyloop-{name}-sender", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def wake(self, connection: ServerConnection) -> None:
        """Schedule the sending of the packets that are due on a connection. Any thread."""
        with self._changed:
            self._ready[connection] = None
            self._changed.notify()

    def end(self) -> None:
        """Send what can be sent immediately, and end the thread. Must not be called on that thread."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ready or self._ended, POLL_S if self._waiting else None)
                ready, self._ready = self._ready, {}
                ended = self._ended
            now = time.monotonic()
            for connection in {**ready, **dict.fromkeys(self._waiting)}:
                self._send(connection, now)
            if ended:
                return

    def _send(self, connection: ServerConnection, now: float) -> None:
        due, waits = connection.due(now)
        if waits:
            self._waiting.add(connection)
        else:
            self._waiting.discard(connection)
        try:
            for number, packet in due:
                self._put(connection, packet, number)
        except Exception:  # noqa: BLE001  (the others still get theirs)
            _log.exception("sending to %s failed", connection.peer.address)


class Publisher:
    """Stores the subscriptions of all connections, and publishes to the subscribers. Thread-safe."""

    def __init__(self, name: str, run: str, sealer: Sealer, clock: Callable[[], float] = time.monotonic) -> None:
        self._name = name
        self._run = bytes.fromhex(run)
        self._sealer = sealer
        self._clock = clock
        self.held_back = 0  #: number of packets that were skipped because all subscribers were silent
        self._lock = threading.RLock()  # guards the following attributes
        self._session: FabricSession | None = None  # set while publishing is possible
        self._subscribed: dict[str, tuple[ServerConnection, ...]] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._numbers: dict[str, int] = {}  # number of the last packet of each topic
        self._topic_problem: Callable[[str], str] = lambda _: ""
        self.video = FramePublisher(self._send_frame, name)

    def open(self, session: FabricSession, topic_problem: Callable[[str], str]) -> None:
        """Start publishing. ``topic_problem`` returns why a topic can't be subscribed to; empty if it can."""
        with self._lock:
            self._session = session
            self._topic_problem = self.video.topic_problem = topic_problem

    def close(self) -> None:
        """Stop publishing.

        Publishers are never undeclared, because this fails while another thread uses one. Each ends with its last user.
        """
        with self._lock:
            self._session = None
            self._publishers.clear()

    def publish(self, topic: str, packet: bytes) -> int:
        """Send a packet to all subscribers of a topic; return how many subscribers are too far behind to receive it.

        On a topic where only the newest packet matters, most packets are skipped while the paths to all subscribers are
        stalled.
        """
        with self._lock:
            subscribed = self._subscribed.get(topic)
            session = self._session
            if not subscribed or session is None:
                return 0
            number, now_s = self._numbers[topic] + 1, self._clock()
            paces = [connection.paces[topic] for connection in subscribed if topic in connection.paces]
            if paces and not any(pace.may_send(now_s) for pace in paces):
                self.held_back += 1
                return len(subscribed)
            for pace in paces:
                pace.sent(number, now_s)
            self._numbers[topic] = number
            publisher = self._publishers.get(topic)
            if publisher is None and not topic.startswith(_RESULTS):
                publisher = self._publishers[topic] = self._declare(session, topic)
        key = layout.topic(self._name, topic)
        payload, attachment = self._sealer.seal(key, packets.published(self._run, number), packet)
        try:
            if publisher is not None:
                publisher.put(payload, attachment=attachment)
            else:  # an application chose the topic's name: leave no declaration behind
                session.put(key, payload, attachment, "DATA")
        except load().ZError:
            return len(subscribed)  # stopping
        return sum(connection.lags(topic, number) for connection in subscribed)

    def subscribers(self, topic: str) -> int:
        """Return the number of a topic's subscribers. A camera's plain topic includes those of all its formats."""
        if topic.startswith(_VIDEO) and "?" not in topic:
            return self.video.readers(topic.removeprefix(_VIDEO))
        return len(self._subscribed.get(topic, ()))

    def subscribe(self, connection: ServerConnection, request: packets.Subscribe) -> bool:
        """Subscribe a connection to a topic, or unsubscribe it. Return False if that fails (see :meth:`problem`)."""
        topic = request.topic
        with self._lock, connection.lock:
            if connection.ended or connection.left or request.on == (topic in connection.topics):
                return True
            if not request.on:
                self._forget(connection, topic)
                self.video.unsubscribe(connection.id, topic)
                return True
            if len(connection.topics) >= MAX_SUBSCRIPTIONS:
                return False
            if self._topic_problem(topic):
                return False
            if topic.startswith(_VIDEO) and not self.video.subscribe(connection.id, topic):
                return False
            connection.topics[topic] = self._numbers.setdefault(topic, 0)
            if layout.newest_wins(topic):
                connection.paces[topic] = Pace()
            self._subscribed[topic] = (*self._subscribed.get(topic, ()), connection)
            return True

    def problem(self, connection: ServerConnection, topic: str) -> str:
        """Return why a connection can't subscribe to a topic."""
        problem = self._topic_problem(topic)
        if not problem and topic.startswith(_VIDEO):
            problem = self.video.problem(connection.id, topic)
        return problem or too_many_topics(topic)

    def leave(self, connection: ServerConnection) -> None:
        """Unsubscribe a connection that has ended from all topics."""
        with self._lock, connection.lock:
            connection.left = True
            for topic in list(connection.topics):
                self._forget(connection, topic)
            self.video.leave(connection.id)

    def _forget(self, connection: ServerConnection, topic: str) -> None:
        connection.topics.pop(topic, None)
        connection.paces.pop(topic, None)
        remaining = tuple(other for other in self._subscribed.get(topic, ()) if other is not connection)
        if remaining:
            self._subscribed[topic] = remaining
        else:
            self._subscribed.pop(topic, None)
            if topic.startswith((_RESULTS, _STREAMS)) or "?" in topic:  # named by an application: keep nothing
                self._numbers.pop(topic, None)
                self._publishers.pop(topic, None)  # freed when its last user releases it

    def _declare(self, session: FabricSession, topic: str) -> zenoh.Publisher:
        newest_wins = layout.newest_wins(topic)
        usual: Priority = "DATA_LOW" if topic.startswith(_STREAMS) else "DATA"  # the same as for frames
        priority: Priority = "REAL_TIME" if newest_wins else usual
        return session.publisher(layout.topic(self._name, topic), priority, best_effort=newest_wins)

    def _send_frame(
        self, variant: FrameVariant, number: int, header: FrameHeader, data: bytes, to: tuple[Hashable, ...] | None
    ) -> None:
        """Send an encoded frame. Called on the camera's thread."""
        session, request = self._session, variant.request
        if session is None:
            return
        camera, form = request.camera, request.variant
        keys = (
            [layout.video(self._name, camera, form)]
            if to is None
            else [layout.video_for(self._name, camera, form, str(connection)) for connection in to]
        )
        described = packets.frame(self._run, number, encode(header))
        for key in keys:
            session.put(key, *self._sealer.seal(key, described, data), "DATA_LOW")
