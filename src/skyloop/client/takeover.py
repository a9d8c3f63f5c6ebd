"""Asking for the authority, and being asked for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from skyloop.errors import UsageError
from skyloop.messages import (
    HIGHEST_PRIORITY,
    LONGEST_TERM_S,
    LOWEST_PRIORITY,
    Event,
    EventKind,
    RequestAuthority,
    Takeover,
    Value,
)

if TYPE_CHECKING:
    from skyloop.client.pilot import Pilot

TakeoverWay = Literal["now", "ask"]
#: True: hand it over; False, or the reason as a text: not yet; None: no answer.
TakeoverAnswer = bool | str | None


@dataclass(frozen=True, slots=True)
class TakeoverRequest:
    """Another application asks for the authority that this one holds."""

    by: str  #: its name
    priority: int  #: 0 is the highest
    within_s: float  #: after so long it wins, if its priority is strictly higher
    for_s: float | None  #: for how long it wants it; None: it does not say
    lease: int  #: the lease that is to be given up
    by_id: int = 0  #: its number in this run of the proxy


def authority_wish(priority: int, for_s: float | None = None, takeover: TakeoverWay = "now") -> RequestAuthority:
    """The request. Raises :class:`UsageError` for what makes no sense."""
    if not isinstance(priority, int) or not HIGHEST_PRIORITY <= priority <= LOWEST_PRIORITY:
        raise UsageError(f"priority is {priority!r} and must be a whole number from 0 (highest) to 31 (lowest)")
    if takeover not in ("now", "ask"):
        raise UsageError(f'takeover is {takeover!r} and must be "now" or "ask"')
    if for_s is not None and not (isinstance(for_s, int | float) and 0.0 < for_s <= LONGEST_TERM_S):
        raise UsageError(f"for_s is {for_s!r} and must be a number of seconds, more than 0 and at most a day")
    return RequestAuthority(priority, True, None if for_s is None else float(for_s), Takeover(takeover))


def answering(function: Callable[[TakeoverRequest], TakeoverAnswer], pilot: Pilot) -> Callable[[Event], None]:
    """A listener to events that calls the function when this application is asked, and sends its answer."""
    if not callable(function):
        raise UsageError(f"{function!r:.80} can't be called: a function with one argument is needed")

    def hear(event: Event) -> None:
        request = takeover_request(event, pilot.app_id)
        if request is None:
            return
        answer = function(request)
        if answer is not None:
            pilot.answer(request.lease, request.by_id, answer is True, answer if isinstance(answer, str) else "")

    return hear


def takeover_request(event: Event, app_id: int) -> TakeoverRequest | None:
    """What an event asks the application with this number; None if it asks nothing, or somebody else."""
    data = event.data
    if event.kind is not EventKind.AUTHORITY_ASKED or data.get("app_id") != app_id:
        return None
    lease, by_id = data.get("lease"), data.get("by_id")
    if not isinstance(lease, int) or not isinstance(by_id, int):
        return None
    priority = data.get("by_priority")
    return TakeoverRequest(
        str(data.get("by", "")),
        priority if isinstance(priority, int) else LOWEST_PRIORITY,
        _number(data.get("within_s")) or 0.0,
        _number(data.get("for_s")),
        lease,
        by_id,
    )


def _number(value: Value | None) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
