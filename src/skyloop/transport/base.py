"""The contract for all transports.

A transport carries whole packets between one proxy (the *transport server*) and any number of applications (*transport
clients*). The transport knows packets and topics, but not their meaning. An implementation must pass the tests in
:mod:`skyloop.transport.conformance`.

- No call ever blocks on the other end. A packet that does not fit into the buffer at that moment is not sent, and the
  caller gets False.
- A packet arrives whole or not at all. Packets on a connection stay in order. A packet has 1 to
  :data:`MAX_PACKET` bytes; sending any other raises :class:`skyloop.errors.UsageError`.
- Handlers run on the transport's receiving threads, one call at a time per end, so they must return quickly. A handler
  that raises ends its own connection, not the transport.
- When one end goes away, for whatever reason, the handler at the other end is called once: ``peer_left`` or ``closed``.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import FrameHeader
from skyloop.messages.codec import HEADER_SIZE, MAX_BODY

#: The topics that clients can subscribe to. Even ``feedback`` and ``events`` are optional.
FEEDBACK = "feedback"
EVENTS = "events"
COMMANDS = "commands"  #: echoes (Applied) of all commands received by the proxy
ANNOTATIONS = "annotations"
LOGS = "logs"  #: log entries of applications (LogEntry)
OVERVIEW = "overview"  #: one row for each vehicle in the proxy's process, once a second (Overview)
MAX_TOPIC = 200  #: maximum number of characters in a topic's name
MAX_SUBSCRIPTIONS = 64  #: maximum number of simultaneous topics per connection
RESULTS = "results"  #: results of all processors (ProcessorResult)
MAX_PACKET = HEADER_SIZE + MAX_BODY  #: maximum size of a packet [bytes]


def video(camera: str) -> str:
    """Return the topic of a camera's frames."""
    return f"video/{camera}"


def stream(camera: str) -> str:
    """Return the topic of a camera's frames as encoded by the vehicle (EncodedFrame)."""
    return f"stream/{camera}"


def results(processor: str) -> str:
    """Return the topic of one processor's results (ProcessorResult)."""
    return f"{RESULTS}/{processor}"


_UINT8 = np.dtype(np.uint8)

#: A frame's bytes: shape ``(size,)``, uint8, not writeable. The pixels stay unchanged while any view of them exists.
Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Peer:
    """What the transport server knows about an application's connection."""

    id: int  #: unique in this run of the transport server, from 1
    address: str  #: readable address: process id and user, or host and port


NOBODY = Peer(0, "an unknown application")


class ServerHandler(Protocol):
    """A server's callbacks. They run on its receiving threads, one at a time except for :meth:`topic_problem`."""

    def peer_joined(self, peer: Peer) -> None:
        """Handle a new connection, before its first packet. Later calls identify the peer by an equal ``Peer``."""

    def packet(self, peer: Peer, packet: bytes) -> None:
        """Handle a packet from an application. It has 1 to :data:`MAX_PACKET` bytes, and its content is not checked."""

    def refused(self, peer: Peer, reason: str) -> None:
        """Handle a packet that was dropped because its sender's keys forbid it. :data:`NOBODY`: an unknown sender."""

    def topic_problem(self, topic: str) -> str:
        """Return why a topic can't be subscribed to, and which topics exist; empty if it can.

        May be called on any thread, even while another callback runs; must return at once.
        """

    def malformed(self, peer: Peer, reason: str) -> None:
        """Handle a request for an unknown topic, or for more topics than are allowed. ``reason`` is readable text."""

    def peer_left(self, peer: Peer, reason: str) -> None:
        """Handle the end of a connection. Called once for each ``peer_joined``, after the last packet."""


class TransportServer(ABC):
    """A proxy's end of a transport. Between :meth:`start` and :meth:`stop`, methods may be called from any thread."""

    @abstractmethod
    def start(self, handler: ServerHandler) -> None:
        """Begin accepting connections; the handler is called on receiving threads, one call at a time.

        Raises :class:`NameTakenError` if a running proxy already uses the name.
        """

    @abstractmethod
    def stop(self) -> None:
        """Disconnect all applications and release all resources. Idempotent."""

    @abstractmethod
    def send(self, peer: Peer, packet: bytes) -> bool:
        """Send a packet to one application. Return False if the application has left or its buffer is full."""

    @abstractmethod
    def publish(self, topic: str, packet: bytes) -> int:
        """Send a packet to every subscriber of a topic; return the number of subscribers that did *not* receive it."""

    @abstractmethod
    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        """Send a frame to every subscriber of its camera; return the number of subscribers that did *not* receive it.

        ``pixels``: ``header.size`` bytes of dtype uint8, in any shape, C-contiguous. Otherwise :class:`UsageError` is
        raised. The pixels may be reused after the call.
        """

    @abstractmethod
    def subscribers(self, topic: str) -> int:
        """Return the number of a topic's subscribers. If a topic has no subscribers, samples need not be produced."""

    def admit(self, peer: Peer, *, pilot: bool) -> str:  # noqa: ARG002  (the default admits all)
        """Return why an application that has identified itself must leave; empty if it may stay (the default).

        For example, the remaining places may be reserved for pilots.
        """
        return ""

    @abstractmethod
    def disconnect(self, peer: Peer, reason: str) -> None:
        """End one connection. ``peer_left`` and the application get the reason. Does nothing if it is already gone."""

    @property
    def counters(self) -> dict[str, float]:
        """This end's counters since it was started, by dotted name, for the proxy's statistics."""
        return {}

    @property
    def restricted(self) -> bool:
        """Whether an application may have access to this proxy but not to others, as with keys that name drones."""
        return False

    @property
    @abstractmethod
    def address(self) -> str:
        """Readable address of this end of the connection."""


class ClientHandler(Protocol):
    """A transport client's callbacks. They run on its receiving thread, one at a time."""

    def packet(self, packet: bytes) -> None:
        """Handle a packet from the proxy."""

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:
        """Handle a frame: ``header.size`` bytes, shape (size,), dtype uint8, not writeable.

        The handler may keep the pixels, or any view of them, for as long as it likes; this affects only its own
        application. ``topic``: the subscribed topic that the frame belongs to, if :attr:`TransportClient.variants` is
        true.
        """

    def closed(self, reason: str) -> None:
        """Handle the end of the connection, regardless of which end closed it. Called once, as the last callback."""


class TransportClient(ABC):
    """An application's end: a single connection, made by a :data:`Dialer`. It can't be reused once it is closed."""

    @abstractmethod
    def send(self, packet: bytes) -> bool:
        """Send a packet to the proxy. Return whether the packet was handed over. Any thread."""

    @abstractmethod
    def subscribe(self, topic: str, on: bool = True) -> None:
        """Subscribe to a topic, or end the subscription. Any thread.

        Raises :class:`UsageError` unless the name has 1 to :data:`MAX_TOPIC` characters.
        """

    @abstractmethod
    def close(self) -> None:
        """End the connection. Idempotent. ``closed`` is called before this returns, except on the receiving thread."""

    def lead(self, ready: Callable[[], bool], wake: Callable[[], None], timeout_s: float) -> bool:  # noqa: ARG002
        """Receive on the calling thread while it waits, so that a sample wakes only one thread rather than two.

        Meanwhile the handler runs on this thread, still one call at a time. Returns False if another thread is
        receiving. The caller must then wait as usual, and ``wake`` is called once, on another thread, when a retry may
        succeed. By default, this is not supported. ``ready`` returns whether the wait is over. It is called on this
        thread after each packet and several times a second. The call may take 50 ms longer than ``timeout_s`` [s].
        """
        return False

    @property
    def receiving(self) -> bool:
        """Whether the calling thread is inside :meth:`lead`, and therefore must not wait for its own packets."""
        return False

    @property
    @abstractmethod
    def same_clock(self) -> bool:
        """Whether both ends are on one host and read the same monotonic clock. If so, the offset is zero.

        An application also checks the clock that ``Welcome`` names, because a host can have several time namespaces.
        """

    @property
    def variants(self) -> bool:
        """Whether frames arrive in the format that each topic requests (:class:`skyloop.messages.VideoRequest`).

        If not, all frames arrive unchanged, and each camera has only its plain topic.
        """
        return False

    @property
    def excused_s(self) -> float:
        """How much longer than usual the other end may be silent before the link counts as lost [s]."""
        return 0.0

    @property
    @abstractmethod
    def address(self) -> str:
        """Readable address that this end is connected to."""


#: Connects and starts delivering packets to the handler. Raises :class:`skyloop.errors.LinkError` if that fails.
Dialer = Callable[[ClientHandler], TransportClient]


#: Valid names for proxies. Each name can be used as the file name of a socket and as one chunk of a network key.
NAME: Final = re.compile(r"[a-z0-9][a-z0-9_.-]{0,47}")


def check_name(name: str) -> None:
    """Raise :class:`UsageError` unless this is a valid name for a proxy (:data:`NAME`)."""
    if not NAME.fullmatch(name):
        raise UsageError(
            f"{name!r} cannot be the name of a proxy: 1 to 48 lower-case letters, digits, '_', '-' and '.', "
            "the first one a letter or a digit"
        )


def check_packet(packet: bytes) -> None:
    """Raise :class:`UsageError` unless a packet has 1 to :data:`MAX_PACKET` bytes."""
    if not 0 < len(packet) <= MAX_PACKET:
        raise UsageError(f"a packet of {len(packet)} bytes cannot be sent; it must have 1 to {MAX_PACKET}")


def check_topic(topic: str) -> None:
    """Raise :class:`UsageError` unless a topic's name has 1 to :data:`MAX_TOPIC` characters."""
    if not 0 < len(topic) <= MAX_TOPIC:
        raise UsageError(f"the topic {topic[:100]!r} has {len(topic)} characters; it must have 1 to {MAX_TOPIC}")


def too_many_topics(topic: str) -> str:
    """Return why an application that has :data:`MAX_SUBSCRIPTIONS` topics can't get another."""
    return f"{topic[:64]!r} exceeds the {MAX_SUBSCRIPTIONS} topics that a connection may subscribe to"


def check_frame(header: FrameHeader, pixels: Pixels) -> None:
    """Raise :class:`UsageError` unless the pixels match their header in size, dtype and order."""
    if pixels.nbytes != header.size or pixels.dtype != _UINT8 or not pixels.flags.c_contiguous:
        order = "" if pixels.flags.c_contiguous else ", not C-contiguous"
        raise UsageError(
            f"a frame of camera {header.camera!r} announces {header.size} bytes, but its pixels are {pixels.nbytes} "
            f"bytes of {pixels.dtype}{order}; they must be that many of uint8, C-contiguous"
        )
