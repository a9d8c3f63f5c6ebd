"""What a report shows of a flight: its course and figures, computed from its tables, and its key frames."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError, MissingExtraError
from skyloop.messages import FlightState
from skyloop.messages.frame import H264
from skyloop.recording.pictures import Picture
from skyloop.recording.reader import Recording
from skyloop.recording.review.charts import Mark, Span
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


# Key frames -----------------------------------------------------------------------------------------------------


WIDTH: Final = 360  #: of a thumbnail [px]
_QUALITY: Final = 80
_TELLING: Final = ("state_changed", "collision", "failsafe", "emergency", "authority_preempted")
_NEAR: Final = 0.4  #: share of the usual distance: an even frame is left out if one at an event is nearer than this


def moments(first_s: float, last_s: float, events: Table | None, most: int) -> list[tuple[float, str]]:
    """Select times to show, in order, each with the reason: up to half at events, the others evenly. Pure.

    Args:
        first_s: Time of the first frame.
        last_s: Time of the last frame.
        events: Of the flight; None without any.
        most: How many.
    """
    if most < 1 or last_s < first_s:
        return []
    chosen: list[tuple[float, str]] = []
    if events is not None:
        rows = zip(events.numbers("t_s"), events["kind"], events["severity"], events["text"], strict=True)
        candidates = [
            (float(t), str(text))
            for t, kind, severity, text in rows
            if first_s <= t <= last_s and (kind in _TELLING or severity != "info")
        ]
        step = max(1, -(-len(candidates) // max(1, most // 2)))
        chosen = candidates[::step]
    even = np.linspace(first_s, last_s, most)
    distance = (last_s - first_s) / max(1, most - 1)
    for t in even:
        if len(chosen) < most and all(abs(t - other) > _NEAR * distance for other, _ in chosen):
            chosen.append((float(t), ""))
    return sorted(chosen)


def figures(recording: Recording, drone: str, camera: str, frames: Table, events: Table | None, most: int) -> list[str]:
    """Return thumbnails as HTML, each of the first frame from its moment on."""
    t_s, seq = frames.numbers("t_s"), frames["seq"]
    wanted: dict[int, tuple[float, str]] = {}
    for moment, why in moments(float(t_s[0]), float(t_s[-1]), events, most):
        index = min(int(np.searchsorted(t_s, moment - 1e-9)), len(t_s) - 1)
        wanted.setdefault(int(seq[index]), (float(t_s[index]), why))
    shown = []
    for picture in recording.pictures(drone, camera):
        found = wanted.pop(picture.header.seq, None)
        if found is not None:
            shown.append(_figure(picture, *found))
        if not wanted:
            break
    return [figure for figure in shown if figure]


def _figure(picture: Picture, t_s: float, why: str) -> str:
    data, form = thumbnail(picture)
    if not data:
        return ""
    source = f"data:image/{form};base64,{base64.b64encode(data).decode()}"
    text = escape(why) or f"frame {picture.header.seq}"
    caption = f"<figcaption><b>{t_s:.1f} s</b> {text}</figcaption>"
    return f'<figure><img src="{source}" alt="frame at {t_s:.1f} s">{caption}</figure>'


def thumbnail(picture: Picture) -> tuple[bytes, str]:
    """Return a small image and its format.

    It is as recorded where it can't be scaled here, and empty if it is damaged, or H.264 that can't be decoded here.
    """
    try:
        image = picture.pixels()
    except MissingExtraError:
        return (b"", "") if picture.record.format == H264 else (picture.compressed, picture.record.format)
    except FileFormatError:
        return b"", ""
    import cv2

    height, width = image.shape[:2]
    shown: Any = image
    if width > WIDTH:
        shown = cv2.resize(image, (WIDTH, round(height * WIDTH / width)), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return (bytes(data), "jpeg") if done else (b"", "")
