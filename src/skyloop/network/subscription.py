"""A topic that an application has subscribed to, and its packets or frames that wait for the handler."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from skyloop.errors import DecodeError
from skyloop.messages import FrameHeader
from skyloop.network import layout, packets
from skyloop.network.delivery import ACKNOWLEDGE_EVERY_S, DEPTH, AckPolicy, RecentPackets
from skyloop.network.frames import WINDOW
from skyloop.network.sealing import Opener, contents
from skyloop.network.session import Session
from skyloop.transport.base import ClientHandler, video

if TYPE_CHECKING:
    import zenoh

_VIDEO: Final = video("")


class Subscription:
    """Sorts a topic's packets on Zenoh's threads and delivers them on the receiving thread.

    ``run``: the proxy's run; packets that others publish under its name are ignored. ``enqueue``: called with this
    subscription, a packet (empty: a frame is due) and its number, which must be passed to :meth:`deliver` in order.
    ``reject``: called with the reason when a packet did not come from the proxy.
    """

    def __init__(
        self,
        topic: str,
        run: bytes,
        opener: Opener,
        enqueue: Callable[[Subscription, bytes, int], object],
        reject: Callable[[DecodeError], None],
    ) -> None:
        self._topic = topic
        self._run = run
        self._opener = opener
        self._enqueue = enqueue
        self._reject = reject
        #: Whether only the newest packet counts, so that packets and their acknowledgements are sent as datagrams.
        self.newest_wins = layout.newest_wins(topic)
        self._ack_policy = AckPolicy(ACKNOWLEDGE_EVERY_S) if self.newest_wins else AckPolicy()
        self._recent = RecentPackets()
        self._waiting = 0  # number of waiting packets
        self._frames: deque[tuple[int, FrameHeader, bytes]] = deque()
        self._newest = 0  # number of the newest frame received
        self._ended = False

    def declare(self, session: Session, name: str, connection: str) -> list[Any]:
        """Subscribe on a Zenoh session. The caller must undeclare the returned declarations."""
        z, call, topic = session.zenoh, session.callback, self._topic
        if not topic.startswith(_VIDEO):
            return [z.declare_subscriber(layout.topic(name, topic), call(self._on_packet))]
        camera, _, form = topic.removeprefix(_VIDEO).partition("?")
        keys = (layout.video(name, camera, form), layout.video_for(name, camera, form, connection))
        return [z.declare_subscriber(key, call(self._on_frame)) for key in keys]

    def end(self) -> None:
        """Stop delivering frames, including queued ones."""
        self._ended = True

    def deliver(self, handler: ClientHandler, packet: bytes, number: int) -> bytes:
        """Deliver the next item to the handler; return the packet that acknowledges it, empty if none is needed."""
        if packet:
            self._waiting -= 1
            handler.packet(packet)
            return packets.taken(self._topic, number) if self._ack_policy.count(number, 0, time.monotonic()) else b""
        number, header, data = self._frames.popleft()
        if self._ended:
            return b""
        handler.frame(header, np.frombuffer(data, np.uint8), self._topic)
        return packets.seen(self._topic, number)

    # --- callbacks, on Zenoh's threads ---

    def _on_packet(self, sample: zenoh.Sample) -> None:
        try:
            opened = contents(self._opener, sample)
            if opened is None:
                return
            packet = opened[0]
            run, number = packets.parse_published(opened[1])
        except DecodeError as error:
            self._reject(error)
            return
        if run == self._run and self._waiting < DEPTH and self._recent.is_new(number, packet):
            self._waiting += 1
            self._enqueue(self, packet, number)

    def _on_frame(self, sample: zenoh.Sample) -> None:
        """Queue a frame, replacing one that is already queued."""
        opener = self._opener
        try:
            attachment = packets.copied(sample.attachment, packets.MAX_OWN)
            run, number, header = packets.parse_frame(attachment[: len(attachment) - opener.trailer])
            if run != self._run or number <= self._newest or len(sample.payload) != header.size + opener.tag:
                return
            opened = opener.open(str(sample.key_expr), attachment, bytes(sample.payload))
            if opened is None:
                return
        except DecodeError as error:
            self._reject(error)
            return
        self._newest = number
        if len(self._frames) >= WINDOW:
            self._frames[-1] = (number, header, opened[0])
        else:
            self._frames.append((number, header, opened[0]))
            self._enqueue(self, b"", number)
