"""Events: the thin stream of what happened and why."""

from __future__ import annotations

import msgspec

from skyloop.messages.feedback import Value
from skyloop.messages.fields import EventKind, Severity
from skyloop.messages.numbers import Count, TimeNs


class Event(msgspec.Struct, frozen=True, array_like=True):
    """One thing that happened. ``text`` is for people, ``kind`` and ``data`` for programs."""

    kind: EventKind
    text: str
    at_ns: TimeNs  #: on the proxy's clock
    severity: Severity = Severity.INFO
    seq: Count = 0  #: grows by one per proxy's run; 0 for events made by the client itself
    app: str | None = None  #: the application it concerns
    data: dict[str, Value] = msgspec.field(default_factory=dict)
