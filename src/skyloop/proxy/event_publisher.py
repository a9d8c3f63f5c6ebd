"""What the proxy reports about itself: numbered events for all clients, and counters on request."""

from __future__ import annotations

import logging
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Iterable
from typing import Final

from skyloop.clock import NS_PER_S, Clock
from skyloop.errors import shortened
from skyloop.messages import Event, EventKind, Severity, Value, encode
from skyloop.proxy.events import EventDraft, RepeatedEvents
from skyloop.transport.base import EVENTS

#: Command delays that the distribution is taken over: about a minute of one pilot at 32 Hz.
WINDOW: Final = 2000
MAX_TEXT: Final = 1000  #: characters of an event's text

_log = logging.getLogger(__name__)


class Counters:
    """Counts and the recent command delays. Each name is counted under one lock only, or by one thread."""

    def __init__(self) -> None:
        self.counts: defaultdict[str, int] = defaultdict(int)
        self.delays_ns: deque[int] = deque(maxlen=WINDOW)  #: sent to applied, of accepted commands

    def snapshot(self, **now: float) -> dict[str, float]:
        """All counters, the distribution of the command delay [s], and what the caller adds."""
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
    """Numbers and publishes the events of one run. Any thread; never raises."""

    def __init__(
        self,
        publish: Callable[[str, bytes], int],
        clock: Clock,
        counters: Counters,
        scrub: Callable[[str], str] = str,
    ) -> None:
        """Initialise; ``scrub`` takes what must not be told out of a text."""
        self._scrub = scrub
        self._publish = publish
        self._clock = clock
        self._counts = counters.counts
        self._lock = threading.Lock()  # keeps the order of publishing that of the numbers
        self._seq = 0
        self._repeats = RepeatedEvents()
        self._missed = 0
        self.listener: Callable[[Event], None] | None = None  #: called with each event; must be quick and never raise
        self.last: Event | None = None  #: the newest that is not about the coming and going of an application

    def publish(
        self,
        kind: EventKind,
        text: str,
        severity: Severity = Severity.INFO,
        *,
        app: str | None = None,
        data: dict[str, Value] | None = None,
    ) -> None:
        """Publish one event now."""
        with self._lock:
            self._number(kind, text, severity, app, data or {})

    def publish_draft(self, draft: EventDraft) -> None:
        """Publish one event now."""
        with self._lock:
            self._number(draft.kind, draft.text, draft.severity, draft.app, draft.data)

    def publish_all(self, drafts: Iterable[EventDraft]) -> None:
        """Publish these events now, in this order."""
        for draft in drafts:
            self.publish_draft(draft)

    def publish_repeated(self, key: Hashable, make: Callable[[], EventDraft]) -> None:
        """Publish an event that may come many times a second; ``make`` is called only when it is published."""
        with self._lock:
            if self._repeats.first(key, make):
                draft = make()
                self._repeats.begin(key, make, self._clock())
                self._number(draft.kind, draft.text, draft.severity, draft.app, {**draft.data, "count": 1})

    def tick(self, now_ns: int) -> None:
        """Publish sums of repeated events, and of those that could not be handed over. Call some times a second."""
        with self._lock:
            for draft, count in self._repeats.due(now_ns):
                text = f"{draft.text} (and {count} more like it within the last second)"
                self._number(draft.kind, text, draft.severity, draft.app, {**draft.data, "count": count})
            if self._missed:
                missed, self._missed = self._missed, 0
                text = f"{missed} events could not be handed over to applications that are too slow"
                self._number(EventKind.SAMPLES_LOST, text, Severity.WARNING, None, {"count": missed})
                self._missed = 0  # that this one was not handed over either needs no event

    def _number(self, kind: EventKind, text: str, severity: Severity, app: str | None, data: dict[str, Value]) -> None:
        self._seq += 1
        data = {name: self._scrub(value) if isinstance(value, str) else value for name, value in data.items()}
        event = Event(kind, shortened(self._scrub(text), MAX_TEXT), self._clock(), severity, self._seq, app, data)
        try:
            packet = encode(event)
        except (ValueError, TypeError, OverflowError) as error:  # a driver's data may be anything
            _log.error("event %s had particulars that cannot be sent: %s", kind, error)
            packet = encode(Event(kind, event.text, event.at_ns, severity, self._seq, app))
        if self.listener is not None:
            self.listener(event)
        if kind is not EventKind.APPLICATION_LINK:
            self.last = event
        missed = self._publish(EVENTS, packet)
        self._counts["events.published"] += 1
        self._counts[f"events.of.{kind.value}"] += 1
        if missed:
            self._missed += missed
            self._counts["events.missed"] += missed
