"""The autopilot's flight states as a table: what leads from which state to which.

A pair that is not in the table is ignored, as firmware ignores what does not fit.
"""

from __future__ import annotations

from enum import Enum, auto

from skyloop.messages import FlightState


class Happening(Enum):
    """What changes a state: the pilot's commands first, then what the vehicle detects itself."""

    TAKEOFF = auto()
    LAND = auto()
    HOVER = auto()
    SET_POINT = auto()
    STOP = auto()
    RESET = auto()  # only on the ground: the caller checks
    HEIGHT_REACHED = auto()
    TOUCHED_GROUND = auto()
    CRASHED = auto()
    BATTERY_LOW = auto()
    BATTERY_EMPTY = auto()


_S, _H = FlightState, Happening
_IN_FLIGHT = {
    _H.HOVER: _S.HOVERING,
    _H.SET_POINT: _S.FLYING,
    _H.LAND: _S.LANDING,
    _H.STOP: _S.EMERGENCY,
    _H.CRASHED: _S.EMERGENCY,
    _H.BATTERY_LOW: _S.LANDING,
    _H.BATTERY_EMPTY: _S.EMERGENCY,
}

TRANSITIONS: dict[FlightState, dict[Happening, FlightState]] = {
    _S.LANDED: {_H.TAKEOFF: _S.TAKING_OFF, _H.STOP: _S.EMERGENCY},
    _S.TAKING_OFF: {
        _H.HEIGHT_REACHED: _S.HOVERING,
        _H.LAND: _S.LANDING,
        _H.STOP: _S.EMERGENCY,
        _H.CRASHED: _S.EMERGENCY,
        _H.BATTERY_LOW: _S.LANDING,
        _H.BATTERY_EMPTY: _S.EMERGENCY,
    },
    _S.HOVERING: _IN_FLIGHT,
    _S.FLYING: _IN_FLIGHT,
    _S.LANDING: {
        _H.HOVER: _S.HOVERING,  # as autopilots do: it breaks the landing off
        _H.TAKEOFF: _S.TAKING_OFF,
        _H.TOUCHED_GROUND: _S.LANDED,
        _H.STOP: _S.EMERGENCY,
        _H.CRASHED: _S.EMERGENCY,
        _H.BATTERY_EMPTY: _S.EMERGENCY,
    },
    _S.EMERGENCY: {_H.RESET: _S.LANDED},
}


def next_state(state: FlightState, happening: Happening) -> FlightState | None:
    """Return the state that follows, or None where the happening is ignored."""
    return TRANSITIONS[state].get(happening)
