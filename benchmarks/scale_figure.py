"""Draw delays and processor time over the number of proxies and observers. Matplotlib is imported when used."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from benchmarks.measuring.schedule import COMMAND, FEEDBACK, VIDEO
from benchmarks.scale import PARTS, Scale
from skyloop.errors import MissingExtraError
from skyloop.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DELAYS: Final = {COMMAND: "#0b6e99", f"{FEEDBACK}, observers": "#d9730d", f"{VIDEO}, observers": "#4d8c57"}
_SHARES: Final = dict(zip(PARTS, ("#7b5ea7", "#0b6e99", "#d9730d", "#9a9a9a"), strict=True))
SERIES: Final = ("proxies", "observers")


def draw(results: Scale, folder: Path) -> list[Path]:
    """Draw ``scale.png``: delays above, processor time below, for more proxies and for more observers.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("drawing the figures", "bench", cause=str(error)) from None
    figure = Figure((9.0, 5.6), layout="constrained")
    axes: Any = figure.subplots(2, 2, sharex=True)
    for column, many in enumerate(SERIES):
        _delays(axes[0][column], results, many)
        _processor(axes[1][column], results, many)
    file = folder / "scale.png"
    with replacing(file) as part:
        figure.savefig(part, dpi=110)
    return [file]


def _delays(axes: Axes, results: Scale, many: str) -> None:
    series = results.series(many)
    counts = [case.observers for case in series]
    for channel, colour in _DELAYS.items():
        found = [(case.observers, case.channels[channel]) for case in series if channel in case.channels]
        at = [count for count, _ in found]
        axes.plot(at, [one.median_us / 1e3 for _, one in found], "o-", color=colour, label=channel, markersize=4)
        axes.plot(at, [one.p99_us / 1e3 for _, one in found], "o:", color=colour, markersize=3, linewidth=1)
    axes.set(title=f"more {many}", ylabel="delay [ms], dotted: p99", xscale="log", yscale="log")
    _plain(axes, counts)
    axes.legend(frameon=False, fontsize=8)


def _processor(axes: Axes, results: Scale, many: str) -> None:
    series = results.series(many)
    counts = [case.observers for case in series]
    parts = [part for part in PARTS if any(part in case.cpu for case in series)]
    axes.stackplot(
        counts,
        *([case.cpu.get(part, 0.0) for case in series] for part in parts),
        labels=parts,
        colors=[_SHARES[part] for part in parts],
        alpha=0.8,
    )
    axes.axhline(results.machine.cores, color="black", linewidth=1, linestyle="--", label="all cores")
    axes.set(xlabel=many, ylabel="cores in use", xscale="log")
    _plain(axes, counts)
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def _plain(axes: Axes, counts: list[int]) -> None:
    """Label the measured numbers as plain numbers."""
    from matplotlib.ticker import NullLocator

    axes.set_xticks(counts, [str(count) for count in counts])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(axis="y", alpha=0.3)
