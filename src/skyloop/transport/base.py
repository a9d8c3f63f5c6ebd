"""The contract that every transport keeps.

A transport carries whole packets between one proxy (the *transport server*) and any number of applications (*transport
clients*). It knows packets and topics, but not what they mean. An implementation passes the tests of
:mod:`skyloop.transport.conformance`.

- No call ever blocks on the other end. A packet that does not fit now is not sent, and the caller gets False.
- A packet arrives whole or not at all. Order is kept within one connection. A packet has 1 to :data:`MAX_PACKET`
  bytes; sending any other raises :class:`skyloop.errors.UsageError`.
- Handlers are called on the transport's receiving threads, one call at a time per end, so they must return quickly. A
  handler that raises ends its own connection, not the transport.
- When one end goes away, for whatever reason, the other one's handler is called once, with ``peer_left`` or
  ``closed``.
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

#: What a client can ask to be sent. ``feedback`` and ``events`` may be left out by an application that needs none.
FEEDBACK = "feedback"
EVENTS = "events"
COMMANDS = "commands"  #: echoes (Applied) of all commands that the proxy received
ANNOTATIONS = "annotations"
LOGS = "logs"  #: what applications log (LogEntry)
OVERVIEW = "overview"  #: a row of each vehicle of the proxy's process, once a second (Overview)
MAX_TOPIC = 200  #: characters
MAX_SUBSCRIPTIONS = 64  #: topics of one connection at a time
RESULTS = "results"  #: what all processors find (ProcessorResult)
MAX_PACKET = HEADER_SIZE + MAX_BODY  #: bytes


def video(camera: str) -> str:
    """Return the topic of a camera's frames."""
    return f"video/{camera}"


def stream(camera: str) -> str:
    """Return the topic of a camera's pictures as the vehicle encoded them (EncodedFrame)."""
    return f"stream/{camera}"


def results(processor: str) -> str:
    """Return the topic of what one processor finds (ProcessorResult)."""
    return f"{RESULTS}/{processor}"


_UINT8 = np.dtype(np.uint8)

#: Bytes of a frame: shape (size,), uint8, not writeable. They stay as they are for as long as any view of them lives.
Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Peer:
    """An application's connection as the transport server sees it."""

    id: int  #: unique in this run of the transport server, from 1
    address: str  #: for people: process id and user, or host and port


NOBODY = Peer(0, "an unknown application")


class ServerHandler(Protocol):
    """The callbacks of a transport server.

    Except for :meth:`topic_problem` they run on the transport's receiving threads, one call at a time.
    """

    def peer_joined(self, peer: Peer) -> None:
        """Handle a new connection; nothing was received from it yet.

        Args:
            peer: The connection; the same object or an equal one identifies it in all later calls.
        """

    def packet(self, peer: Peer, packet: bytes) -> None:
        """Handle a packet from an application.

        Args:
            peer: Who sent it.
            packet: 1 to :data:`MAX_PACKET` bytes. They may be anything: the transport does not look inside.
        """

    def refused(self, peer: Peer, reason: str) -> None:
        """Handle the refusal of a packet that the application's keys give it no right to send; it is not delivered.

        Args:
            peer: Who sent it; :data:`NOBODY` where no connection is known.
            reason: Why it was refused, for people.
        """

    def topic_problem(self, topic: str) -> str:
        """Say why nobody can subscribe to a topic.

        It may be called on any thread, also while another callback runs, and must answer at once.

        Args:
            topic: The name that an application asks for.

        Returns:
            Why there is no such topic, naming those that there are; empty if it exists.
        """

    def malformed(self, peer: Peer, reason: str) -> None:
        """Handle a request to the transport itself that can't be met.

        The application asked for a topic that does not exist, or for more topics than it may have.

        Args:
            peer: Who asked.
            reason: What was wrong, for people.
        """

    def peer_left(self, peer: Peer, reason: str) -> None:
        """Handle the end of a connection; called once for each ``peer_joined``, after the connection's last packet.

        Args:
            peer: The connection.
            reason: Why it ended, for people.
        """


class TransportServer(ABC):
    """A proxy's side of a transport.

    Between :meth:`start` and :meth:`stop` all methods may be called from any thread.
    """

    @abstractmethod
    def start(self, handler: ServerHandler) -> None:
        """Begin to accept connections.

        Args:
            handler: Called on the transport's receiving threads, one call at a time.

        Raises:
            NameTakenError: A running proxy uses the name.
        """

    @abstractmethod
    def stop(self) -> None:
        """Disconnect every application and release every resource. Idempotent."""

    @abstractmethod
    def send(self, peer: Peer, packet: bytes) -> bool:
        """Send a packet to one application.

        Args:
            peer: The application, as given to the handler.
            packet: 1 to :data:`MAX_PACKET` bytes.

        Returns:
            Whether it was handed over; False if the application's buffer is full or the application is gone.

        Raises:
            UsageError: The packet is empty or too large.
        """

    @abstractmethod
    def publish(self, topic: str, packet: bytes) -> int:
        """Send a packet to every subscriber of a topic.

        Args:
            topic: A topic such as :data:`FEEDBACK`.
            packet: 1 to :data:`MAX_PACKET` bytes.

        Returns:
            The number of subscribers to which it could *not* be handed over.

        Raises:
            UsageError: The packet is empty or too large.
        """

    @abstractmethod
    def publish_frame(self, header: FrameHeader, pixels: Pixels) -> int:
        """Send a frame to every subscriber of its camera.

        Args:
            header: The frame's header.
            pixels: ``header.size`` bytes, dtype uint8, in any shape, C-contiguous; may be reused when the call returns.

        Returns:
            The number of subscribers to which it could *not* be handed over.

        Raises:
            UsageError: The pixels are not as in the header.
        """

    @abstractmethod
    def subscribers(self, topic: str) -> int:
        """Return how many applications subscribed to a topic; what nobody subscribed to need not be made."""

    def admit(self, peer: Peer, *, pilot: bool) -> str:  # noqa: ARG002  (all are let stay)
        """Decide whether an application that has sent who it is may stay: some places are kept for pilots.

        The default lets every application stay.

        Args:
            peer: The application's connection.
            pilot: Whether it stated that it is a pilot.

        Returns:
            Why it can't stay; empty if it can.
        """
        return ""

    @abstractmethod
    def disconnect(self, peer: Peer, reason: str) -> None:
        """End one connection; its ``peer_left`` follows with this reason. Does nothing if the connection is gone.

        Args:
            peer: The application's connection.
            reason: Why, for people; both ends' handlers get it.
        """

    @property
    def counters(self) -> dict[str, float]:
        """What this end has counted since it started, by dotted name, for the proxy's statistics. Any thread."""
        return {}

    @property
    def restricted(self) -> bool:
        """Whether an application that may connect here may be kept from other proxies, as by keys that name drones."""
        return False

    @property
    @abstractmethod
    def address(self) -> str:
        """Where this end can be reached, for people."""


class ClientHandler(Protocol):
    """The callbacks of a transport client.

    They run on the transport's receiving thread, one call at a time.
    """

    def packet(self, packet: bytes) -> None:
        """Handle a packet from the proxy."""

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:
        """Handle a frame.

        Args:
            header: The frame's header.
            pixels: ``header.size`` bytes, shape (size,), dtype uint8, not writeable. They, or any view of them, may be
                kept for as long as needed: that costs only this application.
            topic: The topic by which the frame was asked for, where :attr:`TransportClient.variants` is true.
        """

    def closed(self, reason: str) -> None:
        """Handle the end of the connection, by whichever end; called once, as the last callback.

        Args:
            reason: Why it ended, for people.
        """


class TransportClient(ABC):
    """An application's side: one connection, made by a :data:`Dialer` and never reused after it closed."""

    @abstractmethod
    def send(self, packet: bytes) -> bool:
        """Send a packet to the proxy. Any thread.

        Args:
            packet: 1 to :data:`MAX_PACKET` bytes.

        Returns:
            Whether it was handed over.

        Raises:
            UsageError: The packet is empty or too large.
        """

    @abstractmethod
    def subscribe(self, topic: str, on: bool = True) -> None:
        """Subscribe to a topic, or unsubscribe from it. Any thread.

        Args:
            topic: Its name, 1 to :data:`MAX_TOPIC` characters.
            on: True to subscribe, False to unsubscribe.

        Raises:
            UsageError: The name is empty or too long.
        """

    @abstractmethod
    def close(self) -> None:
        """End the connection. Idempotent.

        The handler's ``closed`` is called before this returns, unless this runs on the receiving thread.
        """

    def lead(self, ready: Callable[[], bool], wake: Callable[[], None], timeout_s: float) -> bool:  # noqa: ARG002
        """Receive on the calling thread while it waits, so that what it waits for wakes one thread and not two.

        The handler is called on this thread meanwhile, still one call at a time. The default can't.

        Args:
            ready: Whether the wait is over; called on this thread after each packet, and some times a second.
            wake: Called once, on another thread, when trying again may succeed; not if this returns True.
            timeout_s: How long to receive [s]; may take 50 ms longer.

        Returns:
            Whether this thread did the receiving; False if another one does, and the caller waits as ever.
        """
        return False

    @property
    def receiving(self) -> bool:
        """Whether the calling thread has been lent to :meth:`lead`, and must not wait for what it would receive."""
        return False

    @property
    @abstractmethod
    def same_clock(self) -> bool:
        """Whether both ends read the same monotonic clock (one host), so that no offset has to be estimated.

        An application also checks what the proxy's Welcome says, for a host can have several time namespaces.
        """

    @property
    def variants(self) -> bool:
        """Whether frames come in the form that each topic asks for (:class:`skyloop.messages.VideoRequest`).

        Where it is false, all frames come as they are, and only the plain topic of a camera may be subscribed to.
        """
        return False

    @property
    def excused_s(self) -> float:
        """For how much longer than usual the other end may be silent before the link counts as lost [s]."""
        return 0.0

    @property
    @abstractmethod
    def address(self) -> str:
        """What this end is connected to, for people."""


#: Makes a connection and begins to deliver to the handler. Raises :class:`skyloop.errors.LinkError` when it cannot.
Dialer = Callable[[ClientHandler], TransportClient]


#: What can be the name of a proxy: one of a socket's file and of one chunk of a network key.
NAME: Final = re.compile(r"[a-z0-9][a-z0-9_.-]{0,47}")


def check_name(name: str) -> None:
    """Check the name of a proxy.

    Args:
        name: 1 to 48 lower-case letters, digits, ``_``, ``-`` and ``.``, the first one a letter or digit.

    Raises:
        UsageError: It is anything else.
    """
    if not NAME.fullmatch(name):
        raise UsageError(
            f"{name!r} cannot be the name of a proxy: 1 to 48 lower-case letters, digits, '_', '-' and '.', "
            "the first one a letter or a digit"
        )


def check_packet(packet: bytes) -> None:
    """Check the size of a packet.

    Args:
        packet: 1 to :data:`MAX_PACKET` bytes.

    Raises:
        UsageError: It is empty or too large.
    """
    if not 0 < len(packet) <= MAX_PACKET:
        raise UsageError(f"a packet of {len(packet)} bytes cannot be sent; it must have 1 to {MAX_PACKET}")


def check_topic(topic: str) -> None:
    """Check the length of a topic's name.

    Args:
        topic: 1 to :data:`MAX_TOPIC` characters.

    Raises:
        UsageError: It is empty or too long.
    """
    if not 0 < len(topic) <= MAX_TOPIC:
        raise UsageError(f"the topic {topic[:100]!r} has {len(topic)} characters; it must have 1 to {MAX_TOPIC}")


def too_many_topics(topic: str) -> str:
    """Return why an application that has :data:`MAX_SUBSCRIPTIONS` topics gets no further one."""
    return f"{topic[:64]!r} would be one more than the {MAX_SUBSCRIPTIONS} topics that a connection may subscribe to"


def check_frame(header: FrameHeader, pixels: Pixels) -> None:
    """Check that pixels are as in their header.

    Args:
        header: The frame's header.
        pixels: ``header.size`` bytes, dtype uint8, C-contiguous, in any shape.

    Raises:
        UsageError: The size, dtype or order differs.
    """
    if pixels.nbytes != header.size or pixels.dtype != _UINT8 or not pixels.flags.c_contiguous:
        order = "" if pixels.flags.c_contiguous else ", not C-contiguous"
        raise UsageError(
            f"a frame of camera {header.camera!r} announces {header.size} bytes, but its pixels are {pixels.nbytes} "
            f"bytes of {pixels.dtype}{order}; they must be that many of uint8, C-contiguous"
        )
