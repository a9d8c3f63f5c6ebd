"""The event of each change of the authority: its kind, its text for people and its data. Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from skyloop.clock import seconds
from skyloop.messages import EventKind, Severity, Value
from skyloop.proxy.core import authority
from skyloop.proxy.core.events import EventDraft


@dataclass(frozen=True, slots=True)
class EventContext:
    """What an event's text needs besides the change itself."""

    now_ns: int
    name: Callable[[int], str]  #: name of an application, by its number
    identity: Callable[[int], str]  #: what the transport knows about an application
    holder: str  #: name of who holds the authority now; empty for nobody


def authority_event(effect: authority.Effect, context: EventContext) -> EventDraft:
    """Return the event of one change of the authority."""
    draft = _DRAFTS[type(effect)](effect, context)
    draft.app = context.name(effect.app_id)
    draft.data = {"app_id": effect.app_id, **draft.data}
    return draft


def _granted(effect: authority.Granted, context: EventContext) -> EventDraft:
    data: dict[str, Value] = {"priority": effect.priority, "lease": effect.lease}
    data["identity"] = context.identity(effect.app_id)
    term = ""
    if effect.until_ns is not None:
        data["until_ns"] = effect.until_ns
        term = f", for {seconds(effect.until_ns - context.now_ns):.0f} s"
    text = f"{context.name(effect.app_id)} has the authority (priority {effect.priority}, lease {effect.lease}{term})"
    return EventDraft(EventKind.AUTHORITY_GRANTED, text, Severity.INFO, data=data)


def _queued(effect: authority.Queued, context: EventContext) -> EventDraft:
    data: dict[str, Value] = {"priority": effect.priority, "position": effect.position}
    text = f"{context.name(effect.app_id)} waits for the authority, number {effect.position} in the queue"
    if effect.wait_ns is not None:
        data["wait_s"] = seconds(effect.wait_ns)
        text += f", for about {seconds(effect.wait_ns):.0f} s"
    return EventDraft(EventKind.AUTHORITY_QUEUED, text, Severity.INFO, data=data)


def _lost(effect: authority.Lost, context: EventContext) -> EventDraft:
    text = f"{context.name(effect.app_id)} lost the authority: {effect.reason}"
    if effect.reason == "silent" and not context.holder:
        text += "; it is still listed as the holder until another application asks"
    data: dict[str, Value] = {"lease": effect.lease, "reason": effect.reason, "by": context.holder}
    return EventDraft(EventKind.AUTHORITY_LOST, text, data=data)


def _preempted(effect: authority.Preempted, context: EventContext) -> EventDraft:
    name, by = context.name(effect.app_id), context.name(effect.by_id)
    if effect.granted:
        text = f"{name} handed the authority over to {by} (priority {effect.by_priority})"
    else:
        text = f"{by} (priority {effect.by_priority}) took the authority over from {name}"
    return EventDraft(EventKind.AUTHORITY_PREEMPTED, text, data=_by(effect, context) | {"granted": effect.granted})


def _asked(effect: authority.Asked, context: EventContext) -> EventDraft:
    within_s = seconds(effect.until_ns - context.now_ns)
    name, by = context.name(effect.app_id), context.name(effect.by_id)
    text = f"{by} (priority {effect.by_priority}) asks {name} for the authority, within {within_s:.0f} s"
    data = _by(effect, context) | {"within_s": within_s}
    if effect.term_ns is not None:
        data["for_s"] = seconds(effect.term_ns)
    return EventDraft(EventKind.AUTHORITY_ASKED, text, data=data)


def _declined(effect: authority.Declined, context: EventContext) -> EventDraft:
    by, why = context.name(effect.holder_id), f": {effect.reason}" if effect.reason else ""
    text = f"{by} does not hand the authority over to {context.name(effect.app_id)} yet{why}"
    data: dict[str, Value] = {"by": by, "by_id": effect.holder_id, "reason": effect.reason}
    return EventDraft(EventKind.AUTHORITY_DECLINED, text, Severity.INFO, data=data)


def _withdrawn(effect: authority.Withdrawn, context: EventContext) -> EventDraft:
    by = context.name(effect.by_id)
    data: dict[str, Value] = {"lease": effect.lease, "by": by, "by_id": effect.by_id}
    text = f"{by} no longer asks {context.name(effect.app_id)} for the authority"
    return EventDraft(EventKind.AUTHORITY_WITHDRAWN, text, Severity.INFO, data=data)


def _expired(effect: authority.Expired, context: EventContext) -> EventDraft:
    text = f"the time of {context.name(effect.app_id)} is over: the next application that asks gets the authority"
    return EventDraft(EventKind.AUTHORITY_EXPIRED, text, data={"lease": effect.lease})


def _by(effect: authority.Preempted | authority.Asked, context: EventContext) -> dict[str, Value]:
    by = context.name(effect.by_id)
    return {"lease": effect.lease, "by": by, "by_id": effect.by_id, "by_priority": effect.by_priority}


_DRAFTS: Final[dict[type[authority.Effect], Callable[[Any, EventContext], EventDraft]]] = {
    authority.Granted: _granted,
    authority.Queued: _queued,
    authority.Lost: _lost,
    authority.Preempted: _preempted,
    authority.Asked: _asked,
    authority.Declined: _declined,
    authority.Withdrawn: _withdrawn,
    authority.Expired: _expired,
}
