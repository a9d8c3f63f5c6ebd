"""Present the experiment's figures as tables, diagrams, and a page with both."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from benchmarks.measuring import tables
from benchmarks.measuring.contenders import OURS
from benchmarks.measuring.delays import PAPER_MEAN_MS
from benchmarks.measuring.figures import new_figure, paper_figures, save
from benchmarks.measuring.schedule import FEEDBACK, VIDEO
from benchmarks.paper.evaluation import RECORDER, Experiment
from benchmarks.paper.marks import CORNERS
from skyloop.files import write as write_file
from skyloop.recording.review.charts import Line, Page, TimeAxis, facts, limits, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURES: Final = {
    "delays-command": "Distribution of the delays of commands (the paper's figure 3)",
    "delays-video": "Distribution of the delays of frames (figure 4)",
    "delays-evolution": "All delays over the flight (figure 5)",
    "path": "The path from above: the flight, and the waypoints' round",
}
#: The start and end of each delay.
MEANING: Final = {
    "command": "drone.velocity() has checked its numbers and starts encoding → the driver has applied the command",
    "feedback": "the proxy publishes what the driver reported → the controller's receiving thread has it",
    "video": "the proxy publishes the driver's picture → the controller's receiving thread has the array",
}


def write(results: Experiment, folder: Path) -> Path:
    """Write the diagrams, ``results.json`` and ``report.html`` into a folder.

    Returns:
        The page.

    Raises:
        MissingExtraError: matplotlib is not installed; nothing is written.
    """
    save(lambda: figures(results), folder, ("png",))
    write_file(folder / "results.json", msgspec.json.format(msgspec.json.encode(results)))
    page = folder / "report.html"
    _page(results).write(page)
    return page


def figures(results: Experiment) -> dict[str, Figure]:
    """Return the diagrams, keyed by file name."""
    return {**paper_figures(results.delays), "path": from_above(results)}


def from_above(results: Experiment) -> Figure:
    """Draw the true path over the round of waypoints."""
    figure, axes = new_figure(5.4, 5.0)
    x, y, _ = np.array([*CORNERS, CORNERS[0]]).T
    axes.plot(results.way.x, results.way.y, color="#0b6e99", linewidth=0.8, alpha=0.8, label="flown, by the truth")
    axes.plot(x, y, color="#b8463d", linewidth=1.2, linestyle="--", marker="s", markersize=5, label="waypoints")
    axes.set(xlabel="x, east [m]", ylabel="y, north [m]", aspect="equal", title=_path_title(results))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    return figure


def _path_title(results: Experiment) -> str:
    error = results.tracking
    return "Path" if error is None else f"Path: {error.rms_m * 1e2:.1f} cm RMS off, at most {error.largest_m * 1e2:.0f}"


# Tables ----------------------------------------------------------------------------------------------------------


def delay_table(results: Experiment) -> tables.Table:
    """Return the paper's Table 1 beside our figures, as seen by the controller.

    The recording does not show how many commands were lost.
    """
    found = tables.paper_table(results.delays)
    spreads = [f"{results.deviation_us[channel] / 1e3:.3f}" for channel in PAPER_MEAN_MS]
    mean, paper, *others = found.rows
    others = [["lost", tables.UNKNOWN, *row[2:]] if row[0] == "lost" else row for row in others]
    return tables.Table(found.title, found.columns, [mean, paper, ["standard deviation", *spreads], *others])


def recorder_table(results: Experiment) -> tables.Table:
    """Return the delays of the same feedback and frames at the recorder."""
    rows = []
    for channel in (FEEDBACK, VIDEO):
        cells = [results.delays.summary(name, results.delays.sizes[0], channel) for name in (OURS.name, RECORDER)]
        numbers = [tables.UNKNOWN if one is None else f"{one.median_us:.0f} ({one.p99_us:.0f})" for one in cells]
        rows.append([channel, *numbers])
    return tables.Table("Delays in µs: median (99th percentile)", ["", "controller", "recorder"], rows)


def path_table(results: Experiment) -> tables.Table:
    """Return the accuracy along the path."""
    error = results.tracking
    rows = [] if error is None else _path_rows(error.rms_m, error.largest_m, error.across_rms_m, error.across_largest_m)
    return tables.Table("Off the path, by the truth", ["distance", "RMS", "largest"], rows)


def _path_rows(rms_m: float, largest_m: float, across_rms_m: float, across_largest_m: float) -> list[list[str]]:
    return [
        ["from where it should have been at that time", f"{rms_m:.3f} m", f"{largest_m:.3f} m"],
        ["from the nearest point of the round", f"{across_rms_m:.3f} m", f"{across_largest_m:.3f} m"],
    ]


def flown(results: Experiment) -> list[tuple[str, str]]:
    """Return the flight in figures."""
    waypoints = 0 if results.tracking is None else results.tracking.waypoints
    return [
        ("flown", f"{results.seconds:.1f} s"),
        ("waypoints", str(waypoints)),
        ("taken over", f"{results.takeovers}×"),
        ("load at the end", tables.UNKNOWN if results.load is None else f"{results.load:.1f}"),
    ]


# The page --------------------------------------------------------------------------------------------------------


def _page(results: Experiment) -> Page:
    page = Page("The paper's test flight", TimeAxis(0.0, max(results.seconds, 0.1)))
    page.add("<h1>The paper's test flight</h1>")
    page.add(f'<p class="sub"><code>{escape(results.vehicle)}</code><br>{escape(str(results.delays.machine))}</p>')
    page.add(facts(flown(results)))
    page.add("<h2>Delays</h2>" + _html(delay_table(results)))
    rows = [[escape(channel), escape(words)] for channel, words in MEANING.items()]
    page.add(table(("channel", "from → to"), rows, ("", "")))
    page.add(f"<h2>Delays of feedback and frames at the recorder</h2>{_html(recorder_table(results))}")
    for name in ("delays-command", "delays-video", "delays-evolution"):
        page.add(_picture(name))
    page.add(f"<h2>Path</h2>{_html(path_table(results))}{_picture('path')}")
    if results.tracking is not None:
        off = Line("off", np.array(results.way.off_at_s), np.array(results.way.off_m))
        page.chart("Off the path", "m, from where it should have been", [off], limits([off], least_span=0.2, zero=True))
    page.add("<footer>Delays are in ms unless stated otherwise. The paper's means: Mellado-Bataller et al., IAS-12, ")
    page.add("2013, Table 1, on one host. flight.mcap beside this page holds all its data.</footer>")
    return page


def _html(found: tables.Table) -> str:
    rows: list[Any] = [[escape(cell) for cell in row] for row in found.rows]
    return table(found.columns, rows, ["", *["n"] * (len(found.columns) - 1)])


def _picture(name: str) -> str:
    words = escape(PICTURES[name])
    return (
        f'<figure><img src="{name}.png" alt="{words}" style="max-width:100%"><figcaption>{words}</figcaption></figure>'
    )
