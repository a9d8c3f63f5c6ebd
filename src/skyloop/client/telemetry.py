"""Handle the samples that arrive from a proxy: store the newest of each kind, count it and publish it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Final, Self, TypeVar

from skyloop.client.channels import C, Channel, FollowingChannel, Listener, Mailbox, Notifier, checked_age
from skyloop.client.commands import CommandSender
from skyloop.client.connection import ProxyConnection, Scheduler
from skyloop.client.frame import FeedbackHistory, Frame, ReceivedFrame
from skyloop.client.monitoring import ChannelCounter, ChannelStats
from skyloop.client.parameters import Restorer
from skyloop.client.results import ResultChannels, ResultMailbox
from skyloop.client.video import VideoChannels, forget_idle
from skyloop.errors import NoAnswerError, UnknownNameError
from skyloop.messages import (
    Annotation,
    Applied,
    EncodedFrame,
    Event,
    EventKind,
    Feedback,
    FeedbackRequest,
    FlightState,
    LinkState,
    LogEntry,
    Overview,
    ProcessorResult,
    ProcessorShare,
    Severity,
    Welcome,
)
from skyloop.messages.feedback import OverviewPages
from skyloop.messages.subscription import EVERY_SAMPLE, RateLimiter
from skyloop.transport.base import ANNOTATIONS, COMMANDS, LOGS, OVERVIEW

RECENT_EVENTS: Final = 256  #: number of events kept for :meth:`skyloop.Drone.recent_events`
#: A condition to wait for: a flight state or its name, several of them (any one suffices), or a test of feedback.
Wanted = FlightState | str | Iterable[FlightState | str] | Callable[[Feedback], bool]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """State of the two links, with the reason for the last change."""

    application: LinkState  #: link from the application to the proxy
    vehicle: LinkState  #: link from the proxy to the vehicle, as last reported by the proxy
    reason: str = ""
    remedy: str = ""  #: what the user can do to restore the vehicle's link while it is down


class Mailboxes:
    """Mailboxes for the newest feedback, frame and results; one thread can wait for all of them.

    It is a context manager; the mailboxes receive samples while it is open.
    """

    def __init__(
        self,
        state: ClientState,
        *,
        feedback: bool = True,
        frames: bool = True,
        camera: str | None = None,
        results: bool = False,
        processors: Iterable[str] | None = None,
        max_age_s: float | None = None,
    ) -> None:
        """Create the requested mailboxes, empty; see :class:`skyloop.extend.InboxOptions`.

        Raises the same errors as :meth:`VideoChannels.channel` and :meth:`ResultChannels.channel`.
        """
        known = state.results
        named = [known.everything] if processors is None else [known.channel(one) for one in processors]
        self.clock = state.scheduler.clock  #: the clock that a controller uses
        self.notifier = state.sample_notifier()
        self.feedback: Mailbox[Feedback] = Mailbox(1, self.notifier)
        self.frames: Mailbox[ReceivedFrame] = Mailbox(1, self.notifier)
        self.results = ResultMailbox(checked_age(max_age_s), self.notifier)
        self._video = state.follow(lambda: state.video.channel(camera)) if frames else None
        self._feedback_channel = state.on_feedback if feedback else None
        self._result_channels = named if results else []
        self._filling = ExitStack()

    def __enter__(self) -> Self:
        fill = self._filling.enter_context
        if self._feedback_channel is not None:
            fill(self._feedback_channel.into(self.feedback))
        if self._video is not None:
            fill(self._video.into(self.frames))
        for channel in self._result_channels:
            fill(channel.into(self.results))
        return self

    def __exit__(self, *_: object) -> None:
        self._filling.close()

    @property
    def waiting(self) -> bool:
        """Whether any mailbox contains a sample."""
        return self.feedback.waiting or self.frames.waiting or self.results.waiting

    def frame(self) -> Frame | None:
        """Take and return the newest frame; None if no new frame has arrived or it can't be decoded."""
        arrival, video = self.frames.take(), self._video
        if arrival is None or video is None:
            return None
        return video.current.picture(arrival)


class FeedbackDemand:
    """Subscribes to the variant of feedback that satisfies all consumers of a drone.

    A pilot always gets every sample, because samples report its link, its authority and failsafes. So does an observer
    unless it has consumers and all of them have limited their rate.
    """

    def __init__(self, connection: ProxyConnection, *, whole: bool) -> None:
        """Subscribe to every sample; with ``whole``, the subscription never changes."""
        self._connection = connection
        self._whole = whole
        self._wanted: dict[FeedbackRequest, int] = {}  # number of consumers of each request
        self._kept: set[FeedbackRequest] = set()  # permanent requests
        self._lock = threading.Lock()
        self.request = EVERY_SAMPLE  #: the current subscription
        connection.subscribe(EVERY_SAMPLE.topic)

    def want(self, request: FeedbackRequest, on: bool) -> None:
        """Add or remove a consumer of this request."""
        with self._lock:
            count = self._wanted.get(request, 0) + (1 if on else -1)
            if count > 0:
                self._wanted[request] = count
            else:
                self._wanted.pop(request, None)
            self._update()

    def keep(self, request: FeedbackRequest) -> None:
        """Add a permanent request."""
        if not self._whole and request not in self._kept:
            with self._lock:
                self._kept.add(request)
                self._update()

    @contextmanager
    def wanted(self, request: FeedbackRequest) -> Iterator[None]:
        """Keep a request in effect during the block."""
        self.want(request, True)
        try:
            yield
        finally:
            self.want(request, False)

    def _update(self) -> None:
        """Change the subscription if the requests need a different one. The caller must hold the lock."""
        asked = [*self._wanted, *self._kept]
        needed = EVERY_SAMPLE if self._whole or not asked else reduce(FeedbackRequest.union, asked)
        before = self.request
        if needed != before:
            self.request = needed
            self._connection.subscribe(needed.topic, True)  # subscribe before unsubscribing to miss no sample
            self._connection.subscribe(before.topic, False)


class FeedbackChannel(Channel[Feedback]):
    """Feedback for consumers that need fewer samples than the connection receives."""

    def __init__(self, request: FeedbackRequest, demand: FeedbackDemand) -> None:
        super().__init__(lambda on: demand.want(request, on))
        self.request = request
        self._rate = RateLimiter(request.max_hz)

    def receive(self, sample: Feedback) -> None:
        """Publish a sample if it is due; called on the receiving thread."""
        if self._consumers and self._rate.in_time(sample.published_ns):
            self.publish(sample)


class ClientState:
    """The newest state of a connected vehicle, and the channels that publish its changes."""

    def __init__(
        self, app: str, connection: ProxyConnection, scheduler: Scheduler, *, whole_feedback: bool = True
    ) -> None:
        """Create the state of an unconnected drone; ``app`` is the application's name."""
        self.app = app
        self.scheduler = scheduler
        self.listeners: list[Listener[Any]] = []  #: active callbacks of the application
        self.to_close: list[Callable[[], None]] = []  #: functions that release resources when the drone is closed
        self.welcome: Welcome | None = None
        self.newest: Feedback | None = None
        self.received_ns = 0  #: when the newest feedback arrived, on this process's clock
        self.history = FeedbackHistory()
        #: Notified of each feedback sample, and of every other change for which a thread may be waiting.
        self.notifier = scheduler.notifier()
        self.recent: deque[Event] = deque(maxlen=RECENT_EVENTS)
        self.status = LinkStatus(LinkState.CONNECTING, LinkState.CONNECTING)
        self.video = VideoChannels(connection, scheduler, self.history)
        self.counter = ChannelCounter()  #: counts feedback
        self.echoes = ChannelCounter()
        self.demand = FeedbackDemand(connection, whole=whole_feedback)
        self.on_feedback: Channel[Feedback] = Channel(lambda on: self.demand.want(EVERY_SAMPLE, on))
        self.selected: tuple[FeedbackChannel, ...] = ()  #: channels for consumers with a limited request
        self.on_event: Channel[Event] = Channel()
        self.on_link: Channel[LinkStatus] = Channel()
        self.on_command: Channel[Applied] = Channel(lambda on: connection.subscribe(COMMANDS, on))
        self.on_annotation: Channel[Annotation] = Channel(lambda on: connection.subscribe(ANNOTATIONS, on))
        self.on_log: Channel[LogEntry] = Channel(lambda on: connection.subscribe(LOGS, on))
        self.on_overview: Channel[Overview] = Channel(lambda on: connection.subscribe(OVERVIEW, on))
        self.overview: Overview | None = None  #: the newest complete overview
        self.on_share: Channel[ProcessorShare] = Channel()
        self.on_welcome: Channel[Welcome] = Channel()  #: publishes each new connection, on the supervisor's thread
        self.results = ResultChannels(connection, scheduler, self.history)
        self._clock = scheduler.clock
        self._connection = connection
        self._making = threading.RLock()  # ensures that two threads requesting the same channel get the same object

    @property
    def name(self) -> str:
        """Name of the proxy; empty before the first connection."""
        return "" if self.welcome is None else self.welcome.proxy

    def sample_notifier(self) -> Notifier:
        """Return a notifier for a thread that waits only for samples of this connection."""
        return self.scheduler.sample_notifier(self._connection)

    def follow(self, find: Callable[[], C]) -> FollowingChannel[Any, C]:
        """Return the channel that ``find`` returns; it switches when the proxy restarts with different cameras."""
        return FollowingChannel(find, self.on_welcome)

    @contextmanager
    def closing(self, mailbox: Mailbox[Any] | ResultMailbox) -> Iterator[None]:
        """Close ``mailbox`` and thereby wake its consumer if the drone is closed during the block."""
        self.to_close.append(mailbox.close)
        try:
            yield
        finally:
            self.to_close.remove(mailbox.close)

    def forget(self, listener: Listener[Any]) -> None:
        if listener in self.listeners:
            self.listeners.remove(listener)

    def no_frame(self, camera: str, timeout_s: float) -> NoAnswerError:
        """Return the error for a missing frame, including the reason if it is known."""
        link = self.status
        words = [f"no frame of {camera} arrived within {timeout_s:g} s"]
        if link.vehicle is not LinkState.UP:
            words += [f"the vehicle's link is {link.vehicle.value}", link.reason, link.remedy]
        return NoAnswerError(": ".join(filter(None, words)))

    def feedback_channel(self, request: FeedbackRequest) -> Channel[Feedback]:
        """Return the channel that delivers feedback as requested; create it on the first call."""
        if request.is_plain:
            return self.on_feedback
        with self._making:
            known = {channel.request: channel for channel in self.selected}
            if request not in known:
                forget_idle(known)
                known[request] = FeedbackChannel(request, self.demand)
                self.selected = tuple(known.values())
        return known[request]

    def emit(self, kind: EventKind, text: str, severity: Severity = Severity.WARNING, **data: str) -> None:
        """Emit one of the client's own events (number 0); ``data`` are its details, by name."""
        event = Event(kind, text, self._clock() + self._connection.offset_ns, severity, app=self.app, data=dict(data))
        self.recent.append(event)
        self.on_event.publish(event)
        self.notifier.notify()

    def stats(self, sends: ChannelCounter) -> dict[str, ChannelStats]:
        """Return the statistics of every channel, by name; ``sends`` counts the sent commands."""
        now_ns = self._clock()
        echoes = self.echoes.stats(now_ns)
        found = {
            "command": replace(sends.stats(now_ns, ages=False), delay_s=echoes.delay_s),
            "feedback": self.counter.stats(
                now_ns,
                lost=self._connection.missing,
                dropped=sum(channel.dropped for channel in (self.on_feedback, *self.selected)),
                malformed=self._connection.malformed,
            ),
        }
        for channel in tuple(self.video.by_topic.values()):
            found[channel.name] = channel.stats(now_ns)
        for results in self.results.all():
            found[results.name] = results.stats(now_ns)
        return found

    def wake_all(self) -> None:
        """Wake every waiting thread to make it check its condition again."""
        self.notifier.notify()
        for channel in tuple(self.video.by_topic.values()):
            channel.notifier.notify()
        for results in self.results.all():
            results.notifier.notify()

    def set_status(self, status: LinkStatus) -> None:
        """Publish the changed state of the two links."""
        self.status = status
        self.on_link.publish(status)
        self.notifier.notify()


class SessionSamples:
    """Handles the samples and the connection changes of every session.

    ``feedback``, ``frame`` and the other samples arrive on the receiving thread; everything else on the supervisor's.
    """

    def __init__(
        self, state: ClientState, connection: ProxyConnection, commands: CommandSender, restorer: Restorer
    ) -> None:
        self._state = state
        self._connection = connection
        self._commands = commands
        self._restorer = restorer
        self._clock = state.scheduler.clock
        self._overview_pages = OverviewPages()
        self.frame = state.video.receive
        self.disconnected = commands.disconnected
        self.samples: Mapping[type, Callable[[Any, int], None]] = {
            Event: self._event,
            Applied: self._applied,
            EncodedFrame: state.video.receive_encoded,
            ProcessorResult: state.results.receive,
            Overview: self._overview,
            Annotation: _publishing(state.on_annotation),
            LogEntry: _publishing(state.on_log),
            ProcessorShare: _publishing(state.on_share),
        }

    def connected(self, welcome: Welcome) -> None:
        """Reset the counters and store the vehicle's capabilities after a proxy has answered Hello."""
        state = self._state
        state.welcome = welcome
        state.video.connected(welcome.capabilities.cameras, self._clock())
        state.results.restart()
        self._restorer.connected(welcome.run_id)
        self._commands.connected(welcome.app_id, welcome.run_id, welcome.capabilities)
        state.on_welcome.publish(welcome)

    def link_changed(self, state: LinkState, reason: str) -> None:
        """Publish the state of the link to the proxy, together with an event."""
        severity = Severity.INFO if state in (LinkState.UP, LinkState.CLOSED) else Severity.WARNING
        text = f"link to the proxy: {state.value}" + (f" ({reason})" if reason else "")
        self._state.set_status(replace(self._state.status, application=state, reason=reason))
        self._state.emit(EventKind.APPLICATION_LINK, text, severity, state=state.value, reason=reason)

    def tick(self, now_ns: int) -> int:
        """Resubscribe to stalled cameras, and send all due packets; return when to call this again [ns]."""
        self._state.video.renew(self._connection.state is LinkState.UP, now_ns)
        return self._commands.tick(now_ns)

    def feedback(self, sample: Feedback, now_ns: int) -> None:
        """Store and publish a feedback sample; then update the statistics, the authority and the link's state."""
        state = self._state
        before = state.newest
        state.history.add(sample)
        state.newest = sample
        state.received_ns = now_ns
        # A failsafe or another owner clears the set-point, but not a command that a listener sends in response to this
        # sample.
        changed = before is None or sample.failsafe is not before.failsafe or sample.owner_id != before.owner_id
        if changed:
            self._commands.feedback(sample, now_ns)
        state.on_feedback.publish(sample)  # serve the consumers before updating the statistics
        for channel in state.selected:
            channel.receive(sample)
        state.notifier.notify()
        offset_ns = self._connection.offset_ns
        counter = state.counter
        counter.add(now_ns + offset_ns - sample.published_ns, sample.captured_ns - offset_ns, now_ns)
        if not changed:
            self._commands.feedback(sample, now_ns)
        status, reason, remedy = state.status, sample.link_reason, sample.link_remedy
        awake = before is not None and before.waking_up and not sample.waking_up
        news = reason and (reason, remedy) != (status.reason, status.remedy)
        if sample.vehicle_link is not status.vehicle or awake or news:
            reason = reason or ("" if awake else _link_reason(state.recent))
            state.set_status(replace(status, vehicle=sample.vehicle_link, reason=reason, remedy=remedy))

    def _event(self, event: Event, now_ns: int) -> None:
        self._state.recent.append(event)
        if event.kind is EventKind.PARAMETER_CHANGED:
            if event.data.get("app_id") != self._commands.app_id:
                self._restorer.overwritten(str(event.data.get("name")))
        elif event.kind.startswith("authority_"):
            self._commands.event(event, now_ns)
        self._state.on_event.publish(event)
        self._state.notifier.notify()

    def _applied(self, applied: Applied, now_ns: int) -> None:
        """Publish the echo of a command, and measure its delay if this application sent it."""
        if applied.app_id == self._commands.app_id:
            self._state.echoes.add(applied.applied_ns - applied.sent_ns, applied.sent_ns, now_ns)
        self._state.on_command.publish(applied)

    def _overview(self, page: Overview, now_ns: int) -> None:  # noqa: ARG002  (the signature of all handlers)
        """Publish an overview once all of its pages have arrived."""
        whole = self._overview_pages.add(page)
        if whole is not None:
            self._state.overview = whole
            self._state.on_overview.publish(whole)
            self._state.notifier.notify()


def _link_reason(events: Sequence[Event]) -> str:
    """Return the reason given in the newest event about the vehicle's link; empty if there is no such event."""
    found = (event for event in reversed(events) if event.kind is EventKind.VEHICLE_LINK)
    return next((str(event.data.get("reason", "")) or event.text for event in found), "")


def _publishing(channel: Channel[T]) -> Callable[[T, int], None]:
    return lambda sample, _: channel.publish(sample)


def as_predicate(wanted: Wanted) -> tuple[Callable[[Feedback], bool], str]:
    """Return the predicate for a condition, and its human-readable name. Raises :class:`UnknownNameError`."""
    if callable(wanted):
        name = getattr(wanted, "__name__", "<lambda>")
        return wanted, "as wanted" if name == "<lambda>" else name
    names = [wanted] if isinstance(wanted, str) else list(wanted)
    known = {state.value for state in FlightState}
    for name in names:
        if name not in known:
            raise UnknownNameError("flight state", str(name), known)
    states = frozenset(FlightState(name) for name in names)
    return lambda feedback: feedback.state in states, " or ".join(str(name) for name in names)
