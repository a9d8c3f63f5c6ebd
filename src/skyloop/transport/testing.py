"""Helpers for testing transports and their users: handlers that record their calls.

Nothing here sleeps for a fixed time. :func:`wait_until` waits for a condition, but no longer than :data:`PATIENCE_S`.
"""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from skyloop.messages import Encoding, FrameHeader
from skyloop.transport.base import Peer, Pixels, TransportClient

PATIENCE_S: Final = 15.0  #: generous, because a busy machine must not fail the tests
FRONT: Final = "front"


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Test a condition every millisecond until it holds; fail after :data:`PATIENCE_S`."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"after {PATIENCE_S} s still not true: {what}"
        time.sleep(0.001)


def raises(error: type[Exception], call: Callable[[], object]) -> None:
    """Check that a call raises an error. Errors of other types pass through."""
    try:
        call()
    except error:
        return
    raise AssertionError(f"{error.__name__} was not raised")


class ServerLog:
    """A server's handler that records its calls.

    Its lists grow on the transport's receiving thread. If ``on_packet`` is set, it is called there with each packet.
    """

    def __init__(self) -> None:
        self.joined: list[Peer] = []
        self.packets: list[tuple[Peer, bytes]] = []
        self.left: list[tuple[Peer, str]] = []
        self.refusals: list[tuple[Peer, str]] = []
        self.problems: dict[str, str] = {}  #: by topic, the reason why it can't be subscribed to
        self.complaints: list[tuple[Peer, str]] = []
        self.on_packet: Callable[[Peer, bytes], None] | None = None

    def peer_joined(self, peer: Peer) -> None:
        self.joined.append(peer)

    def packet(self, peer: Peer, packet: bytes) -> None:
        self.packets.append((peer, packet))
        if self.on_packet is not None:
            self.on_packet(peer, packet)

    def refused(self, peer: Peer, reason: str) -> None:
        self.refusals.append((peer, reason))

    def topic_problem(self, topic: str) -> str:
        return self.problems.get(topic, "")

    def malformed(self, peer: Peer, reason: str) -> None:
        self.complaints.append((peer, reason))

    def peer_left(self, peer: Peer, reason: str) -> None:
        self.left.append((peer, reason))

    def from_peer(self, peer: Peer) -> list[bytes]:
        """Return the packets that one application sent, in order."""
        return [packet for sender, packet in list(self.packets) if sender == peer]


class ClientLog:
    """A client's handler that records its calls.

    With ``keep=False``, each frame's pixels are compared with :func:`picture` immediately and not stored, and ``torn``
    lists the numbers of frames that differ.
    """

    def __init__(self, *, keep: bool = True) -> None:
        self.keep = keep
        self.packets: list[bytes] = []
        self.frames: list[tuple[FrameHeader, Pixels]] = []
        self.seen: list[int] = []
        self.torn: list[int] = []
        self.closings: list[str] = []
        self.on_packet: Callable[[bytes], None] | None = None
        self.gate = threading.Event()  #: the handler blocks here until this is set
        self.gate.set()

    def packet(self, packet: bytes) -> None:
        self.gate.wait(PATIENCE_S)
        self.packets.append(packet)
        if self.on_packet is not None:
            self.on_packet(packet)

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:  # noqa: ARG002
        self.gate.wait(PATIENCE_S)
        if self.keep:
            self.frames.append((header, pixels))
        elif not np.array_equal(pixels, picture(header)):
            self.torn.append(header.seq)
        self.seen.append(header.seq)

    def saw(self, seq: int) -> bool:
        """Return whether the newest received frame has this number."""
        return self.seen[-1:] == [seq]

    def closed(self, reason: str) -> None:
        self.closings.append(reason)


def header(seq: int, width: int = 32, height: int = 24, camera: str = FRONT) -> FrameHeader:
    """Return the header of a BGR8 frame for tests; both of its timestamps are ``seq`` nanoseconds."""
    return FrameHeader(camera, seq, seq, seq, width, height, Encoding.BGR8, width * height * 3)


def picture(head: FrameHeader) -> Pixels:
    """Return the pixels of a frame for tests, as bytes. Each byte depends on the frame's number."""
    return (np.arange(head.size, dtype=np.uint32) * 7 + head.seq * 31).astype(np.uint8)


class Joined(NamedTuple):
    """A transport client that has joined, its log, and its :class:`Peer` at the server."""

    client: TransportClient
    log: ClientLog
    peer: Peer


def resources() -> tuple[int, int]:
    """Return the number of this process's threads and (from ``/proc``) open descriptors, after garbage collection."""
    gc.collect()
    descriptors = Path("/proc/self/fd")
    return threading.active_count(), len(list(descriptors.iterdir())) if descriptors.exists() else 0
