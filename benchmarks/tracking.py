"""Compare our trackers with OpenCV's weight-free ones on the same images: ``python -m benchmarks.tracking``.

Success is the fraction of images with the target in view in which the box overlaps the true one by half or more;
precision is the fraction with centres at most 20 pixels apart. A loss reported while the target is in view counts
against both. Each tracker has one core, and its processor time is counted.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import cv2
import msgspec
import numpy as np

from benchmarks.measuring.tables import Table
from benchmarks.tracking_film import LABELS, read_film, read_labels
from benchmarks.tracking_scenes import KINDS, Sequence, Truth, fixed, moved, scene
from skyloop.bench import Machine, Spread, spread
from skyloop.files import write
from skyloop.vision import CorrelationTracker, LongTermTracker, MedianFlowTracker, Tracker
from skyloop.vision.tracking import Box, Image, TrackResult, overlap

OVERLAP: Final = 0.5
NEAR_PX: Final = 20.0
OVERLAPS: Final = tuple(n / 20 for n in range(21))  #: thresholds of the success curve
DISTANCES_PX: Final = tuple(range(0, 51, 2))  #: thresholds of the precision curve
BINS: Final = (0.45, 0.6, 0.7, 0.8, 0.9, 1.001)  #: limits of the bins of scores

Make = Callable[[], Tracker]


class OpenCvTracker(Tracker):
    """One of OpenCV's own trackers, which has no score and is never lost unless it reports so."""

    def __init__(self, make: Callable[[], Any]) -> None:
        """Keep the constructor, because a tracker can be started only once."""
        self._make = make

    def _start(self, image: Image, box: Box) -> None:
        self._tracker = self._make()
        self._tracker.init(image, tuple(round(part) for part in box))

    def _update(self, image: Image) -> TrackResult:
        found, box = self._tracker.update(image)
        x, y, width, height = (float(part) for part in box)
        return TrackResult((x, y, width, height) if found else None, 1.0 if found else 0.0)


class TrackerResults(msgspec.Struct, frozen=True):
    """One tracker on one group of sequences."""

    group: str
    tracker: str
    in_view: int  #: number of images with the target in view
    hidden: int  #: number of images without the target in view
    success: list[float]  #: fraction of the images in view that reach each of OVERLAPS
    precision: list[float]  #: the same for each of DISTANCES_PX
    wrong: int  #: images in view with a box that overlaps by less than OVERLAP
    ghosts: int  #: images without the target in view that have a box
    update: Spread  #: processor time
    scores: list[tuple[int, int]]  #: boxes with a score in each of BINS, and how many overlap by OVERLAP

    @property
    def successes(self) -> float:
        """Fraction of the images in view with an overlap of OVERLAP or more."""
        return self.success[OVERLAPS.index(OVERLAP)]

    @property
    def near(self) -> float:
        """Fraction of the images in view within NEAR_PX."""
        return self.precision[DISTANCES_PX.index(NEAR_PX)]


class TrackingResults(msgspec.Struct, frozen=True):
    """A whole run."""

    machine: Machine
    rows: list[TrackerResults]


def trackers() -> dict[str, Make]:
    """Return our trackers, and the weight-free ones of this OpenCV."""
    found: dict[str, Make] = {
        "LongTermTracker": LongTermTracker,
        "CorrelationTracker": CorrelationTracker,
        "MedianFlowTracker": MedianFlowTracker,
    }
    for name in ("MIL", "KCF", "CSRT"):  # the last two are in opencv-contrib only
        make = getattr(cv2, f"Tracker{name}_create", None)
        if make is not None:
            found[f"OpenCV {name}"] = partial(OpenCvTracker, make)
    return found


def groups(film: Path | None, quick: bool = False) -> dict[str, list[Sequence]]:
    """Return the sequences: the drawn ones and, with a film, its own and those derived from it."""
    count = 24 if quick else 90
    found = {"drawn": [scene(kind, seed, count) for kind in KINDS for seed in range(100, 101 if quick else 102)]}
    if film is not None:
        labels = read_labels()
        frames = read_film(film, 24 if quick else None)
        # Only every second frame, so that the run takes about a minute.
        halved = {name: {n // 2: box for n, box in boxes.items()} for name, boxes in labels.objects.items()}
        found["film"] = [fixed(name, frames[::2], boxes) for name, boxes in halved.items()]
        found["film, moved"] = [
            moved(name, frames, boxes, min(len(frames), 90), seed)
            for seed, (name, boxes) in enumerate(labels.objects.items())
        ]
    return found


def measure(
    sequences: Mapping[str, Iterable[Sequence]], makes: Mapping[str, Make], report: Callable[[str], None]
) -> TrackingResults:
    """Run all trackers on all sequences, on one core."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    rows = []
    try:
        for group, members in sequences.items():
            for name, make in makes.items():
                report(f"{name} on {group}")
                rows.append(_row(group, name, make, members))
    finally:
        cv2.setNumThreads(before)
    return TrackingResults(Machine.here(), rows)


def _row(group: str, name: str, make: Make, sequences: Iterable[Sequence]) -> TrackerResults:
    took_ns: list[int] = []
    results: list[tuple[TrackResult, Truth]] = []
    for sequence in sequences:
        tracker = make()
        for n, (image, truth, counts) in enumerate(sequence.frames()):
            if n == 0:
                assert truth is not None
                tracker.start(image, truth)
                continue
            began_ns = time.thread_time_ns()
            found = tracker.update(image)
            took_ns.append(time.thread_time_ns() - began_ns)
            if counts:
                results.append((found, truth))
    in_view = [(found, truth) for found, truth in results if truth is not None]
    overlaps = np.array([0.0 if found.box is None else overlap(found.box, truth) for found, truth in in_view])
    distances = np.array([_distance(found, truth) for found, truth in in_view])
    boxed = [
        (found.score, truth is not None and bool(overlap(found.box, truth) >= OVERLAP))
        for found, truth in results
        if found.box
    ]
    bins = [[good for score, good in boxed if low <= score < high] for low, high in pairwise(BINS)]
    return TrackerResults(
        group=group,
        tracker=name,
        in_view=len(in_view),
        hidden=len(results) - len(in_view),
        success=[float(np.mean((overlaps >= least) & (overlaps > 0))) for least in OVERLAPS],
        precision=[float(np.mean(distances <= most)) for most in DISTANCES_PX],
        wrong=sum(1 for found, truth in in_view if found.box and overlap(found.box, truth) < OVERLAP),
        ghosts=sum(found.box is not None for found, truth in results if truth is None),
        update=spread(took_ns),
        scores=[(len(goods), sum(goods)) for goods in bins],
    )


def _distance(found: TrackResult, truth: Box) -> float:
    """Return the distance between the centres [px]; infinity while lost."""
    if found.centre is None:
        return math.inf
    return math.dist(found.centre, (truth[0] + (truth[2] - 1) / 2, truth[1] + (truth[3] - 1) / 2))


def table(results: TrackingResults) -> Table:
    """Return the main figures."""
    rows = [
        [
            row.group,
            row.tracker,
            f"{row.successes:.1%}",
            f"{row.near:.1%}",
            f"{row.wrong} of {row.in_view}",
            f"{row.ghosts} of {row.hidden}" if row.hidden else "–",
            f"{row.update.median_us / 1e3:.1f} ({row.update.p99_us / 1e3:.1f})",
        ]
        for row in results.rows
    ]
    columns = ["images", "tracker", "success", "precision", "wrong box", "box while hidden", "ms: median (p99)"]
    return Table("Trackers", columns, rows)


def score_table(results: TrackingResults) -> Table:
    """Return the meaning of the long-term tracker's scores."""
    rows = []
    for n, (low, high) in enumerate(pairwise(BINS)):
        counts = [row.scores[n] for row in results.rows if row.tracker == "LongTermTracker"]
        boxes, good = (sum(column) for column in zip(*counts, strict=True))
        rows.append([f"{low:.2f} to {min(high, 1.0):.2f}", str(boxes), f"{good / boxes:.1%}" if boxes else "–"])
    return Table("Scores of the long-term tracker", ["score", "boxes", "overlap of a half or more"], rows)


def draw(results: TrackingResults, file: Path) -> None:
    """Draw the success and precision curves of each group."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(row.group for row in results.rows))
    figure = Figure((9.0, 2.7 * len(names)), layout="constrained")
    axes: Any = figure.subplots(len(names), 2, squeeze=False, sharey=True)
    for row in results.rows:
        left, right = axes[names.index(row.group)]
        left.plot(OVERLAPS, row.success, label=row.tracker)
        right.plot(DISTANCES_PX, row.precision, label=row.tracker)
        left.set(title=f"{row.group}: success", xlabel="overlap, at least", ylim=(-0.03, 1.03))
        right.set(title=f"{row.group}: precision", xlabel="distance between the centres [px], at most")
    for each in axes.ravel():
        each.grid(alpha=0.3)
    axes[0][0].legend(frameon=False, fontsize=8, loc="lower left")
    figure.savefig(file, dpi=80)


def main(arguments: list[str] | None = None) -> None:
    """Measure, print the tables, and write them with the figure."""
    parser = argparse.ArgumentParser(prog="benchmarks.tracking", description=__doc__)
    fixtures = LABELS.parents[4] / "shared" / "fixtures"
    parser.add_argument("--fixtures", type=Path, default=fixtures, help="the folder with the recorded film")
    parser.add_argument("--output", type=Path, help="folder for tracking.json and tracking.png")
    parser.add_argument("--quick", action="store_true", help="few images, to check that it works")
    options = parser.parse_args(arguments)
    film = options.fixtures / read_labels().film
    if not film.is_file():
        print(f"{film} is missing: using only drawn images")
        film = None
    results = measure(groups(film, options.quick), trackers(), lambda what: print(f"… {what}", flush=True))
    print(results.machine)
    for each in (table(results), score_table(results)):
        print(f"\n{each.title}\n\n{each.markdown()}")
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        write(options.output / "tracking.json", msgspec.json.encode(results) + b"\n")
        draw(results, options.output / "tracking.png")


if __name__ == "__main__":
    main()
