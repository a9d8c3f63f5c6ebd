"""Everything that arrives from a proxy: kept as the newest, counted, and handed to whoever listens."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from skyloop.client.delivery import Topic
from skyloop.client.frame import Arrival, Frame, SmallArrival
from skyloop.client.history import FeedbackHistory
from skyloop.client.monitor import StallWatch
from skyloop.client.pace import Pace
from skyloop.client.results import ResultChannels
from skyloop.client.statistics import ChannelCounter, ChannelStats
from skyloop.errors import DecodeError
from skyloop.messages import (
    Annotation,
    Applied,
    CameraInfo,
    EncodedFrame,
    Event,
    EventKind,
    Feedback,
    FrameHeader,
    LinkState,
    LogEntry,
    ProcessorResult,
    ProcessorShare,
    Severity,
    VideoRequest,
    Welcome,
)
from skyloop.messages.video import FrameFilter
from skyloop.transport.base import ANNOTATIONS, COMMANDS, LOGS, Pixels, stream, video

if TYPE_CHECKING:
    from skyloop.client.config import Config
    from skyloop.client.link import Link
    from skyloop.client.pilot import Pilot

RECENT_EVENTS: Final = 256
_LATER_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """State of the two hops, and why the one that changed last is as it is."""

    application: LinkState  #: application–proxy
    vehicle: LinkState  #: proxy–vehicle, as far as the proxy has told
    reason: str = ""


class VideoChannel:
    """One camera's frames as one request wants them. The first consumer subscribes to it, the last one that goes ends
    that."""

    def __init__(self, camera: CameraInfo, link: Link, pace: Pace, request: VideoRequest | None = None) -> None:
        self.camera = camera
        self.request = request or usual(camera.name)
        #: Of its statistics: the camera's plain topic for frames as they usually come.
        self.name = video(camera.name) if self.request == usual(camera.name) else self.request.topic
        self.filter = FrameFilter(self.request)
        self.newest: Arrival | None = None
        self.bell = pace.bell()
        self.counter = ChannelCounter()
        self.undecodable = 0
        self.watch = StallWatch(max(1.0, 5.0 * self._period_s(camera.fps)), pace.clock())
        self.keep = False  #: subscribed for good, by ``frame()`` or ``next_frame()``
        self.subscribed = False
        self._read: Arrival | None = None  # what next_frame() gave last
        self._link = link
        self.topic: Topic[Arrival] = Topic(self._wanted)
        #: Pictures as the vehicle encoded them, for consumers that want them so; on the receiving thread.
        self.stream: Topic[EncodedFrame] = Topic(lambda on: link.subscribe(stream(camera.name), on))

    @property
    def unread(self) -> bool:
        """Whether there is a frame that :meth:`read` did not give yet."""
        return self.newest is not self._read

    def read(self) -> Frame | None:
        """The newest frame, which is then read."""
        self._read = arrival = self.newest
        return None if arrival is None else self.picture(arrival)

    def keep_newest(self) -> None:
        """Subscribe for good."""
        if not self.keep:
            self.keep = self.subscribed = True
            self._link.subscribe(self.request.topic)

    def picture(self, arrival: Arrival) -> Frame | None:
        """The frame; None, and counted, if its pixels can't be understood."""
        try:
            return arrival.frame()
        except DecodeError:
            self.undecodable += 1
            return None

    def _wanted(self, wanted: bool) -> None:
        if not self.keep:
            self.subscribed = wanted
            self._link.subscribe(self.request.topic, wanted)

    def _period_s(self, fps: float) -> float:
        """Time between two frames of this request, as far as is known."""
        most = self.request.max_fps
        rate = min(fps, most) if fps > 0.0 and most is not None else fps or most or 0.0
        parts = 1 if self.request.part is None else self.request.part[1]
        return parts / rate if rate > 0.0 else 0.0


def usual(camera: str) -> VideoRequest:
    """How a camera's frames come to those who ask for nothing in particular: as JPEG where they travel far."""
    return VideoRequest(camera, encoding="jpeg")


class Reception:
    """The receiving side of a drone: a :class:`skyloop.client.link.LinkUser`."""

    def __init__(self, name: str, pace: Pace | None = None) -> None:
        self._name = name
        self.pace = pace or Pace()
        self._clock = self.pace.clock
        self.link: Link
        self.pilot: Pilot
        self.config: Config
        self.welcome: Welcome | None = None
        self.newest: Feedback | None = None
        self.received_ns = 0  #: when the newest feedback came, on our clock
        self.history = FeedbackHistory()
        self.bell = self.pace.bell()  #: rings with each feedback, and when something changes that somebody may wait for
        self.refusal: Event | None = None  #: the last command of ours that was refused
        self.recent: deque[Event] = deque(maxlen=RECENT_EVENTS)
        self.status = LinkStatus(LinkState.CONNECTING, LinkState.CONNECTING)
        self.channels: dict[str, VideoChannel] = {}  #: by camera: frames as they usually come
        self.variants: dict[str, VideoChannel] = {}  #: the same, and frames as anybody asked for them, by topic
        self.counter = ChannelCounter()
        self.echoes = ChannelCounter()
        self.on_feedback: Topic[Feedback] = Topic()
        self.on_event: Topic[Event] = Topic()
        self.on_link: Topic[LinkStatus] = Topic()
        self.on_command: Topic[Applied] = Topic(lambda on: self.link.subscribe(COMMANDS, on))
        self.on_annotation: Topic[Annotation] = Topic(lambda on: self.link.subscribe(ANNOTATIONS, on))
        self.on_log: Topic[LogEntry] = Topic(lambda on: self.link.subscribe(LOGS, on))
        self.on_share: Topic[ProcessorShare] = Topic()
        self.on_welcome: Topic[Welcome] = Topic()  #: a proxy was connected; on the link's thread
        self.results = ResultChannels(self.pace, self.history)

    # What the link calls ---------------------------------------------------------------------------------------

    def connected(self, welcome: Welcome) -> None:
        self.welcome = welcome
        now_ns = self._clock()
        self.counter.last_seq = None
        for channel in self.variants.values():
            channel.counter.last_seq = None
            channel.watch.heard_ns = now_ns
        for camera in welcome.capabilities.cameras:
            if camera.name not in self.channels:
                channel = self.channels[camera.name] = VideoChannel(camera, self.link, self.pace)
                self.variants[channel.request.topic] = channel
        self.results.restart()
        self.pilot.connected(welcome.app_id)
        self.on_welcome.publish(welcome)

    def disconnected(self, reason: str) -> None:  # noqa: ARG002  (told by link_changed)
        self.config.disconnected()
        self.pilot.disconnected()

    def link_changed(self, state: LinkState, reason: str) -> None:
        severity = Severity.INFO if state in (LinkState.UP, LinkState.CLOSED) else Severity.WARNING
        text = f"link to the proxy: {state.value}" + (f" ({reason})" if reason else "")
        self._status_changed(replace(self.status, application=state, reason=reason))
        self.tell(EventKind.APPLICATION_LINK, text, severity, state=state.value, reason=reason)

    def tick(self, now_ns: int) -> int:
        flows = self.link.state is LinkState.UP
        for channel in tuple(self.variants.values()):
            if channel.watch.stalled(flows, now_ns):
                self.link.resubscribe(channel.request.topic)
        return self.pilot.tick(now_ns)

    def feedback(self, sample: Feedback, now_ns: int) -> None:
        before = self.newest
        self.history.add(sample)
        self.newest = sample
        self.received_ns = now_ns
        # A failsafe or another owner ends the set-point, but not what a listener commands in answer to this sample.
        news = before is None or sample.failsafe is not before.failsafe or sample.owner_id != before.owner_id
        if news:
            self.pilot.feedback(sample, now_ns)
        self.on_feedback.publish(sample)  # first whoever waits for it, then the books
        self.bell.ring()
        offset_ns = self.link.offset_ns
        counter = self.counter
        counter.follow(sample.seq)
        counter.add(now_ns + offset_ns - sample.published_ns, sample.captured_ns - offset_ns, now_ns)
        if not news:
            self.pilot.feedback(sample, now_ns)
        if sample.vehicle_link is not self.status.vehicle:
            self._status_changed(replace(self.status, vehicle=sample.vehicle_link, reason=self._vehicle_reason()))

    def frame(self, header: FrameHeader, pixels: Pixels, now_ns: int, topic: str = "") -> None:
        if topic:
            channel = self.variants.get(topic)
            if channel is not None:
                self._arrived(channel, header, pixels, now_ns, as_asked=True)
            return
        for channel in tuple(self.variants.values()):
            mine = channel.subscribed and channel.camera.name == header.camera
            if mine and channel.filter.wants(header.seq, header.captured_ns):
                self._arrived(channel, header, pixels, now_ns, as_asked=False)

    def _arrived(
        self, channel: VideoChannel, header: FrameHeader, pixels: Pixels, now_ns: int, *, as_asked: bool
    ) -> None:
        """A frame for one channel; ``as_asked``: it was made for this request by the proxy."""
        counter = channel.counter
        last = counter.last_seq
        if last is not None and header.seq <= last:
            return  # repeated or overtaken
        offset_ns, scale = self.link.offset_ns, channel.request.scale
        if as_asked or scale == 1.0:
            arrival = Arrival(header, pixels, now_ns, offset_ns, self.history, self._clock)
        else:
            arrival = SmallArrival(header, pixels, now_ns, offset_ns, self.history, self._clock, scale)
        # First whoever waits for it, then the books. The frame before is let go of last: giving its memory back to the
        # proxy takes longer than all of this.
        before, channel.newest = channel.newest, arrival
        channel.topic.publish(arrival)
        channel.bell.ring()
        del before
        counter.follow(header.seq)
        counter.add(now_ns + offset_ns - header.published_ns, header.captured_ns - offset_ns, now_ns)
        channel.watch.heard_ns = now_ns

    def asked(self, camera: CameraInfo, request: VideoRequest) -> VideoChannel:
        """The channel of a request, made if nobody asked so before."""
        channel = self.variants.get(request.topic)
        if channel is None:
            channel = self.variants[request.topic] = VideoChannel(camera, self.link, self.pace, request)
        return channel

    def event(self, event: Event, now_ns: int) -> None:
        self.recent.append(event)
        if event.kind is EventKind.COMMAND_REFUSED and event.app == self._name:
            self.refusal = event
        self.pilot.event(event, now_ns)
        self.on_event.publish(event)
        self.bell.ring()

    def applied(self, applied: Applied, now_ns: int) -> None:
        if applied.app_id == self.pilot.app_id:
            self.echoes.add(applied.applied_ns - applied.sent_ns, applied.sent_ns, now_ns)
        self.on_command.publish(applied)

    def annotation(self, annotation: Annotation, now_ns: int) -> None:  # noqa: ARG002  (all are called alike)
        self.on_annotation.publish(annotation)

    def log_entry(self, entry: LogEntry, now_ns: int) -> None:  # noqa: ARG002  (all are called alike)
        self.on_log.publish(entry)

    def encoded(self, picture: EncodedFrame, now_ns: int) -> None:  # noqa: ARG002  (all are called alike)
        channel = self.channels.get(picture.camera)
        if channel is not None:
            channel.stream.publish(picture)

    def result(self, result: ProcessorResult, now_ns: int) -> None:
        self.results.arrived(result, now_ns)

    def share(self, share: ProcessorShare, now_ns: int) -> None:  # noqa: ARG002  (all are called alike)
        self.on_share.publish(share)

    # For the drone ---------------------------------------------------------------------------------------------

    def tell(self, kind: EventKind, text: str, severity: Severity = Severity.WARNING, **data: str) -> None:
        """An event of the client's own (number 0)."""
        event = Event(kind, text, self._clock() + self.link.offset_ns, severity, app=self._name, data=dict(data))
        self.recent.append(event)
        self.on_event.publish(event)
        self.bell.ring()

    def stats(self) -> dict[str, ChannelStats]:
        """Statistics of every channel by its name."""
        now_ns = self._clock()
        link = self.link
        echoes = self.echoes.stats(now_ns)
        found = {
            "command": replace(self.pilot.sends.stats(now_ns, ages=False), delay_s=echoes.delay_s),
            "feedback": self.counter.stats(now_ns, dropped=self.on_feedback.dropped, malformed=link.malformed),
        }
        for channel in tuple(self.variants.values()):
            found[channel.name] = channel.counter.stats(
                now_ns, dropped=channel.topic.dropped, malformed=channel.undecodable
            )
        for results in self.results.all():
            dropped = results.topic.dropped + results.overtaken
            found[results.name] = results.counter.stats(now_ns, dropped=dropped)
        return found

    def wake_all(self) -> None:
        """Let everybody who waits look again."""
        self.bell.ring()
        for channel in tuple(self.variants.values()):
            channel.bell.ring()
        for results in self.results.all():
            results.bell.ring()

    def _status_changed(self, status: LinkStatus) -> None:
        self.status = status
        self.on_link.publish(status)
        self.bell.ring()

    def _vehicle_reason(self) -> str:
        """What the newest event about the vehicle's link says."""
        for event in reversed(self.recent):
            if event.kind is EventKind.VEHICLE_LINK:
                return str(event.data.get("reason", "")) or event.text
        return ""
