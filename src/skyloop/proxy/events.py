"""Events: numbered, published, and not repeated without end."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Final

from skyloop.clock import NS_PER_S, Clock
from skyloop.messages import Event, EventKind, Severity, Value, encode
from skyloop.proxy.statistics import Counters
from skyloop.transport.base import EVENTS

MAX_TEXT: Final = 1000  #: characters of an event's text
REPEAT_NS: Final = NS_PER_S  #: how often something that goes on is told again

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Notice:
    """Something that may happen many times a second. Told at once the first time, then in sums."""

    kind: EventKind
    text: str
    severity: Severity = Severity.WARNING
    app: str | None = None
    data: dict[str, Value] = field(default_factory=dict)


class Repeats:
    """Which repeated things are due to be told: the first at once, the others once a second with their count. Pure."""

    def __init__(self) -> None:
        self._told: dict[Hashable, tuple[int, Notice]] = {}
        self._counts: dict[Hashable, int] = {}

    def first(self, key: Hashable) -> bool:
        """Count one more; returns whether it is the first, which is to be given to :meth:`begin` and told now."""
        count = self._counts.get(key)
        if count is None:
            return True
        self._counts[key] = count + 1
        return False

    def begin(self, key: Hashable, notice: Notice, now_ns: int) -> None:
        """The first of its key was told."""
        self._told[key] = (now_ns, notice)
        self._counts[key] = 0

    def due(self, now_ns: int) -> list[tuple[Notice, int]]:
        """What went on for a second since it was last told, with how often. What did not is forgotten."""
        due: list[tuple[Notice, int]] = []
        for key, (told_ns, notice) in list(self._told.items()):
            if now_ns - told_ns < REPEAT_NS:
                continue
            count = self._counts[key]
            if count:
                due.append((notice, count))
                self.begin(key, notice, now_ns)
            else:
                del self._told[key], self._counts[key]
        return due


class EventLog:
    """Numbers and publishes the events of one run. Any thread; never raises."""

    def __init__(self, publish: Callable[[str, bytes], int], clock: Clock, counters: Counters) -> None:
        self._publish = publish
        self._clock = clock
        self._counts = counters.counts
        self._lock = threading.Lock()  # keeps the order of publishing that of the numbers
        self._seq = 0
        self._repeats = Repeats()
        self._missed = 0
        self.listener: Callable[[Event], None] | None = None  #: called with each event; must be quick and never raise

    def tell(
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
            self._tell(kind, text, severity, app, data or {})

    def repeated(self, key: Hashable, make: Callable[[], Notice]) -> None:
        """Tell something that may come many times a second; ``make`` is called only when it is told."""
        with self._lock:
            if self._repeats.first(key):
                notice = make()
                self._repeats.begin(key, notice, self._clock())
                self._tell(notice.kind, notice.text, notice.severity, notice.app, {**notice.data, "count": 1})

    def tick(self, now_ns: int) -> None:
        """Tell what went on repeatedly, and what could not be handed over. Call some times a second."""
        with self._lock:
            for notice, count in self._repeats.due(now_ns):
                text = f"{notice.text} (and {count} more like it within the last second)"
                self._tell(notice.kind, text, notice.severity, notice.app, {**notice.data, "count": count})
            if self._missed:
                missed, self._missed = self._missed, 0
                text = f"{missed} events could not be handed over to applications that are too slow"
                self._tell(EventKind.SAMPLES_LOST, text, Severity.WARNING, None, {"count": missed})
                self._missed = 0  # that this one was not handed over either is no news

    def _tell(self, kind: EventKind, text: str, severity: Severity, app: str | None, data: dict[str, Value]) -> None:
        self._seq += 1
        event = Event(kind, text[:MAX_TEXT], self._clock(), severity, self._seq, app, data)
        try:
            packet = encode(event)
        except (ValueError, TypeError, OverflowError) as error:  # a driver's data may be anything
            _log.error("event %s had particulars that cannot be sent: %s", kind, error)
            packet = encode(Event(kind, event.text, event.at_ns, severity, self._seq, app))
        if self.listener is not None:
            self.listener(event)
        missed = self._publish(EVENTS, packet)
        self._counts["events.published"] += 1
        if missed:
            self._missed += missed
            self._counts["events.missed"] += missed
