"""Deliver numbered packets exactly once and in order, even if some of them are lost on the way.

The number of packets in flight is limited. Time is passed as an argument, and sending is left to the callers.

Sending must never block, so Zenoh drops what a congested path can't carry, either here or at a router. Zenoh also drops
packets that reach a node before the subscription does. Each numbered packet is therefore kept and resent until the
other end acknowledges it. Only a few packets are in flight at once, to avoid congesting a slow path.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.network import packets

DEPTH: Final = 256  #: maximum number of unacknowledged packets to one end; further packets are refused
MAX_BYTES: Final = 1 << 20  #: total size of unacknowledged packets to one end; further packets are refused [bytes]
RECENT_PACKETS: Final = 64  #: number of recent packets that are remembered to detect repeats
ACKNOWLEDGE_AFTER: Final = DEPTH // 8  #: acknowledge a topic after this number of packets
#: Number of packets in flight. Zenoh queues this many per link before it drops one (``config._QUEUES``).
ON_THE_WAY: Final = 16
ON_THE_WAY_BYTES: Final = 1 << 18  #: total size of packets in flight [bytes]
ACKNOWLEDGE_EVERY_S: Final = 0.15  #: acknowledgement interval if only the newest packet matters (:class:`Pace`)
STANDS_S: Final = 0.5  #: a path is stalled if a packet is unacknowledged for this long
SLOW_S: Final = 0.25  #: interval between packets on a stalled path
AGAIN_S: Final = 0.2  #: time before an unacknowledged packet is resent; it doubles with each attempt
AGAIN_AT_MOST_S: Final = 0.5  #: maximum time before an unacknowledged packet is resent


@dataclass(slots=True)
class _Packet:
    number: int
    data: bytes
    way: str
    sent_s: float = 0.0  #: time when the packet was last sent; 0 if it has not been sent


class Outgoing:
    """The unacknowledged packets to one end. Not thread-safe."""

    def __init__(self, depth: int = DEPTH, most_bytes: int = MAX_BYTES) -> None:
        self._depth = depth
        self._most = most_bytes
        self._kept: deque[_Packet] = deque()  # packets in flight, followed by packets that wait
        self._bytes = 0
        self._under_way = 0  # number of packets in flight
        self._under_way_bytes = 0
        self._next = 1
        self._again_s = AGAIN_S
        self._headway_s = 0.0  # time when the other end last acknowledged a packet, or an idle path got its first one

    def put(self, packet: bytes, way: str = "", *, own: bool = False) -> bool:
        """Keep another packet, sent by the key ``way``, until it is acknowledged; return False if there is no room.

        ``own``: whether it is one of the transport's own small packets. Extra room is reserved for such packets.
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
        """Return number, packet and way of each packet to send: new ones if there is room, and any that seem lost."""
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
        """Remove the packets that are acknowledged up to this number. Ignore a number that has not been sent yet."""
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
        """Whether any packet was sent but not acknowledged."""
        return self._under_way > 0

    def stalled_s(self, now_s: float) -> float:
        """Return for how long the other end has acknowledged nothing [s]; 0 if all packets are acknowledged."""
        return now_s - self._headway_s if self._under_way else 0.0


class Incoming:
    """Reorders the numbered packets from the other end's :class:`Outgoing`. Not thread-safe."""

    def __init__(self) -> None:
        self.taken = 0  #: number up to which all packets have arrived; it is sent as an acknowledgement
        self._early: dict[int, bytes] = {}

    def take(self, number: int, packet: bytes) -> list[bytes]:
        """Return the packets that can now be delivered in order, including this one; none if this one is a repeat."""
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
    """Decides which of a topic's packets to acknowledge: one in many, or one every ``every_s``. Not thread-safe."""

    def __init__(self, every_s: float = math.inf) -> None:
        self._acknowledged = 0
        self._bytes = 0
        self._every_s = every_s
        self._next_s = -math.inf if every_s < math.inf else math.inf

    def count(self, number: int, size: int, now_s: float = 0.0) -> bool:
        """Count a packet; return whether packets must be acknowledged now."""
        self._bytes += size
        few = number - self._acknowledged < ACKNOWLEDGE_AFTER and self._bytes < MAX_BYTES // 8
        if few and now_s < self._next_s:
            return False
        self._acknowledged = number
        self._bytes = 0
        self._next_s = now_s + self._every_s
        return True


class Pace:
    """Tracks whether the path to one subscriber delivers a topic's packets. One thread sends, another acknowledges.

    A stalled path, such as a mobile network that is silent for seconds, still accepts datagrams. The datagrams then
    delay all later packets. Few packets are therefore sent to a silent subscriber.
    """

    __slots__ = ("_acknowledged", "_eager", "_newest", "_sent_s", "_since_s")

    def __init__(self) -> None:
        self._newest = self._acknowledged = 0  # packet numbers
        self._eager = False  # the other end acknowledges more often than it must, so silence means a loss
        self._sent_s = -math.inf  # time when the newest packet was sent
        self._since_s = math.inf  # send time of the oldest unacknowledged packet, or a later time

    def may_send(self, now_s: float) -> bool:
        stands = self._eager and now_s - self._since_s > STANDS_S
        return not stands or now_s - self._sent_s >= SLOW_S

    def sent(self, number: int, now_s: float) -> None:
        self._newest, self._sent_s = number, now_s
        self._since_s = min(self._since_s, now_s)

    def taken(self, number: int, now_s: float) -> None:
        """Record that packets up to this number were acknowledged. Ignore a number that has not been sent yet."""
        if not self._acknowledged < number <= self._newest:
            return
        self._eager = self._eager or (self._acknowledged > 0 and number - self._acknowledged < ACKNOWLEDGE_AFTER)
        self._acknowledged = number
        self._since_s = math.inf if number == self._newest else now_s


class RecentPackets:
    """Remembers the latest packets: with a direct path and one through a router, each packet arrives twice."""

    def __init__(self, depth: int = RECENT_PACKETS) -> None:
        self._packets: deque[tuple[int, bytes]] = deque(maxlen=depth)

    def is_new(self, number: int, packet: bytes) -> bool:
        """Return whether a packet is not among the latest packets, and remember it."""
        if (number, packet) in self._packets:
            return False
        self._packets.append((number, packet))
        return True


class Receiver:
    """Receives packets at one end of a connection: numbered packets exactly once and in order, all others at most once.

    The transport's own packets are passed to ``control``, which returns whether it handled them. All other packets are
    passed to ``deliver``. Thread-safe. One thread at a time passes on numbered packets.
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
        """Receive a packet. It is resent if there is no room. Return the number up to which all were accepted."""
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
