"""What tests of transports, and of what stands on them, have in common: ends that write down what they were told.

Nothing here sleeps to wait: :func:`wait_until` waits for what must come, for at most :data:`PATIENCE_S`.
"""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from skyloop.messages import Encoding, FrameHeader
from skyloop.transport.base import ClientEnd, Peer, Pixels

PATIENCE_S: Final = 15.0
FRONT: Final = "front"


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Return as soon as the condition holds; fail if it does not in time."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited {PATIENCE_S} s in vain until {what}"
        time.sleep(0.001)


def raises(error: type[Exception], call: Callable[[], object]) -> None:
    """Fail unless the call raises the error."""
    try:
        call()
    except error:
        return
    raise AssertionError(f"{error.__name__} was not raised")


class ServerLog:
    """A server's handler that writes down what it was told."""

    def __init__(self) -> None:
        self.joined: list[Peer] = []
        self.packets: list[tuple[Peer, bytes]] = []
        self.left: list[tuple[Peer, str]] = []
        self.refusals: list[tuple[Peer, str]] = []
        self.on_packet: Callable[[Peer, bytes], None] | None = None

    def peer_joined(self, peer: Peer) -> None:
        self.joined.append(peer)

    def packet(self, peer: Peer, packet: bytes) -> None:
        self.packets.append((peer, packet))
        if self.on_packet is not None:
            self.on_packet(peer, packet)

    def refused(self, peer: Peer, reason: str) -> None:
        self.refusals.append((peer, reason))

    def peer_left(self, peer: Peer, reason: str) -> None:
        self.left.append((peer, reason))

    def from_peer(self, peer: Peer) -> list[bytes]:
        """What one application sent."""
        return [packet for sender, packet in list(self.packets) if sender == peer]


class ClientLog:
    """A client's handler that writes down what it was told, and keeps the frames while ``keep`` is true."""

    def __init__(self, *, keep: bool = True) -> None:
        self.keep = keep
        self.packets: list[bytes] = []
        self.frames: list[tuple[FrameHeader, Pixels]] = []
        self.seen: list[int] = []
        self.torn: list[int] = []
        self.closings: list[str] = []
        self.on_packet: Callable[[bytes], None] | None = None
        self.gate = threading.Event()  #: the handler stops here while it is not set
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
        """Whether this is the newest frame that came."""
        return self.seen[-1:] == [seq]

    def closed(self, reason: str) -> None:
        self.closings.append(reason)


def header(seq: int, width: int = 32, height: int = 24, camera: str = FRONT) -> FrameHeader:
    """A frame's header for the tests."""
    return FrameHeader(camera, seq, seq, seq, width, height, Encoding.BGR8, width * height * 3)


def picture(head: FrameHeader) -> Pixels:
    """Pixels that tell one frame from every other, in each byte."""
    return (np.arange(head.size, dtype=np.uint32) * 7 + head.seq * 31).astype(np.uint8)


class Joined:
    """A client end that joined, its log, and how the server knows it."""

    def __init__(self, client: ClientEnd, log: ClientLog, peer: Peer) -> None:
        self.client = client
        self.log = log
        self.peer = peer


def resources() -> tuple[int, int]:
    """Threads and, where this can be told, open descriptors of this process."""
    gc.collect()
    descriptors = Path("/proc/self/fd")
    return threading.active_count(), len(list(descriptors.iterdir())) if descriptors.exists() else 0
