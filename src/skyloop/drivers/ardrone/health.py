"""What the drone's state bits say of its health: each change told once. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.drivers.notices import Notice
from skyloop.messages import EventKind, Severity, Value
from skyloop.wire.ardrone.navdata import State

#: Bit, its name in events' data, what it means while it is set.
_CONDITIONS: Final = (
    (State.COMMUNICATION_LOST, "communication_lost", "the drone says that it lost its link to us", Severity.WARNING),
    (State.BATTERY_LOW, "battery_low", "the drone's battery is low", Severity.WARNING),
    (State.ULTRASOUND_DEAF, "ultrasound", "the drone's ultrasound hears nothing", Severity.WARNING),
    (State.MOTORS_PROBLEM, "motors", "the drone has a problem with its motors", Severity.ERROR),
    (State.SOFTWARE_FAULT, "software", "the drone detected a fault of its software", Severity.ERROR),
    (State.ANGLES_OUT_OF_RANGE, "angles", "the drone tilted too far", Severity.WARNING),
    (State.CUTOUT, "cutout", "a motor of the drone was blocked", Severity.WARNING),
    (State.WIND, "wind", "the wind is too strong for the drone", Severity.WARNING),
    (State.MAGNETOMETER_UNCALIBRATED, "magnetometer", "the drone's magnetometer needs calibration", Severity.INFO),
    (State.TIMER_ELAPSED, "timer", "the drone's timer elapsed", Severity.WARNING),
)
#: Why the motors were cut, as far as a bit says it.
_REASONS: Final = (
    (State.USER_EMERGENCY, "user"),
    (State.ANGLES_OUT_OF_RANGE, "angles"),
    (State.CUTOUT, "cutout"),
    (State.MOTORS_PROBLEM, "motors"),
    (State.ULTRASOUND_DEAF, "ultrasound"),
    (State.BATTERY_LOW, "battery"),
    (State.SOFTWARE_FAULT, "software"),
    (State.COMMUNICATION_LOST, "communication_lost"),
)


def emergency_reason(state: State) -> str:
    """Why the motors are cut: names joined by commas, or ``unknown``."""
    return ",".join(name for bit, name in _REASONS if state & bit) or "unknown"


class Health:
    """Remembers the bits that were told."""

    def __init__(self) -> None:
        self._told = State(0)

    def notices(self, state: State) -> list[Notice]:
        """What changed since the last call."""
        before, self._told = self._told, state
        changed = before ^ state
        found = []
        if changed & State.EMERGENCY:
            found.append(_emergency(state))
        for bit, name, text, severity in _CONDITIONS:
            if not changed & bit:
                continue
            data: dict[str, Value] = {"reason": name, "active": bool(state & bit)}
            if state & bit:
                found.append(Notice(EventKind.VEHICLE_MESSAGE, text, severity, data))
            else:
                found.append(Notice(EventKind.VEHICLE_MESSAGE, f"no longer: {text}", Severity.INFO, data))
        return found


def _emergency(state: State) -> Notice:
    if not state & State.EMERGENCY:
        return Notice(EventKind.VEHICLE_MESSAGE, "the drone left the emergency", Severity.INFO, {"reason": "reset"})
    reason = emergency_reason(state)
    text = f"the drone cut its motors ({reason}); reset the emergency when it lies safely"
    return Notice(EventKind.EMERGENCY, text, Severity.ERROR, {"reason": reason})
