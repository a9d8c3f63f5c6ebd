"""The one contract that every transport keeps.

A transport carries whole packets between one proxy (the *server end*) and any number of applications (*client ends*):
it knows packets and topics, but not what they mean. Whoever implements it passes
:mod:`skyloop.transport.conformance`.

- Nothing here ever blocks on the other end. What does not fit now is not sent, and the caller is told.
- A packet arrives whole or not at all. Order is kept within one connection. It has 1 to :data:`MAX_PACKET` bytes;
  whoever tries to send another gets a :class:`skyloop.errors.UsageError`.
- Handlers are called on the transport's receiving threads, one call at a time per end: return quickly. A handler that
  raises ends its own connection, not the transport.
- When one end goes away, however it ends, the other is told by ``peer_left`` or ``closed``, once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import FrameHeader
from skyloop.messages.codec import HEADER_SIZE, MAX_BODY

#: What a client end can ask to be sent. ``feedback`` and ``events`` may be left out by an application that needs none.
FEEDBACK = "feedback"
EVENTS = "events"
COMMANDS = "commands"  #: echoes (Applied) of all commands that the proxy received
ANNOTATIONS = "annotations"
LOGS = "logs"  #: what applications log (LogEntry)
MAX_TOPIC = 200  #: characters
RESULTS = "results"  #: what all processors find (ProcessorResult)
MAX_PACKET = HEADER_SIZE + MAX_BODY  #: bytes


def video(camera: str) -> str:
    """The topic of a camera's frames."""
    return f"video/{camera}"


def stream(camera: str) -> str:
    """The topic of a camera's pictures as the vehicle encoded them (EncodedFrame)."""
    return f"stream/{camera}"


def results(processor: str) -> str:
    """The topic of what one processor finds (ProcessorResult)."""
    return f"{RESULTS}/{processor}"


_UINT8 = np.dtype(np.uint8)

#: Bytes of a frame: shape (size,), uint8, not writeable. They stay as they are for as long as any view of them lives.
Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Peer:
    """An application's connection as the server end sees it."""

    id: int  #: unique in this run of the server end, from 1
    address: str  #: for people: process id and user, or host and port


NOBODY = Peer(0, "nobody that is connected")


class ServerHandler(Protocol):
    """What a server end calls."""

    def peer_joined(self, peer: Peer) -> None:
        """A client end connected. Nothing was received from it yet."""

    def packet(self, peer: Peer, packet: bytes) -> None:
        """A packet came. It may be anything: the transport does not look inside."""

    def refused(self, peer: Peer, reason: str) -> None:
        """A packet came that this application has no right to send, by the keys that it has; it was not handed on.

        ``peer`` is :data:`NOBODY` where none is known.
        """

    def peer_left(self, peer: Peer, reason: str) -> None:
        """The connection ended; called once per ``peer_joined``, after its last packet."""


class ServerEnd(ABC):
    """A proxy's end. Between :meth:`start` and :meth:`stop` all methods may be called from any thread."""

    @abstractmethod
    def start(self, handler: ServerHandler) -> None:
        """Begin to accept. Raises :class:`skyloop.errors.NameTakenError` where the name is in use."""

    @abstractmethod
    def stop(self) -> None:
        """Disconnect everybody and give every resource back. Idempotent."""

    @abstractmethod
    def send(self, peer: Peer, packet: bytes) -> bool:
        """Send to one application; False if its buffer is full or it is gone."""

    @abstractmethod
    def publish(self, topic: str, packet: bytes) -> int:
        """Send to everybody subscribed; returns to how many it could *not* be handed over."""

    @abstractmethod
    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        """Hand a frame to everybody subscribed to its camera; returns to how many it could not be handed over.

        ``pixels`` has ``header.size`` bytes in any shape, C-contiguous; it may be reused when the call returns.
        """

    @abstractmethod
    def subscribers(self, topic: str) -> int:
        """How many want this topic: work for nobody need not be done."""

    @abstractmethod
    def disconnect(self, peer: Peer, reason: str) -> None:
        """End one connection; its ``peer_left`` follows with this reason."""

    @property
    @abstractmethod
    def address(self) -> str:
        """Where it can be reached, for people."""


class ClientHandler(Protocol):
    """What a client end calls."""

    def packet(self, packet: bytes) -> None:
        """A packet came."""

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:
        """A frame came; ``topic`` is the one by which it was asked for where :attr:`ClientEnd.variants` is true.

        Keep ``pixels`` (or any view) for as long as needed: it costs only this application."""

    def closed(self, reason: str) -> None:
        """The connection ended, by whichever end; called once, last."""


class ClientEnd(ABC):
    """An application's end: one connection, made by a :data:`Dialer`, never re-used after it closed."""

    @abstractmethod
    def send(self, packet: bytes) -> bool:
        """Send to the proxy; False if it could not be handed over. Any thread."""

    def knock(self) -> None:  # noqa: B027  (nothing is a good answer)
        """Say that a packet follows at once, so that the other end wakes up while it is still being made.

        It changes nothing but delays: a transport that gains nothing by it does nothing. Any thread.
        """

    @abstractmethod
    def subscribe(self, topic: str, on: bool = True) -> None:
        """Ask for a topic, or no longer. Any thread. Raises :class:`skyloop.errors.UsageError` for a name too long."""

    @abstractmethod
    def close(self) -> None:
        """End the connection. Idempotent; ``closed`` is called before this returns, unless on the receiving thread."""

    @property
    @abstractmethod
    def same_clock(self) -> bool:
        """Whether both ends read the same monotonic clock (one host), so that no offset needs estimating."""

    @property
    def variants(self) -> bool:
        """Whether frames come as each topic asks (:class:`skyloop.messages.VideoRequest`); else all come as they are,
        and only the plain topic of a camera may be subscribed to."""
        return False

    @property
    @abstractmethod
    def address(self) -> str:
        """What it is connected to, for people."""


#: Makes a connection and begins to deliver to the handler. Raises :class:`skyloop.errors.LinkError` when it cannot.
Dialer = Callable[[ClientHandler], ClientEnd]


def check_packet(packet: bytes) -> None:
    """Raise :class:`skyloop.errors.UsageError` for a packet that no transport carries."""
    if not 0 < len(packet) <= MAX_PACKET:
        raise UsageError(f"a packet of {len(packet)} bytes cannot be sent; it must have 1 to {MAX_PACKET}")


def check_topic(topic: str) -> None:
    """Raise :class:`skyloop.errors.UsageError` for what cannot be a topic."""
    if not 0 < len(topic) <= MAX_TOPIC:
        raise UsageError(f"the topic {topic[:100]!r} has {len(topic)} characters; it must have 1 to {MAX_TOPIC}")


def check_frame(header: FrameHeader, pixels: Pixels) -> None:
    """Raise :class:`skyloop.errors.UsageError` for pixels that are not what their header says."""
    if pixels.nbytes != header.size or pixels.dtype != _UINT8 or not pixels.flags.c_contiguous:
        order = "" if pixels.flags.c_contiguous else ", not C-contiguous"
        raise UsageError(
            f"a frame of camera {header.camera!r} announces {header.size} bytes, but its pixels are {pixels.nbytes} "
            f"bytes of {pixels.dtype}{order}; they must be that many of uint8, C-contiguous"
        )
