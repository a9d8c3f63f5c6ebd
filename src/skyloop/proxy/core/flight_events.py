"""The events of commands, failsafe and ownership: their kinds, texts for people and data. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.clock import seconds
from skyloop.messages import Command, EventKind, Failsafe, Refusal, Severity, Value
from skyloop.proxy.core.events import EventDraft
from skyloop.proxy.core.failsafe import REASONS, BatteryLow, StepChange
from skyloop.proxy.core.flight import BELIEF_NS, Changed, Whose
from skyloop.proxy.core.limits import Clamp
from skyloop.zones import THINNEST_M, ZONES, Space

#: Why a landing is given up.
UNHEARD: Final = f"the vehicle was not heard for {seconds(BELIEF_NS):g} s, and may be on another flight by now"
_ENFORCED: Final = "enforced: its position is known again"
_NOT_ENFORCED: Final = "not enforced: the vehicle's position is not known"


def refused_event(name: str, command: Command, reason: Refusal, why: str) -> EventDraft:
    """A command of the application ``name`` was refused."""
    text = f"{name}: {command.action.name} refused: {why}"
    return EventDraft(EventKind.COMMAND_REFUSED, text, app=name, data={"reason": reason.value, "seq": command.seq})


def clamped_event(name: str, clamp: Clamp) -> EventDraft:
    """A limit shortened a set-point of the application ``name``."""
    zone = f" ({clamp.zone})" if clamp.zone else ""
    text = f"{name}: {clamp.limit}{zone} made {clamp.applied:.3g} of {clamp.asked:.3g}"
    data: dict[str, Value] = {"limit": clamp.limit, "asked": clamp.asked, "applied": clamp.applied}
    if clamp.zone:
        data["zone"] = clamp.zone
    return EventDraft(EventKind.COMMAND_CLAMPED, text, Severity.INFO, name, data)


def enforcement_event(enforced: bool) -> EventDraft:
    """The safety box and zones are, or are not, enforced from now on."""
    text = f"the safety box and zones are {_ENFORCED if enforced else _NOT_ENFORCED}"
    severity = Severity.INFO if enforced else Severity.WARNING
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, severity, data={"reason": "safety", "enforced": enforced})


def thin_zones_event(space: Space) -> EventDraft:
    """Some zones are kept clear of as if they were thicker than they are written."""
    thin = "; ".join(str(zone) for zone in space.thin)
    text = f"no-fly zones thinner than {THINNEST_M:g} m are kept clear of as if they were so thick: {thin} ({ZONES})"
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, data={"reason": "thin_zones"})


def position_jumped_event(jumped_m: float, *, lands: bool) -> EventDraft:
    """The position changed by more than the vehicle can have flown; ``lands``: while it was landed."""
    what = "goes on to land" if lands else "hovers, until something new is commanded"
    text = f"the vehicle's position jumped by {jumped_m:.1f} m: it {what}"
    data: dict[str, Value] = {"reason": "position_jumped", "jumped_m": jumped_m}
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, data=data)


def landing_given_up_event() -> EventDraft:
    """A pilot's landing is given up because the vehicle was not heard."""
    text = f"the landing is given up: {UNHEARD}: land it again when it is heard"
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.ERROR, data={"reason": "landing_given_up"})


def emergency_event(name: str) -> EventDraft:
    """The application ``name`` stopped the motors."""
    text = f"emergency stop by {name}"
    return EventDraft(EventKind.EMERGENCY, text, Severity.ERROR, name, {"reason": text})


def failsafe_event(change: StepChange) -> EventDraft:
    """A step of the failsafe ladder was taken or left."""
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
    """The battery fell below the warning level."""
    text = f"battery low: {low.battery:.0%} left"
    return EventDraft(EventKind.BATTERY_LOW, text, data={"battery": low.battery})


def taken_event(name: str, action: str, others: str) -> EventDraft:
    """The application ``name`` took the vehicle from others by an action; ``others`` says what they did with it."""
    text = f"{name} took the vehicle by {action}: {others}"
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, app=name, data={"reason": "taken"})


def ownership_event(changed: Changed) -> EventDraft:
    """The flight is somebody else's, or an earlier run's."""
    reason = "others" if changed.whose is Whose.OTHERS else "flight"
    return EventDraft(EventKind.VEHICLE_MESSAGE, changed.why, data={"reason": reason})


def slept_event(slept_s: float) -> EventDraft:
    """The computer slept in the meantime, for so long [s]."""
    text = f"this computer slept for {slept_s:.1f} s: nothing that was asked for before is done any more"
    data: dict[str, Value] = {"reason": "slept", "seconds": slept_s}
    return EventDraft(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, data=data)
