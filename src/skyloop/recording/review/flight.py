"""What a report shows of a flight, computed from its tables. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.messages import FlightState
from skyloop.recording.review.svg import Mark, Span
from skyloop.recording.review.tables import Table

Floats = NDArray[np.float64]
_LONGEST_STEP_S: Final = 0.5  #: over a longer step a velocity is not integrated


@dataclass(frozen=True, slots=True)
class Way:
    """Where the drone was, in world axes: x east, y north [m]."""

    t_s: Floats
    x: Floats
    y: Floats
    source: str  #: where that is known from, in words

    @property
    def length_m(self) -> float:
        """Length of the path over ground."""
        return float(np.nansum(np.hypot(np.diff(self.x), np.diff(self.y))))


def way(feedback: Table) -> Way | None:
    """Return where the drone was; None if nothing is known of that.

    From the vehicle's position; else from the simulator's true one; else from its integrated velocity.
    """
    t_s = feedback.numbers("t_s")
    for source, x, y in (
        ("the vehicle's own position", "position_x_m", "position_y_m"),
        ("the simulator's true position", "native.truth.x", "native.truth.y"),
    ):
        if feedback.known(x) and feedback.known(y):
            return Way(t_s, feedback.numbers(x), feedback.numbers(y), source)
    if not (feedback.known("velocity_forward_m_s") and feedback.known("yaw_rad")):
        return None
    forward, left = feedback.numbers("velocity_forward_m_s"), feedback.numbers("velocity_left_m_s")
    yaw = feedback.numbers("yaw_rad")
    steps = np.diff(t_s, prepend=t_s[:1])
    steps = np.where(steps > _LONGEST_STEP_S, 0.0, steps)
    east = np.nan_to_num(forward * np.cos(yaw) - left * np.sin(yaw))
    north = np.nan_to_num(forward * np.sin(yaw) + left * np.cos(yaw))
    return Way(t_s, np.cumsum(east * steps), np.cumsum(north * steps), "summed up from the velocity: it drifts")


def spans(t_s: Floats, names: NDArray[np.str_], styles: dict[str, str], end_s: float) -> list[Span]:
    """Return the stretches of time with one name; empty names are left out.

    Args:
        t_s: Time of each sample.
        names: Name of each sample.
        styles: By name, with one for ``*``, any other; a name without a style is left out.
        end_s: End of the last stretch.
    """
    found: list[Span] = []
    if not len(t_s):
        return found
    begins = np.concatenate(([0], np.flatnonzero(names[1:] != names[:-1]) + 1))
    ends = np.concatenate((t_s[begins[1:]], [end_s]))
    for begin, end in zip(begins, ends, strict=True):
        name = str(names[begin])
        style = styles.get(name, styles.get("*", ""))
        if name and style:
            found.append(Span(float(t_s[begin]), float(end), name.replace("_", " "), style))
    return found


def marks(events: Table | None) -> list[Mark]:
    """Convert events to marks on the time axis."""
    if events is None:
        return []
    rows = zip(events.numbers("t_s"), events["text"], events["severity"], strict=True)
    return [Mark(float(t), str(text), str(severity)) for t, text, severity in rows]


def airborne_s(feedback: Table) -> float:
    """Return how long the drone was airborne [s]."""
    flying = np.isin(feedback["state"], [state.value for state in FlightState if state.airborne])
    steps = np.diff(feedback.numbers("t_s"))
    return float(steps[flying[:-1]].sum()) if len(steps) else 0.0


def facts(
    feedback: Table | None, commands: Table | None, path: Way | None, frames: int, seconds: float
) -> list[tuple[str, str]]:
    """Return the figures at the head of a report: name and value; only those that are known."""
    found = [("recorded", f"{seconds:.1f} s")]
    if feedback is not None and len(feedback):
        found.append(("in the air", f"{airborne_s(feedback):.1f} s"))
        altitude = feedback.numbers("altitude_m")
        if feedback.known("altitude_m"):
            found.append(("highest", f"{np.nanmax(altitude):.2f} m"))
        speed = np.hypot(feedback.numbers("velocity_forward_m_s"), feedback.numbers("velocity_left_m_s"))
        if np.isfinite(speed).any():
            found.append(("fastest", f"{np.nanmax(speed):.2f} m/s"))
        if path is not None:
            found.append(("way", f"{path.length_m:.1f} m"))
        battery = feedback.numbers("battery")
        battery = battery[np.isfinite(battery)]
        if len(battery):
            found.append(("battery", f"{battery[0]:.0%} → {battery[-1]:.0%}"))
    if commands is not None:
        found.append(("commands", str(len(commands))))
    if frames:
        found.append(("frames", str(frames)))
    return found
