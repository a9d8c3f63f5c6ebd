"""Draw the paper's figures 3, 4 and 5 from our results, as PNG and SVG. Matplotlib is imported when used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from benchmarks.measuring.contenders import FLOOR, OURS
from benchmarks.measuring.delays import PAPER_MEAN_MS, Delays, Series
from benchmarks.measuring.schedule import CHANNELS, COMMAND, VIDEO
from skyloop.errors import MissingExtraError
from skyloop.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS: Final = {"command": "#0b6e99", "feedback": "#d9730d", "video": "#4d8c57"}
_OTHERS: Final = {
    "floor": "#9a9a9a",
    "skyloop": "#0b6e99",
    "portable": "#3f8f7a",
    "fabric": "#4f9da6",
    "zeromq": "#c29243",
    "zenoh": "#7b5ea7",
    "ros2": "#b8463d",
}
_PAPER: Final = "#b8463d"
_BINS: Final = 60
_SHOWN: Final = 99.5  #: percentile up to which a distribution is drawn; the number of delays beyond it is stated
_SETTINGS: Final[Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "skyloop",
    "figure.facecolor": "white",
}


def draw(results: Delays, folder: Path) -> list[Path]:
    """Draw all figures of a run into a folder.

    Returns:
        The files.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    return save(lambda: {**paper_figures(results), "delays-comparison": comparison(results)}, folder)


def paper_figures(results: Delays) -> dict[str, Figure]:
    """Return the paper's figures 3, 4 and 5, keyed by file name."""
    series = {one.channel: one for one in results.series}
    return {
        "delays-command": distribution(series[COMMAND], f"Delay of commands, {_where(results)}"),
        "delays-video": distribution(series[VIDEO], f"Delay of {results.sizes[0]} frames, {_where(results)}"),
        "delays-evolution": evolution(results),
    }


def save(make: Callable[[], dict[str, Figure]], folder: Path, endings: Sequence[str] = ("png", "svg")) -> list[Path]:
    """Create figures in the pages' style and write them to files.

    Args:
        make: Makes the figures, keyed by name.
        folder: The folder for the files.
        endings: File name endings; each figure is written once for each of them.

    Returns:
        The files.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    check_installed()
    import matplotlib as mpl

    files: list[Path] = []
    with mpl.rc_context(_SETTINGS):
        for name, figure in make().items():
            for ending in endings:
                file = folder / f"{name}.{ending}"
                metadata: dict[str, Any] = {"Date": None} if ending == "svg" else {}
                with replacing(file) as part:
                    figure.savefig(part, dpi=110, bbox_inches="tight", metadata=metadata)
                files.append(file)
    return files


def check_installed() -> None:
    """Check that figures can be drawn here.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("drawing the figures", "bench", cause=str(error)) from None


def distribution(series: Series, title: str) -> Figure:
    """Draw the distribution of delays, as in the paper's figures 3 and 4."""
    figure, axes = new_figure(7.2, 3.2)
    delays_us = np.asarray(series.delay_us)
    shown = delays_us[delays_us <= np.percentile(delays_us, _SHOWN)]
    axes.hist(shown, bins=_BINS, color=_COLOURS[series.channel], weights=np.full(shown.size, 100 / delays_us.size))
    axes.axvline(float(delays_us.mean()), color="black", linewidth=1, label=f"mean {delays_us.mean():.0f} µs")
    median = float(np.median(delays_us))
    axes.axvline(median, color="black", linewidth=1, linestyle=":", label=f"median {median:.0f} µs")
    paper_us = PAPER_MEAN_MS[series.channel] * 1e3
    if paper_us <= 1.5 * shown.max():
        axes.axvline(paper_us, color=_PAPER, linewidth=1, linestyle="--", label=f"the paper's mean {paper_us:.0f} µs")
    else:
        axes.plot([], [], color=_PAPER, linestyle="--", label=f"the paper's mean {paper_us:.0f} µs is off to the right")
    beyond = delays_us.size - shown.size
    axes.set(
        title=title,
        ylabel="share of the samples [%]",
        xlim=(0, None),
        xlabel=f"delay [µs]; {beyond} of {delays_us.size} lie beyond, the longest at {delays_us.max():.0f}",
    )
    axes.legend(frameon=False)
    return figure


def evolution(results: Delays) -> Figure:
    """Draw all three channels over the time of the run, as in the paper's figure 5."""
    figure, axes = new_figure(7.2, 3.6)
    for series in results.series:
        axes.plot(
            series.at_s,
            np.asarray(series.delay_us) / 1e3,
            ".",
            markersize=2.5,
            alpha=0.6,
            rasterized=True,
            color=_COLOURS[series.channel],
            label=series.channel,
        )
    axes.set(title=f"Delays over the run, {_where(results)}", xlabel="time [s]", ylabel="delay [ms]", yscale="log")
    _label_decades(axes)
    axes.grid(axis="y", alpha=0.3)
    axes.legend(frameon=False, markerscale=4, ncols=len(CHANNELS), loc="upper center", bbox_to_anchor=(0.5, -0.18))
    return figure


def comparison(results: Delays) -> Figure:
    """Draw the medians of all contenders, with the 99th percentile as a whisker."""
    groups = [(results.sizes[0], channel) for channel in CHANNELS if channel != VIDEO]
    groups += [(size, VIDEO) for size in results.sizes]
    figure, axes = new_figure(7.2, 3.6)
    names = [name for name in (FLOOR.name, OURS.name, *results.contenders) if name in results.contenders]
    names = list(dict.fromkeys(names))
    width = 0.8 / len(names)
    for number, name in enumerate(names):
        found = [results.summary(name, size, channel) for size, channel in groups]
        medians = np.array([np.nan if one is None else one.median_us / 1e3 for one in found])
        beyond = np.array([np.nan if one is None else (one.p99_us - one.median_us) / 1e3 for one in found])
        places = np.arange(len(groups)) + (number - (len(names) - 1) / 2) * width
        axes.bar(
            places,
            medians,
            width * 0.9,
            color=_OTHERS.get(name, "#555555"),
            label=results.contenders[name],
            yerr=(np.zeros(len(groups)), beyond),
            error_kw={"linewidth": 0.8, "alpha": 0.7},
        )
    labels = [f"video\n{size}" if channel == VIDEO else channel for size, channel in groups]
    axes.set(
        title=f"Median delay, whiskers to the 99th percentile, {_where(results)}", ylabel="delay [ms]", yscale="log"
    )
    axes.set_xticks(range(len(groups)), labels)
    _label_decades(axes)
    axes.grid(axis="y", alpha=0.3)
    axes.legend(frameon=False, ncols=len(names), loc="upper center", bbox_to_anchor=(0.5, -0.16))
    return figure


def _label_decades(axes: Axes) -> None:
    """Label 1, 2 and 5 of each decade as plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator

    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter("{x:g}")


def new_figure(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure with one diagram; width and height are in inches."""
    from matplotlib.figure import Figure

    figure = Figure((width, height))
    return figure, figure.add_subplot()


def _where(results: Delays) -> str:
    return f"{results.machine.cores} cores"
