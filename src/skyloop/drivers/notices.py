"""Something for the sink's ``event``."""

from __future__ import annotations

from dataclasses import dataclass, field

from skyloop.messages import EventKind, Severity, Value


@dataclass(frozen=True, slots=True)
class Notice:
    """What is told, to whom it may concern."""

    kind: EventKind
    text: str
    severity: Severity = Severity.INFO
    data: dict[str, Value] = field(default_factory=dict)


def message(text: str, reason: str, severity: Severity = Severity.INFO, **data: Value) -> Notice:
    """Of the vehicle itself, with a word for programs."""
    return Notice(EventKind.VEHICLE_MESSAGE, text, severity, {"reason": reason, **data})
