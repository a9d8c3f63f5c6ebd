"""Create the report of a flight: one page with its path, charts over time, key frames and events."""

from __future__ import annotations

import base64
import time
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, MissingExtraError
from skyloop.messages import FlightState
from skyloop.messages.frame import H264
from skyloop.recording.layout import Channel
from skyloop.recording.pictures import RecordedImage
from skyloop.recording.reader import Progress, Recording
from skyloop.recording.review import charts
from skyloop.recording.review.charts import Floats, Line, Mark, Page, TimeAxis
from skyloop.recording.review.summary import Summary, summarise
from skyloop.recording.review.tables import Table, tables

_TABLES: Final = (Channel.FEEDBACK, Channel.COMMANDS, Channel.EVENTS, Channel.FRAMES, Channel.LOGS)
_STATES: Final = {
    FlightState.LANDED.value: "landed",
    FlightState.TAKING_OFF.value: "rising",
    FlightState.LANDING.value: "falling",
    FlightState.EMERGENCY.value: "alarm",
    FlightState.UNKNOWN.value: "calm",
    "*": "flying",
}
_FAILSAFES: Final = {"none": "", "*": "alarm"}
_LINKS: Final = {"up": "", "closed": "calm", "*": "alarm"}
_COMMANDS: Final = {"idle": "", "emergency_stop": "alarm", "takeoff": "rising", "land": "falling", "*": "flying"}
_COLOURS: Final = ("c1", "c2", "c3", "c4", "c5", "c6")
_MOST_EVENTS: Final = 500  # maximum number of events listed on the page
_LONGEST_STEP_S: Final = 0.5  #: longest step over which velocity is integrated
_WIDTH: Final = 360  #: width of a thumbnail [px]
_QUALITY: Final = 80  # JPEG quality of thumbnails
#: Kinds of events that get a key frame whatever their severity.
_NOTABLE: Final = ("state_changed", "collision", "failsafe", "emergency", "authority_preempted")
_NEAR: Final = 0.4  #: fraction of the usual spacing; an evenly spaced frame this close to an event's frame is skipped
_SAME_CLOCK_S: Final = 60.0  #: maximum delay; longer delays are skipped, because the two clocks must then be unrelated


def write_report(
    recording: Recording, drone: str, path: Path, *, pictures: int = 8, progress: Progress | None = None
) -> None:
    """Write the report with up to ``pictures`` key frames per camera; raise ``UsageError`` if that fails.

    This reads the recording twice, and once more for each camera.
    """
    report_progress = progress or (lambda _: None)
    summary = summarise(recording, lambda share: report_progress(share / 3))
    found = tables(recording, drone, _TABLES, lambda share: report_progress((1 + share) / 3))
    page = make_page(recording, drone, found, summary)
    _frames(page, recording, drone, found, pictures, lambda share: report_progress((2 + share) / 3))
    _events(page, found.get("events"))
    _channels(page, summary)
    page.add(
        f"<footer>{escape(recording.path.name)}, recorded by Skyloop {escape(recording.start.skyloop)}. Times are "
        "seconds since the first sample, on the clock of the drone's proxy.</footer>"
    )
    page.write(path)


def make_page(recording: Recording, drone: str, found: dict[str, Table], summary: Summary) -> Page:
    """Create the page with its header, the path and the charts over time."""
    ends = [float(one.numbers("t_s")[-1]) for one in found.values() if len(one)]
    axis = TimeAxis(0.0, max([*ends, 0.1]))
    page = Page(f"{drone}: flight report", axis)
    feedback, commands = found.get("feedback"), found.get("commands")
    way = None if feedback is None else way_of(feedback)
    _head(page, recording, drone, summary)
    frames = sum(len(one) for name, one in found.items() if name.startswith("frames."))
    page.add(charts.facts(flight_facts(feedback, commands, way, frames, axis.end_s)))
    for note in (*summary.notes, *_losses(summary, drone)):
        page.add(f'<p class="note">{escape(note)}</p>')
    if feedback is None:
        page.add('<p class="note">no feedback was recorded: there is nothing to draw</p>')
    elif way is not None:
        _path(page, feedback, way)
    page.add('<h2>Course <i class="sub now"></i></h2>')
    page.add(f'<section class="panel">{_bands(found, axis)}</section>')
    for title, unit, lines, least, zero in _charts(recording, drone, found):
        page.chart(title, unit, lines, charts.limits(lines, least_span=least, zero=zero))
    return page


def _head(page: Page, recording: Recording, drone: str, summary: Summary) -> None:
    known = recording.drone(drone)
    began = time.strftime("%d %B %Y, %H:%M:%S", time.localtime(recording.start.started_unix_ns / NS_PER_S))
    what = known.described
    page.add(f"<h1>{escape(drone)}</h1>")
    page.add(
        f'<p class="sub">{escape(began)} · {escape(what.description or what.vehicle)} · '
        f"<code>{escape(known.uri)}</code> · {summary.seconds:.1f} s</p>"
    )


def _losses(summary: Summary, drone: str) -> Iterator[str]:
    for what, counts in (("dropped by the recorder", summary.dropped), ("never reached it", summary.missed)):
        words = ", ".join(f"{count} of {channel}" for channel, count in counts.get(drone, {}).items() if count)
        if words:
            yield f"{words} {what}"


def _path(page: Page, feedback: Table, way: Way) -> None:
    page.way(way.t_s, way.x, way.y)
    t_s = feedback.numbers("t_s")
    high = Line("altitude", t_s, feedback.numbers("altitude_m"))
    page.add(
        '<h2>Path</h2><div class="pair"><section class="panel"><header><h3>From above<i>m, x east, y north</i></h3>'
    )
    page.add(f'<span class="sub">{escape(way.source)}; from blue to orange</span></header>')
    page.add(charts.map_chart("path", way.x, way.y, way.t_s) + "</section>")
    page.add('<section class="panel"><header><h3>From the side<i>m, height over x</i></h3></header>')
    page.add(charts.map_chart("side", way.x, high.values, t_s) if feedback.known("altitude_m") else "<p>unknown</p>")
    page.add("</section></div>")


def _bands(found: dict[str, Table], axis: TimeAxis) -> str:
    rows = []
    feedback, commands = found.get("feedback"), found.get("commands")
    if feedback is not None:
        t_s = feedback.numbers("t_s")
        for title, column, styles in (
            ("state", "state", _STATES),
            ("pilot", "owner", {"*": "calm"}),
            ("failsafe", "failsafe", _FAILSAFES),
            ("link", "vehicle_link", _LINKS),
        ):
            rows.append((title, charts.spans(t_s, feedback[column].astype(np.str_), styles, axis.end_s)))
    if commands is not None:
        asked = np.where(commands["app_id"] > 0, commands["asked"], "")
        rows.append(("requested", charts.spans(commands.numbers("t_s"), asked, _COMMANDS, axis.end_s)))
    return charts.band_chart("bands", [row for row in rows if row[1]], marks(found.get("events")), axis)


def _charts(
    recording: Recording, drone: str, found: dict[str, Table]
) -> Iterator[tuple[str, str, list[Line], float, bool]]:
    """Yield the title, unit, lines, minimum span of the vertical axis, and whether that axis includes 0."""
    feedback, commands = found.get("feedback"), found.get("commands")
    if feedback is not None:
        t_s = feedback.numbers("t_s")
        if feedback.known("altitude_m"):
            yield "Altitude", "m", [Line("altitude", t_s, feedback.numbers("altitude_m"))], 1.0, True
        attitude = [
            Line(name, t_s, np.degrees(feedback.numbers(f"{name}_rad")), style)
            for name, style in (("roll", "c1"), ("pitch", "c2"))
            if feedback.known(f"{name}_rad")
        ]
        attitude += _set_points(commands, ("roll", "c1"), ("pitch", "c2"), degrees=True)
        if attitude:
            yield "Roll and pitch", "°, right side and nose down are positive", attitude, 6.0, False
        if feedback.known("yaw_rad"):
            yield "Yaw", "°, counter-clockwise", [Line("yaw", t_s, _turned(feedback.numbers("yaw_rad")))], 20.0, False
        names = (("forward", "c1"), ("left", "c2"), ("up", "c3"))
        velocity = [
            Line(name, t_s, feedback.numbers(f"velocity_{name}_m_s"), style)
            for name, style in names
            if feedback.known(f"velocity_{name}_m_s")
        ]
        velocity += _set_points(commands, *names, ("climb", "c3"))
        if velocity:
            yield "Velocity", "m/s, in the body's levelled axes", velocity, 0.5, False
        if feedback.known("battery"):
            yield "Battery", "%", [Line("charge", t_s, 100.0 * feedback.numbers("battery"), "c5")], 100.0, True
    delays = list(_delays(recording, drone, found))
    if delays:
        yield "Delays", "ms, up to their 99.5th percentile", delays, 1.0, True
    logged = list(_logged(found.get("logs")))
    if logged:
        yield "Logged by applications", "", logged, 1.0, False


def _set_points(commands: Table | None, *names: tuple[str, str], degrees: bool = False) -> list[Line]:
    """Return the applied values of all set-points that have values."""
    if commands is None:
        return []
    found = []
    for name, style in names:
        values = commands.numbers(f"applied_{name}")
        if np.isfinite(values).any():
            shown = np.degrees(values) if degrees else values
            found.append(Line(f"{name} set", commands.numbers("t_s"), shown, style, dashed=True, steps=True))
    return found


def _turned(yaw: Floats) -> Floats:
    """Convert yaw to degrees and leave a gap where it wraps around."""
    degrees = np.degrees(yaw)
    jumps = np.abs(np.diff(degrees, prepend=degrees[:1])) > 180.0
    return np.where(jumps, np.nan, degrees)


def _delays(recording: Recording, drone: str, found: dict[str, Table]) -> Iterator[Line]:
    """Yield the delays [ms] of samples from capture to recorder, and of commands from sending to execution."""
    offset_ns = recording.drone(drone).clock_offset_ns
    colours = iter(_COLOURS)
    for name, samples in found.items():
        if name == "commands":
            pilots = samples["app_id"] > 0
            late = (samples["applied_ns"] - samples["sent_ns"])[pilots] / 1e6
            yield _clipped(Line("command to the vehicle", samples.numbers("t_s")[pilots], late, next(colours)))
        elif name == "feedback" or name.startswith("frames."):
            received = recording.clock.monotonic(0, offset_ns) + samples["received_unix_ns"].astype(np.int64)
            late = (received - samples["captured_ns"]) / 1e6
            if np.abs(np.median(late)) < _SAME_CLOCK_S * 1e3:
                title = "age of feedback" if name == "feedback" else f"age of {name.partition('.')[2]} frames"
                yield _clipped(Line(title, samples.numbers("t_s"), late, next(colours)))


def _clipped(line: Line) -> Line:
    """Clip a line at its 99.5th percentile, so that a single late sample does not flatten the rest of the line."""
    if not len(line.values):
        return line
    return Line(line.label, line.t_s, np.minimum(line.values, np.percentile(line.values, 99.5) * 1.05), line.style)


def _logged(logs: Table | None) -> Iterator[Line]:
    """Yield up to six logged series of numbers."""
    if logs is None or "number" not in logs.columns:
        return
    numbers = logs.numbers("number")
    names = [str(name) for name in dict.fromkeys(logs["name"][np.isfinite(numbers)].tolist())]
    for name, style in zip(names, _COLOURS, strict=False):
        chosen = (logs["name"] == name) & np.isfinite(numbers)
        yield Line(name, logs.numbers("t_s")[chosen], numbers[chosen], style)


def _frames(
    page: Page, recording: Recording, drone: str, found: dict[str, Table], most: int, progress: Progress
) -> None:
    events = found.get("events")
    cameras = recording.cameras(drone)
    for number, camera in enumerate(cameras):
        frames = found.get(f"frames.{camera}")
        shown = figures(recording, drone, camera, frames, events, most) if most and frames is not None else []
        if shown:
            page.add(f'<h2>Key frames of {escape(camera)}</h2><div class="frames">{"".join(shown)}</div>')
        progress((number + 1) / len(cameras))


def _events(page: Page, events: Table | None) -> None:
    if events is None or not len(events):
        return
    columns = (events.numbers("t_s"), events["kind"], events["text"], events["app"], events["severity"])
    rows = [
        [f"{t:.2f}", escape(str(kind).replace("_", " ")), escape(str(app)), _severe(str(severity), str(text))]
        for t, kind, text, app, severity in list(zip(*columns, strict=True))[:_MOST_EVENTS]
    ]
    more = len(events) - _MOST_EVENTS
    page.add("<h2>Events</h2>" + charts.table(("time [s]", "kind", "application", "what"), rows, ("n", "", "", "")))
    if more > 0:
        page.add(f'<p class="sub">and {more} more</p>')


def _severe(severity: str, text: str) -> str:
    return f'<span class="dot {escape(severity)}"></span>{escape(text)}'


def _channels(page: Page, summary: Summary) -> None:
    rows = [
        [
            f"<code>{escape(row.topic)}</code>",
            str(row.count),
            f"{row.rate_hz:.1f}" if row.rate_hz is not None and row.steady else "",
            str(row.gaps) if row.gaps else "",
            str(row.missing) if row.missing else "",
            f"{row.bytes / 1e6:.2f}",
            "<br>".join(f"{one.median_s * 1e3:.2f} ({one.p99_s * 1e3:.2f}) {escape(one.what)}" for one in row.delays),
        ]
        for row in summary.rows
    ]
    head = ("channel", "count", "rate [Hz]", "gaps", "missing", "size [MB]", "delay [ms]: median (p99)")
    page.add("<h2>Channels</h2>" + charts.table(head, rows, ("", "n", "n", "n", "n", "n", "")))


# Path and figures -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Way:
    """The drone's path in world axes: x east, y north [m]."""

    t_s: Floats
    x: Floats
    y: Floats
    source: str  #: description of the path's source

    @property
    def length_m(self) -> float:
        """Length of the path over ground."""
        return float(np.nansum(np.hypot(np.diff(self.x), np.diff(self.y))))


def way_of(feedback: Table) -> Way | None:
    """Return the drone's path, or None if it is unknown.

    Uses the vehicle's own position or, if that is missing, the simulator's true position or the integrated velocity.
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
    return Way(t_s, np.cumsum(east * steps), np.cumsum(north * steps), "integrated from the velocity: it drifts")


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


def flight_facts(
    feedback: Table | None, commands: Table | None, path: Way | None, frames: int, seconds: float
) -> list[tuple[str, str]]:
    """Return the known facts for a report's header, as names and values."""
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
            found.append(("distance", f"{path.length_m:.1f} m"))
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


def moments(first_s: float, last_s: float, events: Table | None, most: int) -> list[tuple[float, str]]:
    """Select the times to show, sorted, each with its reason: up to half at events, the rest evenly spaced. Pure."""
    if most < 1 or last_s < first_s:
        return []
    chosen: list[tuple[float, str]] = []
    if events is not None:
        rows = zip(events.numbers("t_s"), events["kind"], events["severity"], events["text"], strict=True)
        candidates = [
            (float(t), str(text))
            for t, kind, severity, text in rows
            if first_s <= t <= last_s and (kind in _NOTABLE or severity != "info")
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
    """Return thumbnails as HTML; each shows the first frame at or after its moment."""
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


def _figure(picture: RecordedImage, t_s: float, why: str) -> str:
    data, form = thumbnail(picture)
    if not data:
        return ""
    source = f"data:image/{form};base64,{base64.b64encode(data).decode()}"
    text = escape(why) or f"frame {picture.header.seq}"
    caption = f"<figcaption><b>{t_s:.1f} s</b> {text}</figcaption>"
    return f'<figure><img src="{source}" alt="frame at {t_s:.1f} s">{caption}</figure>'


def thumbnail(picture: RecordedImage) -> tuple[bytes, str]:
    """Return a small image and its format.

    The image has full size if it can't be scaled here. It is empty if damaged or H.264 that can't be decoded here.
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
    if width > _WIDTH:
        shown = cv2.resize(image, (_WIDTH, round(height * _WIDTH / width)), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return (bytes(data), "jpeg") if done else (b"", "")
