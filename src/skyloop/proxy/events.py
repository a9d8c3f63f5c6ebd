"""What a proxy reports about itself: numbered events for all clients, and counters on request.

The publisher comes first, followed by the pure functions that create the event drafts for it: first those about
commands, failsafe and ownership, then those about the authority.
"""

from __future__ import annotations

import logging
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Protocol

from skyloop.clock import NS_PER_S, Clock, seconds
from skyloop.errors import shortened
from skyloop.messages import Command, Event, EventKind, Failsafe, Refusal, Severity, Value, encode
from skyloop.proxy.core import authority
from skyloop.proxy.core.airspace import Clamp
from skyloop.proxy.core.failsafe import REASONS, BatteryLow, StepChange
from skyloop.proxy.core.flight import BELIEF_NS, Changed, Whose
from skyloop.transport.base import EVENTS, Peer
from skyloop.zones import THINNEST_M, ZONES, Space

#: Number of command delays in the distribution, about a minute's worth from one pilot at 32 Hz.
WINDOW: Final = 2000
MAX_TEXT: Final = 1000  #: maximum number of characters in an event's text
REPEAT_NS: Final = NS_PER_S  #: interval at which an event that continues is published again
#: If a limit has not been touched for this long, touching it again starts a new episode.
EPISODE_NS: Final = NS_PER_S
#: Why a hover or landing is abandoned.
UNHEARD: Final = f"the vehicle was silent for {seconds(BELIEF_NS):g} s and may be on another flight by now"
_ENFORCED: Final = "enforced: the vehicle's position is known again"
_NOT_ENFORCED: Final = "not enforced: the vehicle's position is unknown"

_log = logging.getLogger(__name__)


class Counters:
    """Counters, and the delays of recent commands. Each name is counted under one lock or on one thread."""

    def __init__(self) -> None:
        self.counts: defaultdict[str, int] = defaultdict(int)
        self.delays_ns: deque[int] = deque(maxlen=WINDOW)  #: delays of accepted commands, from sending to applying

    def snapshot(self, **now: float) -> dict[str, float]:
        """Return all counters, the distribution of command delays [s], and the counters that the caller adds."""
        values: dict[str, float] = {name: float(count) for name, count in self.counts.copy().items()}
        values.update(now)
        delays = sorted(self.delays_ns.copy())
        if delays:
            values["commands.delay.median_s"] = delays[len(delays) // 2] / NS_PER_S
            values["commands.delay.p99_s"] = delays[int(0.99 * (len(delays) - 1))] / NS_PER_S
            values["commands.delay.max_s"] = delays[-1] / NS_PER_S
            values["commands.delay.mean_s"] = sum(delays) / len(delays) / NS_PER_S
            values["commands.delay.count"] = float(len(delays))
        return dict(sorted(values.items()))


class EventPublisher:
    """Numbers and publishes the events of one run. Thread-safe. Never raises."""

    def __init__(
        self, publish: Callable[[str, bytes], int], clock: Clock, counters: Counters, scrub: Callable[[str], str] = str
    ) -> None:
        """Initialise; ``scrub`` removes secrets from text."""
        self._scrub = scrub
        self._publish = publish
        self._clock = clock
        self._counts = counters.counts
        self._lock = threading.Lock()  # keeps events in the order of their numbers
        self._seq = 0
        self._repeats = RepeatedEvents()
        self._missed = 0
        self.listener: Callable[[Event], None] | None = None  #: called with each event; must be quick and never raise
        self.last: Event | None = None  #: the newest event that is not an application's connection or disconnection

    def publish(
        self,
        kind: EventKind,
        text: str,
        severity: Severity = Severity.INFO,
        *,
        app: str | None = None,
        data: dict[str, Value] | None = None,
    ) -> None:
        with self._lock:
            self._send([EventDraft(kind, text, severity, app, data or {})])

    def publish_drafts(self, *drafts: EventDraft) -> None:
        with self._lock:
            self._send(drafts)

    def publish_repeated(self, key: Hashable, make: Callable[[], EventDraft]) -> None:
        """Publish an event that may occur many times a second. ``make`` is called only when the event is published."""
        with self._lock:
            if self._repeats.first(key, make):
                draft = make()
                self._repeats.begin(key, make, self._clock())
                self._send([replace(draft, data={**draft.data, "count": 1})])

    def tick(self, now_ns: int) -> None:
        """Publish how many events were repeated and how many could not be delivered. Call several times a second."""
        with self._lock:
            for draft, count in self._repeats.due(now_ns):
                text = f"{draft.text} (and {count} more like it within the last second)"
                self._send([replace(draft, text=text, data={**draft.data, "count": count})])
            if self._missed:
                missed, self._missed = self._missed, 0
                text = f"{missed} events could not be delivered to slow applications"
                self._send([EventDraft(EventKind.SAMPLES_LOST, text, data={"count": missed})])
                self._missed = 0  # if this event is lost, no other event reports the loss

    def _send(self, drafts: Sequence[EventDraft]) -> None:
        """Number events and publish them. The caller holds the lock."""
        scrub, packets = self._scrub, []
        scrubbed = [
            (one, scrub(one.text), {key: scrub(it) if isinstance(it, str) else it for key, it in one.data.items()})
            for one in drafts
        ]
        for draft, text, data in scrubbed:
            self._seq += 1
            kind, severity, app = draft.kind, draft.severity, draft.app
            if len(text) > MAX_TEXT or not text.isascii():
                text = shortened(text, MAX_TEXT)
            event = Event(kind, text, self._clock(), severity, self._seq, app, data)
            try:
                packets.append(encode(event))
            except (ValueError, TypeError, OverflowError) as error:  # a driver's data may be anything
                _log.error("event %s had data that cannot be sent: %s", kind, error)
                packets.append(encode(Event(kind, text, event.at_ns, severity, self._seq, app)))
            if self.listener is not None:
                self.listener(event)
            if kind is not EventKind.APPLICATION_LINK:
                self.last = event
            self._counts["events.published"] += 1
            self._counts[f"events.of.{kind.value}"] += 1
        for packet in packets:
            if missed := self._publish(EVENTS, packet):
                self._missed += missed
                self._counts["events.missed"] += missed


@dataclass(slots=True)
class EventDraft:
    """An event that has no number or time yet."""

    kind: EventKind
    text: str
    severity: Severity = Severity.WARNING
    app: str | None = None
    data: dict[str, Value] = field(default_factory=dict)


class RepeatedEvents:
    """Decides when to publish events that may occur many times a second: the first at once, then totals once a second.

    A total contains the text of the newest event, because the reason for a refusal may change between repeats.
    """

    def __init__(self) -> None:
        self._published: dict[Hashable, tuple[int, Callable[[], EventDraft]]] = {}
        self._counts: dict[Hashable, int] = {}

    def first(self, key: Hashable, draft: Callable[[], EventDraft]) -> bool:
        """Return whether an event is the first with its key (then publish it and call :meth:`begin`), or count it."""
        count = self._counts.get(key)
        if count is None:
            return True
        self._counts[key] = count + 1
        self._published[key] = (self._published[key][0], draft)
        return False

    def begin(self, key: Hashable, draft: Callable[[], EventDraft], now_ns: int) -> None:
        """Record that the first event with this key, or its total, was published."""
        self._published[key] = (now_ns, draft)
        self._counts[key] = 0

    def due(self, now_ns: int) -> list[tuple[EventDraft, int]]:
        """Return the totals that are due; forget the events that were not repeated."""
        due: list[tuple[EventDraft, int]] = []
        for key, (published_ns, draft) in list(self._published.items()):
            if now_ns - published_ns < REPEAT_NS:
                continue
            count = self._counts[key]
            if count:
                due.append((draft(), count))
                self.begin(key, draft, now_ns)
            else:
                del self._published[key], self._counts[key]
        return due


class Episodes:
    """Tracks the limits that are being touched, so that each is published once, not for every repeat."""

    def __init__(self) -> None:
        self._touched_ns: dict[tuple[str, str], int] = {}

    def begun(self, clamps: tuple[Clamp, ...], now_ns: int) -> list[Clamp]:
        """Return the clamps that start an episode."""
        touched, since_ns = self._touched_ns, now_ns - EPISODE_NS
        new = [clamp for clamp in clamps if touched.get((clamp.limit, clamp.zone), since_ns) <= since_ns]
        for clamp in clamps:
            touched[clamp.limit, clamp.zone] = now_ns
        return new


def refused_event(name: str, command: Command, reason: Refusal, why: str) -> EventDraft:
    text = f"{name}: {command.action.name} refused: {why}"
    return EventDraft(EventKind.COMMAND_REFUSED, text, app=name, data={"reason": reason.value, "seq": command.seq})


def clamped_event(name: str, clamp: Clamp) -> EventDraft:
    zone = f" ({clamp.zone})" if clamp.zone else ""
    text = f"{name}: {clamp.limit}{zone} allows {clamp.applied:.3g} of {clamp.asked:.3g}"
    data: dict[str, Value] = {"limit": clamp.limit, "asked": clamp.asked, "applied": clamp.applied}
    if clamp.zone:
        data["zone"] = clamp.zone
    return EventDraft(EventKind.COMMAND_CLAMPED, text, Severity.INFO, name, data)


def enforcement_event(enforced: bool) -> EventDraft:
    """Return the event for the safety box and zones being enforced, or no longer being enforced."""
    text = f"the safety box and zones are {_ENFORCED if enforced else _NOT_ENFORCED}"
    severity = Severity.INFO if enforced else Severity.WARNING
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, severity, data={"reason": "safety", "enforced": enforced})


def thin_zones_event(space: Space) -> EventDraft:
    """Return the event for zones that are enforced as if they were thicker."""
    thin = "; ".join(str(zone) for zone in space.thin)
    text = f"no-fly zones thinner than {THINNEST_M:g} m are enforced as if they were that thick: {thin} ({ZONES})"
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, data={"reason": "thin_zones"})


def position_jumped_event(jumped_m: float, *, lands: bool) -> EventDraft:
    """Return the event for a jump of the position. ``lands``: whether the vehicle was landing."""
    what = "keeps landing" if lands else "hovers until a new command"
    text = f"the vehicle's position jumped by {jumped_m:.1f} m: it {what}"
    data: dict[str, Value] = {"reason": "position_jumped", "jumped_m": jumped_m}
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, data=data)


def given_up_event(what: str) -> EventDraft:
    """Return the event for a hover or landing that was abandoned because the vehicle was silent."""
    text = f"the {what} was abandoned: {UNHEARD}: {'land' if what == 'landing' else 'command'} it again once it is back"
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.ERROR, data={"reason": f"{what}_given_up"})


def drift_event(drifts: bool) -> EventDraft:
    """Return the event for the software autopilot losing the velocity, or having it again."""
    if not drifts:
        text = "the vehicle's velocity is known again: its drift is corrected"
        return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.INFO, data={"reason": "drift", "active": False})
    text = "the vehicle's velocity is unknown: it is held level, so it is not braked and drifts with the wind"
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, data={"reason": "drift", "active": True})


def emergency_event(name: str) -> EventDraft:
    text = f"emergency stop by {name}"
    return EventDraft(EventKind.EMERGENCY, text, Severity.ERROR, name, {"reason": text})


def failsafe_event(change: StepChange) -> EventDraft:
    why = REASONS.get(change.reason, change.reason)
    if change.step is Failsafe.NONE:
        text, severity = f"failsafe ended: {why}", Severity.INFO
    else:
        what = "return to the start and land there" if change.returns else change.step.value
        text, severity = f"failsafe: {what}, because {why}", Severity.WARNING
        if change.why:
            text += f"; it can't return to its start: {change.why}"
    data: dict[str, Value] = {"step": change.step.value, "reason": change.reason, "returns": change.returns}
    return EventDraft(EventKind.FAILSAFE, text, severity, data=data)


def battery_event(low: BatteryLow) -> EventDraft:
    text = f"battery low: {low.battery:.0%} left"
    return EventDraft(EventKind.BATTERY_LOW, text, data={"battery": low.battery})


def taken_event(name: str, action: str, others: str) -> EventDraft:
    """Return the event for the application ``name`` taking the vehicle. ``others``: what others did with it before."""
    text = f"{name} took the vehicle by {action}: {others}"
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, app=name, data={"reason": "taken"})


def ownership_event(changed: Changed) -> EventDraft:
    """Return the event for a flight that is not this proxy's, or that an earlier run began."""
    reason = "others" if changed.whose is Whose.OTHERS else "flight"
    return EventDraft(EventKind.VEHICLE_MESSAGE, changed.why, data={"reason": reason})


def slept_event(slept_s: float) -> EventDraft:
    """Return the event that reports how long this computer slept [s]."""
    text = f"this computer slept for {slept_s:.1f} s: earlier commands are no longer executed"
    data: dict[str, Value] = {"reason": "slept", "seconds": slept_s}
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, data=data)


class Named(Protocol):
    """A connected application."""

    name: str
    peer: Peer


def name_of(sessions: Mapping[int, Named], app_id: int) -> str:
    session = sessions.get(app_id)
    return session.name if session is not None else f"application {app_id}"


def authority_event(
    effect: authority.Effect, sessions: Mapping[int, Named], holder: authority.QueueEntry | None, now_ns: int
) -> EventDraft:
    """Return the event for one change in authority. ``holder``: the holder after all changes."""
    name, severity = name_of(sessions, effect.app_id), Severity.WARNING
    data: dict[str, Value] = {"app_id": effect.app_id}
    if not isinstance(effect, authority.Queued | authority.Declined):
        data["lease"] = effect.lease
    by = ""
    if isinstance(effect, authority.Preempted | authority.Asked | authority.Withdrawn):
        by = name_of(sessions, effect.by_id)
        data |= {"by": by, "by_id": effect.by_id}
    if isinstance(effect, authority.Preempted | authority.Asked):
        data["by_priority"] = effect.by_priority
    match effect:
        case authority.Granted():
            kind, severity, term = EventKind.AUTHORITY_GRANTED, Severity.INFO, ""
            session = sessions.get(effect.app_id)
            data |= {"priority": effect.priority, "identity": "" if session is None else session.peer.address}
            if effect.until_ns is not None:
                data["until_ns"] = effect.until_ns
                term = f", for {seconds(effect.until_ns - now_ns):.0f} s"
            text = f"{name} has the authority (priority {effect.priority}, lease {effect.lease}{term})"
        case authority.Queued():
            kind, severity = EventKind.AUTHORITY_QUEUED, Severity.INFO
            data |= {"priority": effect.priority, "position": effect.position}
            text = f"{name} waits for the authority, number {effect.position} in the queue"
            if effect.wait_ns is not None:
                data["wait_s"] = seconds(effect.wait_ns)
                text += f", for about {seconds(effect.wait_ns):.0f} s"
        case authority.Lost():
            kind, text = EventKind.AUTHORITY_LOST, f"{name} lost the authority: {effect.reason}"
            data |= {"reason": effect.reason, "by": "" if holder is None else name_of(sessions, holder.app_id)}
            if effect.reason == "silent" and holder is None:
                text += "; it is listed as the holder until another application requests it"
        case authority.Preempted():
            kind = EventKind.AUTHORITY_PREEMPTED
            data["granted"] = effect.granted
            text = f"{by} (priority {effect.by_priority}) took the authority over from {name}"
            if effect.granted:
                text = f"{name} handed the authority over to {by} (priority {effect.by_priority})"
        case authority.Asked():
            kind, within_s = EventKind.AUTHORITY_ASKED, seconds(effect.until_ns - now_ns)
            data["within_s"] = within_s
            if effect.term_ns is not None:
                data["for_s"] = seconds(effect.term_ns)
            text = f"{by} (priority {effect.by_priority}) asks {name} for the authority within {within_s:.0f} s"
        case authority.Declined():
            kind, severity, by = EventKind.AUTHORITY_DECLINED, Severity.INFO, name_of(sessions, effect.holder_id)
            data |= {"by": by, "by_id": effect.holder_id, "reason": effect.reason}
            why = f": {effect.reason}" if effect.reason else ""
            text = f"{by} declines to hand the authority over to {name} now{why}"
        case authority.Withdrawn():
            kind, severity = EventKind.AUTHORITY_WITHDRAWN, Severity.INFO
            text = f"{by} no longer asks {name} to hand over the authority"
        case authority.Expired():
            kind = EventKind.AUTHORITY_EXPIRED
            text = f"the time of {name} is over: the next application to request the authority gets it"
    return EventDraft(kind, text, severity, name, data)
