"""Draw the newest image's age over the path's capacity. Matplotlib is imported when used."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.hosts import traces
from benchmarks.video_path import FROZEN_MS, GOOD_KBIT_S, VideoPath
from skyloop.errors import MissingExtraError
from skyloop.files import replacing

_COLOURS: Final = ("#d9730d", "#9a9a9a", "#7b5ea7", "#0b6e99", "#4d8c57")
_STEP_MS: Final = 10.0
_MOST_MS: Final = 10_000.0


def draw(results: VideoPath, folder: Path) -> list[Path]:
    """Draw ``video-path.png``: the first trace, and all contenders that showed pictures on it.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("drawing the figures", "bench", cause=str(error)) from None
    shown = [case for case in results.cases if case.shown]
    if not shown:
        return []
    (trace,) = traces.find((shown[0].trace,))
    figure = Figure((9.0, 5.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    times = np.arange(0.0, results.seconds * 1000.0, _STEP_MS)
    for index, case in enumerate(shown):
        above.plot(
            times / 1e3, _age_ms(case.shown, times), label=case.contender, color=_COLOURS[index % 5], linewidth=1
        )
    above.axhline(FROZEN_MS, color="black", linewidth=0.6, linestyle=":")
    above.set(yscale="log", ylabel="age of the picture shown [ms]", ylim=(15, _MOST_MS), title=trace.name)
    figure.legend(frameon=False, fontsize=8, loc="outside lower center", ncols=len(shown))
    _carried(below, [trace.kbit(at, at + 1000.0) for at in range(0, int(results.seconds) * 1000, 1000)])
    file = folder / "video-path.png"
    with replacing(file) as part:
        figure.savefig(part, dpi=110)
    return [file]


def _age_ms(shown: list[tuple[int, int]], times: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    came = np.array([at for at, _ in shown])
    captured = np.array([at - age for at, age in shown])
    index = np.searchsorted(came, times, side="right") - 1
    return np.where(index >= 0, times - captured[np.maximum(index, 0)], np.nan)


def _carried(axes: Any, kbit_s: list[float]) -> None:
    colours = ["#d9730d" if rate < GOOD_KBIT_S else "#9a9a9a" for rate in kbit_s]
    axes.bar([second + 0.5 for second in range(len(kbit_s))], [rate / 1e3 for rate in kbit_s], 0.9, color=colours)
    axes.set(xlabel="time [s]", ylabel="carried [Mbit/s]")
