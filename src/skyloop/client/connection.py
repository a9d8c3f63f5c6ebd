"""One connection to a proxy, from its first packet to its last: what its transport calls."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from skyloop.client.frame import size_error
from skyloop.client.monitor import LinkMonitor, StallWatch, Thresholds
from skyloop.client.requests import Requests
from skyloop.client.timing import Offset, OffsetEstimator
from skyloop.clock import Clock, nanoseconds
from skyloop.errors import DecodeError, LinkError
from skyloop.messages import (
    Annotation,
    AnyReply,
    Applied,
    EncodedFrame,
    Event,
    Feedback,
    FrameHeader,
    LogEntry,
    Ping,
    Pong,
    ProcessorResult,
    ProcessorShare,
    Reply,
    Sample,
    VideoRequest,
    Welcome,
    decode,
)
from skyloop.transport.base import ClientEnd, Dialer, Pixels, video

if TYPE_CHECKING:
    from skyloop.client.link import LinkUser

_VIDEO: Final = video("")
_PING_CLOCK_NS: Final = nanoseconds(1.0)  #: how often a proxy on another clock is asked for its time
_PING_FIRST_NS: Final = nanoseconds(0.1)  #: the same at first, until there are some answers to choose from
_FIRST: Final = 5


class Connection:
    """Takes what arrives on the transport's receiving thread, decodes and counts it, and hands it on."""

    def __init__(self, user: LinkUser, poke: Callable[[], None], thresholds: Thresholds, clock: Clock) -> None:
        self._user = user
        self._poke = poke
        self._clock = clock
        self._end: ClientEnd | None = None
        self._late_ns = nanoseconds(thresholds.late_s)  # a proxy that is silent for so long is asked if it is there
        self._quiet = False  # closed by us: what still comes is not wanted
        self._up = False
        self._pinged_ns = 0
        self._trips = OffsetEstimator()
        self._users: dict[str, set[str]] = {}  # requests for video that a camera's plain frames are to meet
        self._handlers: dict[type, Callable[..., None]] = {
            Event: user.event,
            Applied: user.applied,
            Annotation: user.annotation,
            LogEntry: user.log_entry,
            EncodedFrame: user.encoded,
            ProcessorResult: user.result,
            ProcessorShare: user.share,
            Reply: self._reply,
        }
        self._take_feedback = user.feedback
        self._feedback_watch = StallWatch(1.0, clock())
        self.monitor = LinkMonitor(thresholds, clock())
        self.requests = Requests(self.send)
        self.offset_ns = 0  #: the proxy's clock less ours
        self.closed_reason: str | None = None  #: why it ended, once it has
        self.receiver = 0  #: identity of the receiving thread
        self.look_ns = 0  #: when to judge its state next; kept here for the link

    # Set-up and end --------------------------------------------------------------------------------------------

    def dial(self, dialer: Dialer) -> None:
        """Connect; raises what the dialer raises."""
        self._end = dialer(self)

    def welcomed(self, welcome: Welcome, sent_ns: int) -> None:
        """The answer to Hello is the first measure of the offset between the clocks."""
        if self._end is not None and not self._end.same_clock:
            self._take_offset(self._trips.add(sent_ns, welcome.now_ns, self._clock()))

    def close(self, error: LinkError) -> None:
        """End it; open questions get ``error``."""
        self._quiet = True
        if self._end is not None:
            self._end.close()
        self.requests.fail(error)

    @property
    def open(self) -> bool:
        return self.closed_reason is None and not self._quiet

    @property
    def address(self) -> str:
        return self._end.address if self._end is not None else "nowhere"

    # Sending ---------------------------------------------------------------------------------------------------

    @property
    def transmit(self) -> Callable[[bytes], bool]:
        """The transport's own way to send, for what is sent often."""
        assert self._end is not None
        return self._end.send

    @property
    def knock(self) -> Callable[[], None]:
        """The transport's way to say that a packet follows at once."""
        assert self._end is not None
        return self._end.knock

    def send(self, packet: bytes) -> bool:
        end = self._end
        return end is not None and not self._quiet and end.send(packet)

    def subscribe(self, topic: str, on: bool) -> None:
        end = self._end
        if end is None:
            return
        if not end.variants and topic.startswith(_VIDEO):
            # All frames come as they are here, and who wants them otherwise sees to that on this side.
            plain = VideoRequest.parse(topic).plain.topic
            users = self._users.setdefault(plain, set())
            had_users = bool(users)
            (users.add if on else users.discard)(topic)
            topic, on = plain, bool(users)
            if on == had_users:
                return
        end.subscribe(topic, on)

    def tick(self, now_ns: int) -> None:
        """Questions that are due again, and a ping where one is needed."""
        self.requests.tick(now_ns)
        end = self._end
        if end is None:
            return
        silent = now_ns - self.monitor.heard_ns > self._late_ns
        usual_ns = _PING_CLOCK_NS if len(self._trips) >= _FIRST else _PING_FIRST_NS
        if (silent or not end.same_clock) and now_ns - self._pinged_ns > (self._late_ns if silent else usual_ns):
            self._pinged_ns = now_ns
            self.requests.ask(Ping(now_ns), self._ponged, 1.0, now_ns)

    def feedback_stalled(self, now_ns: int) -> bool:
        """Whether feedback stands still although the proxy answers, and should be subscribed to anew."""
        self._feedback_watch.heard_ns = self.monitor.feedback_ns
        return self._feedback_watch.stalled(now_ns - self.monitor.heard_ns < 2 * self._late_ns, now_ns)

    def _ponged(self, answer: AnyReply | LinkError) -> None:
        if isinstance(answer, Pong) and self._end is not None and not self._end.same_clock:
            self._take_offset(self._trips.add(answer.sent_ns, answer.now_ns, self._clock()))

    def _take_offset(self, offset: Offset) -> None:
        self.offset_ns = offset.ns

    @property
    def uncertainty_ns(self) -> int:
        """How wrong :attr:`offset_ns` may be by now; 0 where both ends read one clock."""
        if not self._trips:
            return 0
        now = self._trips.at(self._clock())
        return now.uncertainty_ns + abs(now.ns - self.offset_ns)

    # What the transport calls ----------------------------------------------------------------------------------

    def packet(self, packet: bytes) -> None:
        now_ns = self._clock()
        try:
            sample: Sample = decode(packet)
        except DecodeError:
            self._malformed()
            return
        if self._quiet:
            return
        if type(sample) is Feedback:
            if self.monitor.feedback(sample.seq, now_ns):
                self._take_feedback(sample, now_ns)
                if not self._up:  # the first one: the link's thread has to say so
                    self._up = True
                    self._poke()
            return
        handler = self._handlers.get(type(sample))
        if handler is None:  # nothing that a proxy sends
            self._malformed()
            return
        self.monitor.heard_ns = now_ns
        handler(sample, now_ns)

    def frame(self, header: FrameHeader, pixels: Pixels, topic: str = "") -> None:
        now_ns = self._clock()
        if self._quiet:
            return
        if size_error(header, pixels.size):
            self._malformed()
            return
        self.monitor.heard_ns = now_ns
        self._user.frame(header, pixels, now_ns, topic)

    def closed(self, reason: str) -> None:
        self.closed_reason = reason
        self._poke()

    def _reply(self, reply: Reply, now_ns: int) -> None:  # noqa: ARG002  (all handlers are called alike)
        if not self.receiver:
            self.receiver = threading.get_ident()
        self.requests.answered(reply)

    def _malformed(self) -> None:
        self.monitor.malformed()
        self._poke()
