"""Everything that arrives from a proxy: kept as the newest, counted, and handed to whoever listens."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from skyloop.client.delivery import Topic
from skyloop.client.frame import Arrival, Frame
from skyloop.client.history import FeedbackHistory
from skyloop.client.monitor import StallWatch
from skyloop.client.pace import Pace
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
    Severity,
    Welcome,
)
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
    """One camera's frames. The first consumer subscribes to it, the last one that goes ends that."""

    def __init__(self, camera: CameraInfo, link: Link, pace: Pace) -> None:
        self.camera = camera
        self.newest: Arrival | None = None
        self.bell = pace.bell()
        self.counter = ChannelCounter()
        self.undecodable = 0
        self.watch = StallWatch(max(1.0, 5.0 / camera.fps if camera.fps > 0 else 1.0), pace.clock())
        self.keep = False  #: subscribed for good, by ``frame()`` or ``next_frame()``
        self._read: Arrival | None = None  # what next_frame() gave last
        self._link = link
        self.topic: Topic[Arrival] = Topic(self._wanted)
        #: Pictures as the vehicle encoded them, for consumers that want them so; on the receiving thread.
        self.stream: Topic[EncodedFrame] = Topic(lambda on: link.subscribe(stream(camera.name), on))

    @property
    def name(self) -> str:
        return video(self.camera.name)

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
            self.keep = True
            self._link.subscribe(self.name)

    def picture(self, arrival: Arrival) -> Frame | None:
        """The frame; None, and counted, if its pixels can't be understood."""
        try:
            return arrival.frame()
        except DecodeError:
            self.undecodable += 1
            return None

    def _wanted(self, wanted: bool) -> None:
        if not self.keep:
            self._link.subscribe(self.name, wanted)


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
        self.channels: dict[str, VideoChannel] = {}
        self.counter = ChannelCounter()
        self.echoes = ChannelCounter()
        self.on_feedback: Topic[Feedback] = Topic()
        self.on_event: Topic[Event] = Topic()
        self.on_link: Topic[LinkStatus] = Topic()
        self.on_command: Topic[Applied] = Topic(lambda on: self.link.subscribe(COMMANDS, on))
        self.on_annotation: Topic[Annotation] = Topic(lambda on: self.link.subscribe(ANNOTATIONS, on))
        self.on_log: Topic[LogEntry] = Topic(lambda on: self.link.subscribe(LOGS, on))

    # What the link calls ---------------------------------------------------------------------------------------

    def connected(self, welcome: Welcome) -> None:
        self.welcome = welcome
        now_ns = self._clock()
        self.counter.last_seq = None
        for channel in self.channels.values():
            channel.counter.last_seq = None
            channel.watch.heard_ns = now_ns
        for camera in welcome.capabilities.cameras:
            if camera.name not in self.channels:
                self.channels[camera.name] = VideoChannel(camera, self.link, self.pace)
        self.pilot.connected(welcome.app_id)

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
        for channel in self.channels.values():
            if channel.watch.stalled(flows, now_ns):
                self.link.resubscribe(channel.name)
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

    def frame(self, header: FrameHeader, pixels: Pixels, now_ns: int) -> None:
        channel = self.channels.get(header.camera)
        if channel is None:
            return  # a camera that the proxy did not announce: nobody can have asked for it
        counter = channel.counter
        last = counter.last_seq
        if last is not None and header.seq <= last:
            return  # repeated or overtaken
        offset_ns = self.link.offset_ns
        arrival = Arrival(header, pixels, now_ns, offset_ns, self.history, self._clock)
        # First whoever waits for it, then the books. The frame before is let go of last: giving its memory back to the
        # proxy takes longer than all of this.
        before, channel.newest = channel.newest, arrival
        channel.topic.publish(arrival)
        channel.bell.ring()
        del before
        counter.follow(header.seq)
        counter.add(now_ns + offset_ns - header.published_ns, header.captured_ns - offset_ns, now_ns)
        channel.watch.heard_ns = now_ns

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
        for channel in self.channels.values():
            found[channel.name] = channel.counter.stats(
                now_ns, dropped=channel.topic.dropped, malformed=channel.undecodable
            )
        return found

    def wake_all(self) -> None:
        """Let everybody who waits look again."""
        self.bell.ring()
        for channel in self.channels.values():
            channel.bell.ring()

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
