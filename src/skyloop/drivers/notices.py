"""Events that a session has for the sink."""

from __future__ import annotations

from dataclasses import dataclass, field

from skyloop.messages import EventKind, Severity, Value


@dataclass(frozen=True, slots=True)
class Notice:
    """An event, with the arguments of :meth:`skyloop.drivers.base.Sink.event`."""

    kind: EventKind
    text: str
    severity: Severity = Severity.INFO
    data: dict[str, Value] = field(default_factory=dict)


def message(text: str, reason: str, severity: Severity = Severity.INFO, **data: Value) -> Notice:
    """Return a message of the vehicle itself.

    Args:
        text: For people.
        reason: One word for programs, in the event's data.
        severity: For people and for filters.
        **data: More for programs.
    """
    return Notice(EventKind.VEHICLE_MESSAGE, text, severity, {"reason": reason, **data})
