"""What a proxy publishes to the connections that subscribed: packets of topics, and frames of cameras."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Final

from skyloop.messages import FrameHeader, encode
from skyloop.network import layout, packets
from skyloop.network.connection import ServerConnection
from skyloop.network.delivery import Pace
from skyloop.network.frames import FramePublisher, Variant
from skyloop.network.sealing import Sealer
from skyloop.network.session import Session, load
from skyloop.transport.base import MAX_SUBSCRIPTIONS, Pixels, results, stream, too_many_topics, video

if TYPE_CHECKING:
    import zenoh

_VIDEO: Final = video("")
_STREAMS: Final = stream("")
_RESULTS: Final = results("")


class Publisher:
    """Keeps the subscriptions of all connections, and publishes to them. Thread-safe.

    Args:
        name: The proxy's name.
        run: This run of the proxy.
        sealer: Seals what is published.
        clock: The monotonic clock [s].
    """

    def __init__(self, name: str, run: str, sealer: Sealer, clock: Callable[[], float] = time.monotonic) -> None:
        self._name = name
        self._run = bytes.fromhex(run)
        self._sealer = sealer
        self._clock = clock
        self.held_back = 0  #: packets that were not sent, as nothing was heard from any subscriber
        self._lock = threading.RLock()  # guards what follows
        self._session: Session | None = None  # while it may publish
        self._subscribed: dict[str, tuple[ServerConnection, ...]] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._numbers: dict[str, int] = {}  # of the last packet of each topic
        self._topic_problem: Callable[[str], str] = lambda _: ""
        self.video = FramePublisher(self._send_frame, name)

    def open(self, session: Session, topic_problem: Callable[[str], str]) -> None:
        """Begin to publish.

        Args:
            session: The Zenoh session.
            topic_problem: Returns why a topic can't be subscribed to, empty if it can.
        """
        with self._lock:
            self._session = session
            self._topic_problem = self.video.topic_problem = topic_problem

    def close(self) -> None:
        """Publish no more.

        Publishers are not undeclared: one that another thread is using then refuses, and ends with its last user.
        """
        with self._lock:
            self._session = None
            self._publishers.clear()

    def publish(self, topic: str, packet: bytes) -> int:
        """Send a packet to all subscribers of a topic; return how many of them lag too far behind to take it.

        Where only the newest packet counts and the paths to all of them stand still, most are held back.
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
        z = load()
        try:
            if publisher is not None:
                publisher.put(payload, attachment=attachment)
            else:  # an application has named this topic: nothing is declared for it that would stay
                session.zenoh.put(
                    key,
                    payload,
                    attachment=attachment,
                    congestion_control=z.CongestionControl.DROP,
                    priority=z.Priority.DATA,
                    express=True,
                )
        except z.ZError:
            return len(subscribed)  # it is being stopped
        return sum(connection.lags(topic, number) for connection in subscribed)

    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        """Publish a frame; return how many readers it passes by."""
        return self.video.publish(header, pixels)

    def subscribers(self, topic: str) -> int:
        """Return how many subscribed to a topic; for a camera's plain topic, to its frames in any form."""
        if topic.startswith(_VIDEO) and "?" not in topic:
            return self.video.readers(topic.removeprefix(_VIDEO))
        return len(self._subscribed.get(topic, ()))

    def subscribe(self, connection: ServerConnection, request: packets.Subscribe) -> bool:
        """Subscribe a connection to a topic, or unsubscribe it.

        Returns:
            False if it can't be subscribed; see :meth:`problem`.
        """
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
        """Return why a connection was not subscribed to a topic."""
        problem = self._topic_problem(topic)
        if not problem and topic.startswith(_VIDEO):
            problem = self.video.problem(connection.id, topic)
        return problem or too_many_topics(topic)

    def leave(self, connection: ServerConnection) -> None:
        """Unsubscribe a connection that has ended from everything."""
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
            if topic.startswith((_RESULTS, _STREAMS)) or "?" in topic:  # an application named it: nothing of it stays
                self._numbers.pop(topic, None)
                self._publishers.pop(topic, None)  # ends with whoever is using it

    def _declare(self, session: Session, topic: str) -> zenoh.Publisher:
        z = load()
        newest_wins = layout.newest_wins(topic)
        usual = z.Priority.DATA_LOW if topic.startswith(_STREAMS) else z.Priority.DATA  # as for frames
        return session.zenoh.declare_publisher(
            layout.topic(self._name, topic),
            congestion_control=z.CongestionControl.DROP,
            priority=z.Priority.REAL_TIME if newest_wins else usual,
            reliability=z.Reliability.BEST_EFFORT if newest_wins else z.Reliability.RELIABLE,
            express=True,
        )

    def _send_frame(
        self, variant: Variant, number: int, header: FrameHeader, data: bytes, to: tuple[Hashable, ...] | None
    ) -> None:
        """Send an encoded frame. On the camera's thread."""
        z, session, request = load(), self._session, variant.request
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
            payload, attachment = self._sealer.seal(key, described, data)
            session.zenoh.put(
                key,
                payload,
                attachment=attachment,
                congestion_control=z.CongestionControl.DROP,
                priority=z.Priority.DATA_LOW,
                express=True,
            )
