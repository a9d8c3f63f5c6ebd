"""Two flights' commands in one diagram: as a page, or as an image."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from skyloop.errors import MissingExtraError
from skyloop.files import replacing
from skyloop.recording.review.compare import Commands, Comparison
from skyloop.recording.review.flight import spans
from skyloop.recording.review.page import Page, facts, table
from skyloop.recording.review.svg import Line, Mark, TimeAxis, band_chart, limits

_ACTIONS: Final = {"idle": "", "emergency_stop": "alarm", "takeoff": "rising", "land": "falling", "*": "flying"}
_OLD: Final[dict[str, Any]] = {"color": "#1f6feb", "lw": 1.8}
_NEW: Final[dict[str, Any]] = {"color": "#d9480f", "lw": 1.4, "ls": "--"}


def write_comparison(found: Comparison, old: str, new: str, path: Path) -> None:
    """Write the comparison.

    Args:
        found: The comparison.
        old: Name of the older recording.
        new: Name of the newer one.
        path: Ends in ``.html``, or in ``.png``, which needs Matplotlib.

    Raises:
        UsageError: The file can't be written.
        MissingExtraError: Matplotlib is needed and not installed.
    """
    if path.suffix == ".png":
        _picture(found, old, new, path)
    else:
        make_page(found, old, new).write(path)


def make_page(found: Comparison, old: str, new: str) -> Page:
    """Create the page: actions, each set-point of both recordings, and a table of the differences."""
    axis = _axis(found)
    page = Page(f"{new} against {old}", axis)
    page.add(f"<h1>{escape(Path(new).name)} against {escape(Path(old).name)}</h1>")
    page.add(f'<p class="sub">The commands of two recordings, {escape(found.aligned)}</p>')
    parted = "never" if found.part_at_s is None else f"at {found.part_at_s:.2f} s"
    page.add(
        facts(
            [
                ("compared", f"{found.seconds:.1f} s"),
                ("they part", parted),
                ("same kind of action", f"{found.same_action:.1%}"),
                ("commands, old", str(found.counts[0])),
                ("commands, new", str(found.counts[1])),
            ]
        )
    )
    page.add('<h2>Course <i class="now"></i></h2>')
    rows = [
        (title, spans(commands.times_s, commands.names, _ACTIONS, axis.end_s))
        for title, commands in (("old", found.old), ("new", found.new))
    ]
    marks = [] if found.part_at_s is None else [Mark(found.part_at_s, "they part here", "warning")]
    page.add(f'<section class="panel">{band_chart("bands", rows, marks, axis)}</section>')
    for field in found.fields:
        lines = [_line("old", found.old, field.name, "c1"), _line("new", found.new, field.name, "c2")]
        page.chart(field.name, field.unit, lines, limits(lines, least_span=0.1))
    cells = [
        [
            f"{field.name} [{field.unit}]",
            *(f"{number:.4f}" for number in (field.rms, field.largest)),
            f"{field.largest_at_s:.2f}",
            f"{field.seconds:.1f}",
        ]
        for field in found.fields
    ]
    head = ("set-point", "RMS", "largest", "at [s]", "compared [s]")
    page.add("<h2>Differences</h2>" + table(head, cells, ("", "n", "n", "n", "n")))
    return page


def _axis(found: Comparison) -> TimeAxis:
    ends = [commands.times_s[[0, -1]] for commands in (found.old, found.new)]
    return TimeAxis(float(min(end[0] for end in ends)), float(max(end[1] for end in ends)) + 0.1)


def _line(label: str, commands: Commands, name: str, style: str) -> Line:
    return Line(label, commands.times_s, commands.numbers[name], style, dashed=label == "new", steps=True)


def _picture(found: Comparison, old: str, new: str, path: Path) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("drawing a .png (a .html page needs nothing)", "bench", cause=str(error)) from None
    rows = max(1, len(found.fields))
    figure = Figure(figsize=(12, 1.2 + 2.0 * rows), layout="constrained", dpi=120)
    figure.suptitle(f"{Path(new).name} against {Path(old).name}, {found.aligned}")
    places = np.atleast_1d(figure.subplots(rows, 1, sharex=True))
    for field, axes in zip(found.fields, places, strict=False):
        for label, commands, style in (("old", found.old, _OLD), ("new", found.new, _NEW)):
            axes.plot(commands.times_s, commands.numbers[field.name], label=label, drawstyle="steps-post", **style)
        axes.set_ylabel(f"{field.name} [{field.unit}]")
        axes.set_title(f"RMS difference {field.rms:.4f} {field.unit}", loc="right", fontsize="small")
        axes.grid(alpha=0.25)
        if found.part_at_s is not None:
            axes.axvline(found.part_at_s, color="grey", ls=":", lw=1.2)
    places[0].legend(loc="upper left")
    places[-1].set_xlabel("time [s]")
    with replacing(path) as part:
        figure.savefig(part)
