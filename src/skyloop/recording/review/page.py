"""A self-contained HTML page: style, script and data are embedded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from skyloop.files import write
from skyloop.recording.review.flight import Way
from skyloop.recording.review.svg import LEFT, RIGHT, WIDTH, Floats, Line, TimeAxis, thin, time_chart


class Page:
    """Collects the parts of a page and the numbers that its cursor shows."""

    def __init__(self, title: str, axis: TimeAxis) -> None:
        self._title = title
        self._parts: list[str] = []
        self.axis = axis
        self._charts: dict[str, list[Any]] = {}
        self._way: list[Any] | None = None

    def add(self, html: str) -> None:
        """Append HTML."""
        self._parts.append(html)

    def chart(self, title: str, unit: str, lines: Sequence[Line], limits: tuple[float, float]) -> None:
        """Append a panel with lines over time, their legend, and their values at the cursor."""
        name = f"chart{len(self._charts)}"
        self._charts[name] = [[_numbers(part) for part in thin(line.t_s, line.values)] for line in lines]
        drawn = time_chart(name, lines, self.axis, limits)
        self.add(
            f'<section class="panel" data-chart="{name}"><header><h3>{escape(title)}<i>{escape(unit)}</i></h3>'
            f"{_legend(lines)}</header>{drawn}</section>"
        )

    def way(self, way: Way) -> None:
        """Let the cursor show the position on the map."""
        x, y = np.nan_to_num(way.x), np.nan_to_num(way.y)
        step = max(1, len(way.t_s) // 2000)
        self._way = [_numbers(part[::step]) for part in (way.t_s, x, y)]

    def write(self, path: Path) -> None:
        """Write the page.

        Raises:
            UsageError: The file can't be written.
        """
        write(path, self.html().encode())

    def html(self) -> str:
        """Return the whole page."""
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
    """Return figures side by side, as HTML."""
    cells = "".join(f"<div><dt>{escape(what)}</dt><dd>{escape(value)}</dd></div>" for what, value in pairs)
    return f'<dl class="facts">{cells}</dl>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]], classes: Sequence[str]) -> str:
    """Return a table as HTML.

    Args:
        head: Titles.
        rows: Cells, which are HTML.
        classes: Of the columns: ``n`` is a number.
    """
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
    """Rounded to what can be seen; what is not known is None."""
    return [round(number, 4) if math.isfinite(number) else None for number in values.tolist()]
