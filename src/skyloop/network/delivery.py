"""Numbered packets that arrive once each and in order, whatever is lost on the way.

How many are under way is bounded. Time is an argument, and nothing here sends.

Nothing that is sent may block its sender, so Zenoh drops what a congested path can't carry, here or at a router; it
also drops what comes to a node before the subscription does. So each numbered packet is kept and sent again until the
other end acknowledges it, and few are under way at once, so that they do not congest a slow path.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.network import packets

DEPTH: Final = 256  #: packets to an end that are not acknowledged yet, before further ones are refused
MAX_BYTES: Final = 1 << 20  #: the same in bytes
RECENT_PACKETS: Final = 64  #: packets of an end among which a repeated one is recognised
ACKNOWLEDGE_AFTER: Final = DEPTH // 8  #: packets of a topic after which they are acknowledged
#: Packets on the way at once: as many as Zenoh queues for a link before it drops one (config._QUEUES).
ON_THE_WAY: Final = 16
ON_THE_WAY_BYTES: Final = 1 << 18
ACKNOWLEDGE_EVERY_S: Final = 0.15  #: of a topic of which only the newest counts, beside that: see :class:`Pace`
STANDS_S: Final = 0.5  #: what was not acknowledged for so long stands in the path …
SLOW_S: Final = 0.25  #: … and until something is heard, a packet follows as often
AGAIN_S: Final = 0.2  #: after so long without an answer what is on the way is sent again; then after twice as long, …
AGAIN_AT_MOST_S: Final = 0.5  #: … and never later than after so long


@dataclass(slots=True)
class _Packet:
    number: int
    data: bytes
    way: str
    sent_s: float = 0.0  #: when last; 0: not yet


class Outgoing:
    """The packets for one end that it has not acknowledged yet. Not thread-safe."""

    def __init__(self, depth: int = DEPTH, most_bytes: int = MAX_BYTES) -> None:
        self._depth = depth
        self._most = most_bytes
        self._kept: deque[_Packet] = deque()  # those on the way first, then those that wait to be
        self._bytes = 0
        self._under_way = 0  # packets
        self._under_way_bytes = 0
        self._next = 1
        self._again_s = AGAIN_S
        self._headway_s = (
            0.0  # when the other end last took something, or when the first packet of an idle time was sent
        )

    def put(self, packet: bytes, way: str = "", *, own: bool = False) -> bool:
        """Keep one more packet.

        Args:
            packet: The packet.
            way: By which key it is sent, for the sender.
            own: One of the transport's own small packets: there is room for it where others find none.

        Returns:
            False if there is no room for it.
        """
        if own:
            full = len(self._kept) >= 2 * self._depth
        else:
            full = len(self._kept) >= self._depth or bool(self._kept and self._bytes + len(packet) > self._most)
        if full:
            return False
        self._kept.append(_Packet(self._next, packet, way))
        self._bytes += len(packet)
        self._next += 1
        return True

    def due(self, now_s: float) -> list[tuple[int, bytes, str]]:
        """Return number, packet and way of what is to be sent: where there is room on the way, and what seems lost."""
        found: list[tuple[int, bytes, str]] = []
        if self._under_way and now_s - self._kept[0].sent_s >= self._again_s:
            self._again_s = min(2 * self._again_s, AGAIN_AT_MOST_S)
            for index in range(self._under_way):
                packet = self._kept[index]
                packet.sent_s = now_s
                found.append((packet.number, packet.data, packet.way))
        while self._under_way < min(len(self._kept), ON_THE_WAY):
            packet = self._kept[self._under_way]
            if self._under_way and self._under_way_bytes + len(packet.data) > ON_THE_WAY_BYTES:
                break
            if not self._under_way:
                self._headway_s = now_s
            packet.sent_s = now_s
            self._under_way += 1
            self._under_way_bytes += len(packet.data)
            found.append((packet.number, packet.data, packet.way))
        return found

    def taken(self, number: int, now_s: float) -> None:
        """Drop the packets up to this number, as the other end has acknowledged them.

        A number of a packet that was not sent yet is ignored.
        """
        if not self._under_way or number >= self._kept[0].number + self._under_way:
            return
        while self._under_way and self._kept[0].number <= number:
            packet = self._kept.popleft()
            self._bytes -= len(packet.data)
            self._under_way -= 1
            self._under_way_bytes -= len(packet.data)
            self._headway_s = now_s
            self._again_s = AGAIN_S

    @property
    def under_way(self) -> bool:
        """Whether something was sent and is not acknowledged yet."""
        return self._under_way > 0

    def stalled_s(self, now_s: float) -> float:
        """Return for how long the other end has acknowledged nothing of what is under way [s]; 0 if nothing is."""
        return now_s - self._headway_s if self._under_way else 0.0


class Incoming:
    """Puts the numbered packets of the other end's :class:`Outgoing` in order. Not thread-safe."""

    def __init__(self) -> None:
        self.taken = 0  #: the number up to which all packets came, to be acknowledged
        self._early: dict[int, bytes] = {}

    def take(self, number: int, packet: bytes) -> list[bytes]:
        """Return the packets that can be delivered now that this one came, in order; none if it came before."""
        if number != self.taken + 1:
            if self.taken < number <= self.taken + ON_THE_WAY:
                self._early.setdefault(number, packet)
            return []
        found = [packet]
        self.taken += 1
        while (early := self._early.pop(self.taken + 1, None)) is not None:
            found.append(early)
            self.taken += 1
        return found


class AckPolicy:
    """Decides when a subscriber acknowledges the packets of a topic. Not thread-safe.

    Args:
        every_s: At least so much time is between two, after which the next packet is acknowledged, too [s].
    """

    def __init__(self, every_s: float = math.inf) -> None:
        self._acknowledged = 0
        self._bytes = 0
        self._every_s = every_s
        self._next_s = -math.inf if every_s < math.inf else math.inf

    def count(self, number: int, size: int, now_s: float = 0.0) -> bool:
        """Count a packet; return whether to acknowledge now."""
        self._bytes += size
        few = number - self._acknowledged < ACKNOWLEDGE_AFTER and self._bytes < MAX_BYTES // 8
        if few and now_s < self._next_s:
            return False
        self._acknowledged = number
        self._bytes = 0
        self._next_s = now_s + self._every_s
        return True


class Pace:
    """Whether the path to one subscriber carries what is published on one topic. One thread sends, another takes.

    Datagrams are taken by a path that stands still, as by a mobile network that is silent for seconds, and wait in it
    ahead of all that is sent later. So a subscriber of which nothing is heard is sent few.
    """

    __slots__ = ("_acknowledged", "_newest", "_prompt", "_sent_s", "_since_s")

    def __init__(self) -> None:
        self._newest = self._acknowledged = 0  # numbers
        self._prompt = False  # it acknowledges more often than it must, so that a silence says something
        self._sent_s = -math.inf  # when the newest was
        self._since_s = math.inf  # when the oldest was sent that is not acknowledged, or later

    def may_send(self, now_s: float) -> bool:
        """Return whether another packet may be sent now."""
        stands = self._prompt and now_s - self._since_s > STANDS_S
        return not stands or now_s - self._sent_s >= SLOW_S

    def sent(self, number: int, now_s: float) -> None:
        """Note a packet."""
        self._newest, self._sent_s = number, now_s
        self._since_s = min(self._since_s, now_s)

    def taken(self, number: int, now_s: float) -> None:
        """Note that the subscriber acknowledged the packets up to this number; one that was not sent yet is ignored."""
        if not self._acknowledged < number <= self._newest:
            return
        self._prompt = self._prompt or (self._acknowledged > 0 and number - self._acknowledged < ACKNOWLEDGE_AFTER)
        self._acknowledged = number
        self._since_s = math.inf if number == self._newest else now_s


class RecentPackets:
    """The last packets that came: where there is a direct path and one through a router, each comes twice."""

    def __init__(self, depth: int = RECENT_PACKETS) -> None:
        self._packets: deque[tuple[int, bytes]] = deque(maxlen=depth)

    def is_new(self, number: int, packet: bytes) -> bool:
        """Return whether a packet is not among the last ones, and remember it."""
        if (number, packet) in self._packets:
            return False
        self._packets.append((number, packet))
        return True


class Receiver:
    """Receives what comes to one end of a connection: numbered packets once each and in order, the others once each.

    The transport's own packets are given to ``control``, which returns whether it has handled them; those that it has
    not, and all others, to ``deliver``. Thread-safe: for numbered packets one thread at a time calls both.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._incoming = Incoming()
        self._recent = RecentPackets()

    def receive_numbered(
        self,
        number: int,
        packet: bytes,
        *,
        has_room: Callable[[], bool],
        control: Callable[[packets.Message], bool],
        deliver: Callable[[bytes], object],
    ) -> int:
        """Receive a packet that is sent again until it is acknowledged.

        Args:
            number: The packet's, from 1.
            packet: The packet.
            has_room: Whether another packet can be taken now; if not, this one is ignored and will be sent again.
            control: Handles the transport's own packets.
            deliver: Handles all others.

        Returns:
            The number up to which all packets were taken, to be acknowledged.
        """
        with self._lock:
            if has_room():
                for each in self._incoming.take(number, packet):
                    message = packets.parse_own(each)
                    if message is None or not control(message):
                        deliver(each)
            return self._incoming.taken

    def receive(
        self, packet: bytes, *, control: Callable[[packets.Message], bool], deliver: Callable[[bytes], object]
    ) -> None:
        """Receive a packet that may be lost."""
        message = packets.parse_own(packet)
        if message is not None and control(message):
            return
        with self._lock:
            new = self._recent.is_new(0, packet)
        if new:
            deliver(packet)
