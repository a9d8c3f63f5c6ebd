"""A self-contained report page with its style, script and data, and SVG charts coloured by the page's CSS classes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.files import write

Floats = NDArray[np.float64]

# Sizes in the units of the SVGs, which the page scales.
WIDTH: Final = 1120  #: width of all charts with a time axis
LEFT: Final = 64  #: left margin for the labels of the vertical axis
RIGHT: Final = 16  #: right margin
TOP: Final = 8  #: top margin
AXIS: Final = 20  #: margin for the labels of the time axis
BUCKETS: Final = 700  #: number of buckets of a line, each drawn as its minimum and maximum
GAP_FACTOR: Final = 8.0  #: minimum length of a gap in a line, as a multiple of the typical step


@dataclass(frozen=True, slots=True)
class Line:
    """A data series over time, with NaN where the value is unknown. ``style`` is the CSS class that sets its colour."""

    label: str
    t_s: Floats
    values: Floats
    style: str = "c1"
    dashed: bool = False
    steps: bool = False  #: whether to draw the line as steps, which hold each value until the next one


@dataclass(frozen=True, slots=True)
class Span:
    """A named time interval. ``style`` is the CSS class that sets its colour."""

    begin_s: float
    end_s: float
    text: str
    style: str


@dataclass(frozen=True, slots=True)
class Mark:
    """A labelled moment. ``style`` is the CSS class that sets its colour."""

    t_s: float
    text: str
    style: str


@dataclass(frozen=True, slots=True)
class TimeAxis:
    """The horizontal time axis."""

    begin_s: float
    end_s: float

    def x(self, t_s: float) -> float:
        """Return the horizontal coordinate of a time."""
        span = max(self.end_s - self.begin_s, 1e-9)
        return LEFT + (t_s - self.begin_s) / span * (WIDTH - LEFT - RIGHT)


def spans(t_s: Floats, names: NDArray[np.str_], styles: dict[str, str], end_s: float) -> list[Span]:
    """Return the intervals between changes of name, with styles (``*``: any other name); the last ends at ``end_s``."""
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


def ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Return at most ``most`` + 1 round numbers from low to high, spaced 1, 2 or 5 times a power of ten."""
    if not high > low:
        return [low]
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(number * step, 12) for number in range(first, math.floor(high / step + 1e-9) + 1)]


def limits(lines: Sequence[Line], *, least_span: float, zero: bool = False) -> tuple[float, float]:
    """Return vertical limits at least ``least_span`` apart: all known values plus a margin, and 0 if ``zero``."""
    known = [values for line in lines if (values := line.values[np.isfinite(line.values)]).size]
    if not known:
        return 0.0, least_span
    low, high = min(float(values.min()) for values in known), max(float(values.max()) for values in known)
    if zero:
        low, high = min(low, 0.0), max(high, 0.0)
    missing = least_span - (high - low)
    if missing > 0:
        low, high = (low, high + missing) if zero and low == 0.0 else (low - missing / 2, high + missing / 2)
    room = 0.06 * (high - low)
    return (low if zero and low == 0.0 else low - room), high + room


def thin(t_s: Floats, values: Floats, buckets: int = BUCKETS) -> tuple[Floats, Floats]:
    """Reduce points to at most two per bucket (its minimum and maximum), so that no peak is lost."""
    if len(t_s) <= 2 * buckets:
        return t_s, values
    keep: list[int] = []
    for part in np.array_split(np.arange(len(t_s)), buckets):
        numbers = values[part]
        if np.isfinite(numbers).any():
            keep += sorted({int(part[np.nanargmin(numbers)]), int(part[np.nanargmax(numbers)])})
        else:
            keep.append(int(part[0]))
    return t_s[keep], values[keep]


def pieces(t_s: Floats, values: Floats) -> list[tuple[Floats, Floats]]:
    """Return the runs of points between gaps and unknown values."""
    if not len(t_s):
        return []
    steps = np.diff(t_s)
    usual = float(np.median(steps)) if len(steps) else 0.0
    known = np.isfinite(values)
    cuts = np.flatnonzero(~known[1:] | ~known[:-1] | (steps > max(GAP_FACTOR * usual, 1e-6))) + 1
    found = []
    for part in np.split(np.arange(len(t_s)), cuts):
        part = part[np.isfinite(values[part])]
        if len(part):
            found.append((t_s[part], values[part]))
    return found


def time_chart(
    name: str, lines: Sequence[Line], axis: TimeAxis, y_limits: tuple[float, float], *, height: int = 130
) -> str:
    """Draw lines over time, with labels on the vertical axis."""
    low, high = y_limits
    bottom = height - AXIS

    def y(value: float) -> float:
        return TOP + (high - value) / (high - low) * (bottom - TOP)

    parts = [_grid(axis, height)]
    for tick in ticks(low, high, 4):
        at = y(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text class="label" x="{LEFT - 8}" y="{at + 4:.1f}" text-anchor="end">{_number(tick)}</text>')
    for line in lines:
        parts.append(_line(line, axis, y))
    return _svg(name, height, "".join(parts))


def band_chart(name: str, rows: Sequence[tuple[str, Sequence[Span]]], marks: Sequence[Mark], axis: TimeAxis) -> str:
    """Draw rows of named intervals with a row of marks below."""
    each = 24
    height = TOP + each * (len(rows) + bool(marks)) + AXIS
    parts = [_grid(axis, height)]
    for number, (title, spans) in enumerate(rows):
        top = TOP + number * each
        parts.append(f'<text class="label" x="{LEFT - 8}" y="{top + 15}" text-anchor="end">{escape(title)}</text>')
        for span in spans:
            x, end = axis.x(span.begin_s), axis.x(span.end_s)
            width = max(end - x, 1.5)
            parts.append(
                f"<g><title>{escape(span.text)}: {span.begin_s:.1f} to {span.end_s:.1f} s</title>"
                f'<rect class="span {span.style}" x="{x:.1f}" y="{top + 2}" width="{width:.1f}" '
                f'height="{each - 5}" rx="3"/>'
            )
            if width > 7.0 * len(span.text) + 10:
                parts.append(f'<text class="onspan" x="{x + 6:.1f}" y="{top + 15}">{escape(span.text)}</text>')
            parts.append("</g>")
    top = TOP + len(rows) * each
    if marks:
        parts.append(f'<text class="label" x="{LEFT - 8}" y="{top + 15}" text-anchor="end">events</text>')
    for mark in marks:
        x = axis.x(mark.t_s)
        parts.append(
            f"<g><title>{mark.t_s:.2f} s: {escape(mark.text)}</title>"
            f'<path class="mark {mark.style}" d="M{x:.1f} {top + 3} l5 8 l-5 8 l-5 -8 z"/></g>'
        )
    return _svg(name, height, "".join(parts))


def map_chart(name: str, x: Floats, y: Floats, t_s: Floats, *, size: int = 540) -> str:
    """Draw a path as seen from above, with equal scales on both axes, coloured by time, on a grid in metres."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y, t_s = x[known], y[known], t_s[known]
    half = max(float(np.ptp(x)), float(np.ptp(y)), 1.0) * 0.56
    middle_x, middle_y = float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2
    inner = size - LEFT / 2 - AXIS

    def px(value: float) -> float:
        return LEFT / 2 + (value - middle_x + half) / (2 * half) * inner

    def py(value: float) -> float:
        return inner - (value - middle_y + half) / (2 * half) * inner + 2

    parts = []
    for tick in ticks(middle_x - half, middle_x + half, 8):
        parts.append(f'<line class="grid" x1="{px(tick):.1f}" x2="{px(tick):.1f}" y1="2" y2="{inner + 2:.1f}"/>')
        parts.append(
            f'<text class="label" x="{px(tick):.1f}" y="{inner + 16:.1f}" text-anchor="middle">{_number(tick)}</text>'
        )
    for tick in ticks(middle_y - half, middle_y + half, 8):
        right = LEFT / 2 + inner
        parts.append(f'<line class="grid" x1="{LEFT / 2}" x2="{right:.1f}" y1="{py(tick):.1f}" y2="{py(tick):.1f}"/>')
        parts.append(
            f'<text class="label" x="{LEFT / 2 - 6}" y="{py(tick) + 4:.1f}" text-anchor="end">{_number(tick)}</text>'
        )
    parts.append(_coloured_path([(px(a), py(b)) for a, b in zip(x, y, strict=True)], t_s))
    first, last = (px(float(x[0])), py(float(y[0]))), (px(float(x[-1])), py(float(y[-1])))
    parts.append(f'<circle class="start" cx="{first[0]:.1f}" cy="{first[1]:.1f}" r="6"><title>start</title></circle>')
    parts.append(
        f'<rect class="end" x="{last[0] - 5:.1f}" y="{last[1] - 5:.1f}" width="10" height="10">'
        "<title>end</title></rect>"
    )
    parts.append('<circle class="here" r="6" visibility="hidden"/>')
    scale = f'data-cx="{middle_x!r}" data-cy="{middle_y!r}" data-half="{half!r}" data-inner="{inner!r}"'
    scale += f' data-left="{LEFT / 2}"'
    return f'<svg id="{name}" class="map" viewBox="0 0 {size} {size}" role="img" {scale}>{"".join(parts)}</svg>'


def _coloured_path(points: list[tuple[float, float]], t_s: Floats, colours: int = 48) -> str:
    """Draw a path in pieces whose colours run from blue at its start to orange at its end."""
    if len(points) < 2:
        return ""
    span = max(float(t_s[-1] - t_s[0]), 1e-9)
    parts = []
    begin = 0
    for number in range(colours):
        until = float(t_s[0]) + span * (number + 1) / colours
        end = len(points) - 1 if number == colours - 1 else int(np.searchsorted(t_s, until, side="right"))
        end = min(end, len(points) - 1)
        if end > begin:
            chosen = points[begin : end + 1 : max(1, (end - begin) // 40)]
            if chosen[-1] != points[end]:
                chosen.append(points[end])
            hue = 215.0 - 195.0 * number / (colours - 1)
            path = " ".join(f"{x:.1f},{y:.1f}" for x, y in chosen)
            parts.append(f'<polyline class="way" style="stroke:hsl({hue:.0f} 75% 52%)" points="{path}"/>')
            begin = end
    return "".join(parts)


def _line(line: Line, axis: TimeAxis, y: Callable[[float], float]) -> str:
    parts = []
    source = pieces(line.t_s, line.values) if line.steps else pieces(*thin(line.t_s, line.values))
    for t_s, values in source:
        points: list[str] = []
        before = ""
        for t, value in zip(t_s, values, strict=True):
            x, at = f"{axis.x(float(t)):.1f}", f"{y(float(value)):.1f}"
            if line.steps and before and before != at:
                points.append(f"{x},{before}")
            if not line.steps or before != at:
                points.append(f"{x},{at}")
            before = at
        if line.steps:
            points.append(f"{axis.x(float(t_s[-1])):.1f},{before}")
        parts.append(f'<polyline points="{" ".join(points)}"/>')
    dashed = " dashed" if line.dashed else ""
    return f'<g class="line {line.style}{dashed}">{"".join(parts)}</g>'


def _grid(axis: TimeAxis, height: int) -> str:
    parts = []
    for tick in ticks(axis.begin_s, axis.end_s, 12):
        x = f"{axis.x(tick):.1f}"
        parts.append(f'<line class="grid" x1="{x}" x2="{x}" y1="{TOP}" y2="{height - AXIS}"/>')
        parts.append(f'<text class="label" x="{x}" y="{height - 5}" text-anchor="middle">{_number(tick)}</text>')
    return "".join(parts)


def _svg(name: str, height: int, content: str) -> str:
    cursor = f'<line class="cursor" y1="{TOP}" y2="{height - AXIS}" visibility="hidden"/>'
    return f'<svg id="{name}" class="time" viewBox="0 0 {WIDTH} {height}" role="img">{content}{cursor}</svg>'


def _number(value: float) -> str:
    return f"{value:g}".replace("-", "−")


# The page -------------------------------------------------------------------------------------------------------


class Page:
    """Collects the parts of a page and the values to show at its cursor."""

    def __init__(self, title: str, axis: TimeAxis) -> None:
        self._title = title
        self._parts: list[str] = []
        self.axis = axis
        self._charts: dict[str, list[Any]] = {}
        self._way: list[Any] | None = None

    def add(self, html: str) -> None:
        self._parts.append(html)

    def chart(self, title: str, unit: str, lines: Sequence[Line], limits: tuple[float, float]) -> None:
        """Append a panel with lines over time, their legend and their values at the cursor."""
        name = f"chart{len(self._charts)}"
        self._charts[name] = [[_numbers(part) for part in thin(line.t_s, line.values)] for line in lines]
        drawn = time_chart(name, lines, self.axis, limits)
        self.add(
            f'<section class="panel" data-chart="{name}"><header><h3>{escape(title)}<i>{escape(unit)}</i></h3>'
            f"{_legend(lines)}</header>{drawn}</section>"
        )

    def way(self, t_s: Floats, x: Floats, y: Floats) -> None:
        """Set the path on which the map marks the position at the cursor's time."""
        step = max(1, len(t_s) // 2000)
        self._way = [_numbers(part[::step]) for part in (t_s, np.nan_to_num(x), np.nan_to_num(y))]

    def write(self, path: Path) -> None:
        """Write the page. Raise ``UsageError`` if the file can't be written."""
        write(path, self.html().encode())

    def html(self) -> str:
        style, script = (
            files("skyloop.recording.review").joinpath("static", name).read_text("utf-8") for name in _FILES
        )
        data = {
            "begin": self.axis.begin_s,
            "end": self.axis.end_s,
            "left": LEFT,
            "right": RIGHT,
            "width": WIDTH,
            "charts": self._charts,
            "way": self._way,
        }
        numbers = msgspec.json.encode(data).decode().replace("</", "<\\/")
        return (
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{escape(self._title)}</title><style>\n{style}</style></head><body><main>"
            f"{''.join(self._parts)}</main>"
            f'<script type="application/json" id="data">{numbers}</script><script>\n{script}</script></body></html>\n'
        )


_FILES = ("page.css", "page.js")


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """Format facts side by side as HTML."""
    cells = "".join(f"<div><dt>{escape(what)}</dt><dd>{escape(value)}</dd></div>" for what, value in pairs)
    return f'<dl class="facts">{cells}</dl>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]], classes: Sequence[str]) -> str:
    """Format a table as HTML. Cells are not escaped; class ``n`` marks a column that contains numbers."""
    titles = "".join(f'<th class="{kind}">{escape(title)}</th>' for title, kind in zip(head, classes, strict=True))
    lines = "".join(
        "<tr>" + "".join(f'<td class="{kind}">{cell}</td>' for cell, kind in zip(row, classes, strict=True)) + "</tr>"
        for row in rows
    )
    return f'<div class="panel scroll"><table><thead><tr>{titles}</tr></thead><tbody>{lines}</tbody></table></div>'


def _legend(lines: Sequence[Line]) -> str:
    entries = "".join(
        f'<li class="{line.style}{" dashed" if line.dashed else ""}"><span>{escape(line.label)}</span><b></b></li>'
        for line in lines
    )
    return f'<ul class="legend">{entries}</ul>'


def _numbers(values: Floats) -> list[float | None]:
    """Round values to a precision that is still visible; unknown values become None."""
    return [round(number, 4) if math.isfinite(number) else None for number in values.tolist()]
