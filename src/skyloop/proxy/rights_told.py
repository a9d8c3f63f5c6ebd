"""What is told of each change of the authority: the event's kind, its text for people and its particulars. Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from skyloop.clock import seconds
from skyloop.messages import EventKind, Severity, Value
from skyloop.proxy import authority as rights
from skyloop.proxy.events import Notice


@dataclass(frozen=True, slots=True)
class Scene:
    """What the words need to know besides the change itself."""

    now_ns: int
    name: Callable[[int], str]  #: of an application, by its number
    identity: Callable[[int], str]  #: what the transport knows of who it is
    holder: str  #: name of who holds the authority now; empty for nobody


def tell(effect: rights.Effect, scene: Scene) -> Notice:
    """The event of one change."""
    notice = _WORDS[type(effect)](effect, scene)
    notice.app = scene.name(effect.app_id)
    notice.data = {"app_id": effect.app_id, **notice.data}
    return notice


def _granted(effect: rights.Granted, scene: Scene) -> Notice:
    data: dict[str, Value] = {"priority": effect.priority, "lease": effect.lease}
    data["identity"] = scene.identity(effect.app_id)
    term = ""
    if effect.until_ns is not None:
        data["until_ns"] = effect.until_ns
        term = f", for {seconds(effect.until_ns - scene.now_ns):.0f} s"
    text = f"{scene.name(effect.app_id)} has the authority (priority {effect.priority}, lease {effect.lease}{term})"
    return Notice(EventKind.AUTHORITY_GRANTED, text, Severity.INFO, data=data)


def _queued(effect: rights.Queued, scene: Scene) -> Notice:
    data: dict[str, Value] = {"priority": effect.priority, "position": effect.position}
    text = f"{scene.name(effect.app_id)} waits for the authority, number {effect.position} in line"
    if effect.wait_ns is not None:
        data["wait_s"] = seconds(effect.wait_ns)
        text += f", for about {seconds(effect.wait_ns):.0f} s"
    return Notice(EventKind.AUTHORITY_QUEUED, text, Severity.INFO, data=data)


def _lost(effect: rights.Lost, scene: Scene) -> Notice:
    text = f"{scene.name(effect.app_id)} lost the authority: {effect.reason}"
    if effect.reason == "silent" and not scene.holder:
        text += "; the name stays on it until somebody asks"
    data: dict[str, Value] = {"lease": effect.lease, "reason": effect.reason, "by": scene.holder}
    return Notice(EventKind.AUTHORITY_LOST, text, data=data)


def _preempted(effect: rights.Preempted, scene: Scene) -> Notice:
    name, by = scene.name(effect.app_id), scene.name(effect.by_id)
    if effect.granted:
        text = f"{name} handed the authority over to {by} (priority {effect.by_priority})"
    else:
        text = f"{by} (priority {effect.by_priority}) took the authority over from {name}"
    return Notice(EventKind.AUTHORITY_PREEMPTED, text, data=_by(effect, scene) | {"granted": effect.granted})


def _asked(effect: rights.Asked, scene: Scene) -> Notice:
    within_s = seconds(effect.until_ns - scene.now_ns)
    name, by = scene.name(effect.app_id), scene.name(effect.by_id)
    text = f"{by} (priority {effect.by_priority}) asks {name} for the authority, within {within_s:.0f} s"
    data = _by(effect, scene) | {"within_s": within_s}
    if effect.term_ns is not None:
        data["for_s"] = seconds(effect.term_ns)
    return Notice(EventKind.AUTHORITY_ASKED, text, data=data)


def _declined(effect: rights.Declined, scene: Scene) -> Notice:
    by, why = scene.name(effect.holder_id), f": {effect.reason}" if effect.reason else ""
    text = f"{by} does not hand the authority over to {scene.name(effect.app_id)} yet{why}"
    data: dict[str, Value] = {"by": by, "by_id": effect.holder_id, "reason": effect.reason}
    return Notice(EventKind.AUTHORITY_DECLINED, text, Severity.INFO, data=data)


def _withdrawn(effect: rights.Withdrawn, scene: Scene) -> Notice:
    by = scene.name(effect.by_id)
    data: dict[str, Value] = {"lease": effect.lease, "by": by, "by_id": effect.by_id}
    text = f"{by} no longer asks {scene.name(effect.app_id)} for the authority"
    return Notice(EventKind.AUTHORITY_WITHDRAWN, text, Severity.INFO, data=data)


def _expired(effect: rights.Expired, scene: Scene) -> Notice:
    text = f"the time of {scene.name(effect.app_id)} is over: the authority goes to whoever asks next"
    return Notice(EventKind.AUTHORITY_EXPIRED, text, data={"lease": effect.lease})


def _by(effect: rights.Preempted | rights.Asked, scene: Scene) -> dict[str, Value]:
    by = scene.name(effect.by_id)
    return {"lease": effect.lease, "by": by, "by_id": effect.by_id, "by_priority": effect.by_priority}


_WORDS: Final[dict[type[rights.Effect], Callable[[Any, Scene], Notice]]] = {
    rights.Granted: _granted,
    rights.Queued: _queued,
    rights.Lost: _lost,
    rights.Preempted: _preempted,
    rights.Asked: _asked,
    rights.Declined: _declined,
    rights.Withdrawn: _withdrawn,
    rights.Expired: _expired,
}
