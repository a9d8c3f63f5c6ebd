"""Events before they are numbered and published, and how often one that goes on is repeated. Pure."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Final

from skyloop.clock import NS_PER_S
from skyloop.messages import EventKind, Severity, Value

REPEAT_NS: Final = NS_PER_S  #: how often an event that goes on is published again


@dataclass(slots=True)
class EventDraft:
    """An event without its number and time."""

    kind: EventKind
    text: str
    severity: Severity = Severity.WARNING
    app: str | None = None
    data: dict[str, Value] = field(default_factory=dict)


class RepeatedEvents:
    """Decides when events that may come many times a second are published: the first at once, then sums once a second.

    A sum has the text of the newest one: why something is refused may change while it is asked for again.
    """

    def __init__(self) -> None:
        self._published: dict[Hashable, tuple[int, Callable[[], EventDraft]]] = {}
        self._counts: dict[Hashable, int] = {}

    def first(self, key: Hashable, draft: Callable[[], EventDraft]) -> bool:
        """Count one more; returns whether it is the first of its key: publish it now and call :meth:`begin`."""
        count = self._counts.get(key)
        if count is None:
            return True
        self._counts[key] = count + 1
        self._published[key] = (self._published[key][0], draft)
        return False

    def begin(self, key: Hashable, draft: Callable[[], EventDraft], now_ns: int) -> None:
        """The first of its key, or a sum, was published."""
        self._published[key] = (now_ns, draft)
        self._counts[key] = 0

    def due(self, now_ns: int) -> list[tuple[EventDraft, int]]:
        """The events that went on for a second since they were last published, with their count; forgets the others."""
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
