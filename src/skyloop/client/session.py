"""Run one session with a proxy from the first packet to the last: transport callbacks and requests."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

from skyloop.client.monitoring import LinkMonitor, OffsetEstimator, StallWatch, Thresholds
from skyloop.clock import Clock, clock_identity, nanoseconds
from skyloop.errors import DecodeError, LinkError, NoAnswerError
from skyloop.messages import (
    AnyReply,
    AnyRequest,
    Feedback,
    FeedbackRequest,
    FrameHeader,
    LinkState,
    Ping,
    Pong,
    Reply,
    Request,
    Sample,
    VideoRequest,
    Welcome,
    decode,
    encode,
)
from skyloop.messages.fields import CHANNELS
from skyloop.messages.subscription import EVERY_SAMPLE
from skyloop.transport.base import FEEDBACK, Dialer, Pixels, stream, video

RETRY_S = 0.3  #: interval at which unanswered requests are repeated; all requests are idempotent

#: A callback that is called once, with either the answer to a request or an error.
Done = Callable[[AnyReply | LinkError], None]


@dataclass(slots=True)
class _Pending:
    packet: bytes
    what: str
    done: Done
    deadline_ns: int
    retry_ns: int
    timeout_s: float


class Requests:
    """Unanswered requests of one connection. Requests are idempotent and are repeated until answered."""

    def __init__(self, send: Callable[[bytes], bool]) -> None:
        self._send = send
        self._pending: dict[int, _Pending] = {}
        self._lock = threading.Lock()
        self._last_id = 0
        self._failed: LinkError | None = None

    def ask(self, body: AnyRequest, done: Done, timeout_s: float, now_ns: int, *, again_s: float = RETRY_S) -> None:
        """Send a request, and repeat it after ``again_s`` and then every 0.3 s until it is answered.

        ``done`` is called once: on the receiving thread, on the thread that calls :meth:`tick` or :meth:`fail`, or on
        the calling thread if the connection has already failed. After ``timeout_s``, it gets a :class:`NoAnswerError`.
        """
        with self._lock:
            failed = self._failed
            if failed is None:
                self._last_id += 1
                number = self._last_id
                packet = encode(Request(number, body))
                deadline_ns, again_ns = now_ns + nanoseconds(timeout_s), now_ns + nanoseconds(again_s)
                self._pending[number] = _Pending(packet, type(body).__name__, done, deadline_ns, again_ns, timeout_s)
        if failed is not None:
            done(failed)
        else:
            self._send(packet)  # if the transport can't take it now, tick() sends it again

    def answered(self, reply: Reply) -> bool:
        """Handle an answer; return False if the request is unknown or has timed out."""
        with self._lock:
            pending = self._pending.pop(reply.id, None)
        if pending is None:
            return False
        pending.done(reply.body)
        return True

    def tick(self, now_ns: int) -> None:
        """Repeat unanswered requests, and abandon overdue ones."""
        if not self._pending:
            return
        with self._lock:
            overdue = [number for number, pending in self._pending.items() if now_ns >= pending.deadline_ns]
            given_up = [self._pending.pop(number) for number in overdue]
            again = [pending for pending in self._pending.values() if now_ns >= pending.retry_ns]
            for pending in again:
                pending.retry_ns = now_ns + nanoseconds(RETRY_S)
        for pending in again:
            self._send(pending.packet)
        for pending in given_up:
            pending.done(NoAnswerError(f"the proxy did not answer {pending.what} within {pending.timeout_s:g} s"))

    def fail(self, error: LinkError) -> None:
        """Answer all pending and future requests with ``error``, because the connection is gone."""
        with self._lock:
            self._failed = error
            pending, self._pending = list(self._pending.values()), {}
        for one in pending:
            one.done(error)


PING_S: Final = 1.0  #: time limit for a ping
FEEDBACK_STALL_S: Final = 1.0  #: time without feedback from a responding proxy before resubscribing
_VIDEOS: Final = (video(""), stream(""))
_PING_CLOCK_NS: Final = nanoseconds(1.0)  #: how often to measure the offset of a proxy's clock that differs from ours
_PING_FIRST_NS: Final = nanoseconds(0.1)  #: the same interval for the first few round trips
_FIRST_TRIPS: Final = 5  #: number of round trips measured at this shorter interval


class ConnectionHandler(Protocol):
    """Receives samples on the receiving thread, and connection changes on the supervisor's thread."""

    def connected(self, welcome: Welcome) -> None: ...  #: a proxy has answered Hello, and has sent nothing else yet
    def disconnected(self) -> None: ...
    def link_changed(self, state: LinkState, reason: str) -> None: ...
    def tick(self, now_ns: int) -> int: ...  #: does all due work; returns the latest time of the next call [ns]
    def feedback(self, sample: Feedback, now_ns: int) -> None: ...
    def frame(self, header: FrameHeader, pixels: Pixels, now_ns: int, topic: str = "") -> None: ...
    @property
    def samples(self) -> Mapping[type, Callable[[Any, int], None]]: ...  #: returns the handlers of all other samples


class ProxySession:
    """Decodes and counts packets on the transport's receiving thread, and passes the samples to the handler.

    Implements :class:`skyloop.transport.base.ClientHandler` for one connection.
    """

    def __init__(
        self, handler: ConnectionHandler, poke: Callable[[], None], thresholds: Thresholds, clock: Clock, dial: Dialer
    ) -> None:
        """Connect to the proxy; ``poke`` wakes the supervisor. Raises the dialer's errors."""
        self._handler = handler
        self._poke = poke
        self._clock = clock
        self.open = True  #: False once either end has closed the session
        self._quiet = False  # whether this end has closed the session; later arrivals are ignored
        self._up = False
        self._pinged_ns = 0
        self._pinged = False  # whether a ping is unanswered
        self._trips = OffsetEstimator()
        self._video_users: dict[str, set[str]] = {}  # by topic of the transport: the requested topics that it serves
        self._handlers: dict[type, Callable[..., None]] = {**handler.samples, Reply: self._reply}
        self._take_feedback = handler.feedback
        self._feedback = EVERY_SAMPLE  # the feedback requested in this session
        self._only_plain = False  # whether only every sample may be requested, because a reduced rate brought none
        self._feedback_watch = StallWatch(FEEDBACK_STALL_S, clock())
        self.monitor = LinkMonitor(thresholds, clock())
        self.requests = Requests(self.send)
        self.offset_ns = 0  #: the proxy's clock minus ours
        self.closed_reason: str | None = None  #: why the session ended; None while it is open
        self.receiver = 0  #: identity of the receiving thread
        self.check_ns = 0  #: time at which the supervisor next evaluates the session's state
        self._end = dial(self)  # must be last, because packets may arrive immediately
        self._same_clock = self._end.same_clock
        self.monitor.excuse(self._end.excused_s)

    # Set-up and end --------------------------------------------------------------------------------------------

    def welcomed(self, welcome: Welcome, sent_ns: int) -> None:
        """Use the answer to a Hello sent at ``sent_ns`` as the first measurement of the clock offset.

        On one host, both processes read the same clock unless they are in different time namespaces.
        """
        if welcome.clock and welcome.clock != clock_identity():
            self._same_clock = False
        if not self._same_clock:
            self.offset_ns = self._trips.add(sent_ns, welcome.now_ns, self._clock()).ns

    def close(self, error: LinkError) -> None:
        """End the session and fail unanswered requests with ``error``."""
        self._quiet, self.open = True, False
        self._end.close()
        self.requests.fail(error)

    @property
    def adapts_frames(self) -> bool:
        """Whether frames arrive in the requested form; see :class:`skyloop.transport.base.TransportClient`."""
        return self._end.variants

    @property
    def address(self) -> str:
        return self._end.address

    # Sending ---------------------------------------------------------------------------------------------------

    @property
    def transmit(self) -> Callable[[bytes], bool]:
        """The transport's own send function, without another layer, for frequent packets."""
        return self._end.send

    def send(self, packet: bytes) -> bool:
        """Hand a packet to the transport; return False on failure."""
        return not self._quiet and self._end.send(packet)

    def lead(self, ready: Callable[[], bool], wake: Callable[[], None], timeout_s: float) -> bool:
        """Receive on the calling thread; see :meth:`skyloop.transport.base.TransportClient.lead`."""
        return not self._quiet and self._end.lead(ready, wake, timeout_s)

    @property
    def receiving(self) -> bool:
        """Whether the calling thread is the thread that currently receives."""
        return self.receiver == threading.get_ident() or self._end.receiving

    def subscribe(self, topic: str, on: bool) -> None:
        """Subscribe to or unsubscribe from a topic. Video that several requests share is subscribed to only once."""
        if topic.startswith(_VIDEOS):
            carrier = _carrier(topic, adapted=self.adapts_frames)
            users = self._video_users.setdefault(carrier, set())
            had_users = bool(users)
            (users.add if on else users.discard)(topic)
            topic, on = carrier, bool(users)
            if on == had_users:
                return
        if topic.startswith(FEEDBACK):
            if self._only_plain:
                return
            if on:
                self._expect(FeedbackRequest.parse(topic))
        self._end.subscribe(topic, on)

    def tick(self, now_ns: int) -> None:
        """Repeat due requests; ping the proxy if nothing arrives from it or its clock needs measuring."""
        self.requests.tick(now_ns)
        late_ns = self.monitor.late_ns
        silent = now_ns - self.monitor.received_ns > late_ns
        usual_ns = _PING_CLOCK_NS if len(self._trips) >= _FIRST_TRIPS else _PING_FIRST_NS
        due = now_ns - self._pinged_ns > (late_ns if silent else usual_ns) and not self._pinged
        if (silent or not self._same_clock) and due:
            self._pinged_ns = now_ns
            # Only one ping may be outstanding: on a stalled path, queued pings and answers delay everything else.
            self._pinged = True
            self.requests.ask(Ping(now_ns), self._ponged, PING_S, now_ns, again_s=PING_S)

    def renew_feedback(self, now_ns: int) -> None:
        """Resubscribe to feedback if none arrives although the proxy answers.

        If only a reduced rate was requested, every sample is requested for the rest of this session, because the proxy
        may be too old or have no room for more variants. Consumers filter their samples in any case.
        """
        self._feedback_watch.received_ns = self.monitor.feedback_ns
        answers = now_ns - self.monitor.received_ns < 2 * self.monitor.late_ns
        if not self._feedback_watch.stalled(answers, now_ns):
            return
        self._end.subscribe(self._feedback.topic, False)
        self._only_plain = self._only_plain or not self._feedback.is_plain
        self._expect(EVERY_SAMPLE)
        self._end.subscribe(FEEDBACK)

    def _expect(self, request: FeedbackRequest) -> None:
        """Evaluate the link by the new feedback rate from now on."""
        if request == self._feedback:
            return
        now_ns, self._feedback = self._clock(), request
        self.monitor.expect(request.period_s, now_ns)
        self._feedback_watch = StallWatch(FEEDBACK_STALL_S + request.period_s, now_ns)

    def _ponged(self, answer: AnyReply | LinkError) -> None:
        self._pinged = False
        if isinstance(answer, Pong) and not self._same_clock:
            self.offset_ns = self._trips.add(answer.sent_ns, answer.now_ns, self._clock()).ns

    @property
    def uncertainty_ns(self) -> int:
        """Current maximum error of :attr:`offset_ns` [ns]; 0 if both ends read the same clock."""
        if not self._trips:
            return 0
        now = self._trips.at(self._clock())
        return now.uncertainty_ns + abs(now.ns - self.offset_ns)

    # Callbacks of the transport ------------------------------------------------------------------------------------

    def packet(self, packet: bytes) -> None:
        """Decode a packet and pass it to its handler; called on the receiving thread."""
        now_ns = self._clock()
        try:
            sample: Sample = decode(packet)
        except DecodeError:
            self._malformed()
            return
        if self._quiet:
            return
        if type(sample) is Feedback:
            if self.monitor.feedback(sample.seq, now_ns, sample.skipped):
                self._take_feedback(sample, now_ns)
                if not self._up:  # on the first sample, wake the supervisor to report that the link is up
                    self._up = True
                    self._poke()
            return
        handler = self._handlers.get(type(sample))
        if handler is None:  # proxies don't send this kind of sample
            self._malformed()
            return
        self.monitor.received_ns = now_ns
        handler(sample, now_ns)

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:
        """Check a frame's size and pass the frame to its handler; called on the receiving thread.

        ``topic`` names the request that the frame answers; it is empty for a plain frame of the camera.
        """
        now_ns = self._clock()
        if self._quiet:
            return
        if pixels.size != frame_size(header):
            self._malformed()
            return
        self.monitor.received_ns = now_ns
        self._handler.frame(header, pixels, now_ns, topic)

    def closed(self, reason: str) -> None:
        """Handle a connection that the transport has closed; the supervisor reconnects."""
        self.closed_reason, self.open = reason, False
        self._poke()

    def _reply(self, reply: Reply, now_ns: int) -> None:  # noqa: ARG002  (the signature of all handlers)
        if not self.receiver:
            self.receiver = threading.get_ident()
        self.requests.answered(reply)

    def _malformed(self) -> None:
        self.monitor.malformed()
        self._poke()


def frame_size(header: FrameHeader) -> int:
    """Return how many bytes the frame announced by ``header`` must have."""
    channels = CHANNELS.get(header.encoding)
    return header.size if channels is None else header.width * header.height * channels


def _carrier(topic: str, *, adapted: bool) -> str:
    """Return the transport topic that carries the video of ``topic``.

    ``adapted``: whether frames arrive in the requested form. If not, all frames arrive unchanged, and each channel
    filters and scales them.
    """
    request = VideoRequest.parse(topic)
    if topic.startswith(stream("")):
        return topic
    if not adapted:
        return request.plain.topic
    return request.stream_topic if request.encoding == "h264" else topic
