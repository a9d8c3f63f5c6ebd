"""What an AR.Drone's state and configuration say about a flight. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.ardrone.wire.keys import NO_CEILING_MM
from skyloop.vehicles.ardrone.wire.navdata import State

#: Bits that speak against a flight: what is examined, what it means, what to do, and whether it keeps the drone down.
_BITS: Final = (
    (State.MOTORS_PROBLEM, "motors", "a motor does not answer: it won't take off", "turn each rotor by hand", True),
    (State.SOFTWARE_FAULT, "firmware", "the drone reports a fault: it may not fly", "switch it off and on", True),
    (State.ANGLES_OUT_OF_RANGE, "angles", "it is tilted too far: it won't take off", "put it level", True),
    (State.ULTRASOUND_DEAF, "height", "its ultrasound is deaf: it does not know its height", "clean the sensor", True),
    (
        State.MAGNETOMETER_UNCALIBRATED,
        "compass",
        "its compass is not calibrated: absolute headings are wrong",
        "in flight, write true to ardrone.calibrate_magnetometer",
        False,
    ),
    (State.WIND, "wind", "too much wind: it may not hold its place", "fly indoors, or later", False),
)


def diagnose(state: State | None, values: Mapping[str, str]) -> list[Diagnostic]:
    """Return what is found.

    Args:
        state: The newest bits; None: none came.
        values: The configuration by the drone's keys; empty before it was read.
    """
    found = [
        Diagnostic(what, False, detail, advice, severe)
        for bit, what, detail, advice, severe in _BITS
        if state is not None and state & bit
    ]
    if not values:
        return [*found, Diagnostic("configuration", False, "it was not read yet: its limits are not known", "wait")]
    ceiling_mm = _number(values.get("control:altitude_max"))
    if ceiling_mm is not None:
        high = ceiling_mm >= NO_CEILING_MM
        detail = "none: it can climb out of reach" if high else f"{ceiling_mm / 1000:g} m"
        found.append(Diagnostic("ceiling", not high, detail, "write limits.altitude, in metres" if high else ""))
    outdoor, bare = (values.get(f"control:{key}") == "TRUE" for key in ("outdoor", "flight_without_shell"))
    if outdoor or bare:
        detail = f"outdoor limits {'on' if outdoor else 'off'}, outdoor hull {'on' if bare else 'off'}: " + (
            "it flies faster than indoors" if outdoor else "its rotors are not guarded"
        )
        found.append(Diagnostic("indoors", False, detail, "for a flight indoors write false to both, and use the hull"))
    return found


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None
