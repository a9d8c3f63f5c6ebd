"""Compare a detector's boxes with the true ones: matches, average precision. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.vision.object_tracks import overlaps

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """The outcome of the detections and true boxes of one class in one picture.

    Attributes:
        scores: Scores of the detections, (n,).
        right: Whether each detection found a true box that counts, (n,).
        ignored: Whether each detection is neither right nor wrong, because it found a box that does not count, (n,).
        best: Score of the detection that found each true box that counts, or -1 if it was missed, (boxes that count,).
    """

    scores: Floats
    right: NDArray[np.bool_]
    ignored: NDArray[np.bool_]
    best: Floats


def match(found: Floats, scores: Floats, true: Floats, counts: NDArray[np.bool_], least: float = 0.5) -> Matches:
    """Match each detection of a class in a picture, the most certain first, with the true box that it overlaps most.

    A true box is found once; a detection that finds none is wrong, unless it overlaps a box that does not count.

    Args:
        found: Corners of the detections, (n, 4).
        scores: Scores of the detections, (n,).
        true: Corners of the true boxes, (m, 4).
        counts: Whether each true box must be found, (m,).
        least: Minimum overlap of a match: shared area over united area.
    """
    right, ignored = np.zeros(len(found), np.bool_), np.zeros(len(found), np.bool_)
    best = np.full(len(true), -1.0)
    for row in np.argsort(-scores, kind="stable"):
        shares = overlaps(found[row], true) if len(true) else np.zeros(0)
        open_ = np.where(counts & (best < 0.0), shares, 0.0)
        if open_.size and open_.max() >= least:
            place = int(open_.argmax())
            best[place], right[row] = scores[row], True
        else:
            ignored[row] = bool((shares[~counts] >= least).any())
    return Matches(scores, right, ignored, best[counts])


def average_precision(matches: Sequence[Matches]) -> float:
    """Return the area under precision over recall, precision made monotone as in PASCAL VOC 2010; NaN without boxes.

    Everingham et al., "The PASCAL Visual Object Classes Challenge: A Retrospective", IJCV 2015.
    """
    total = sum(len(each.best) for each in matches)
    if not total:
        return float("nan")
    kept = [~each.ignored for each in matches]
    scores = np.concatenate([each.scores[keep] for each, keep in zip(matches, kept, strict=True)])
    right = np.concatenate([each.right[keep] for each, keep in zip(matches, kept, strict=True)])
    hits = np.cumsum(right[np.argsort(-scores, kind="stable")])
    precision = hits / np.arange(1, len(hits) + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    steps = np.diff(np.append(0, hits))
    return float((precision * steps).sum() / total)


def recall(matches: Sequence[Matches], score: float) -> float:
    """Return the fraction of true boxes found with at least this score; NaN if there are none."""
    best = np.concatenate([each.best for each in matches]) if matches else np.zeros(0)
    return float((best >= score).mean()) if best.size else float("nan")


def precision(matches: Sequence[Matches], score: float) -> float:
    """Return the fraction of detections with at least this score that are right; NaN if there are none."""
    right = sum(int((each.right & (each.scores >= score)).sum()) for each in matches)
    wrong = false_alarms(matches, score)
    return right / (right + wrong) if right + wrong else float("nan")


def balanced_score(matches: Sequence[Matches]) -> float:
    """Return the score, 0.05 to 0.9, above which detections have the best harmonic mean of recall and precision."""
    tried = np.arange(0.05, 0.9, 0.01)
    pairs = [(recall(matches, score), precision(matches, score)) for score in tried]
    means = [2 * found * right / (found + right) if found + right > 0 else 0.0 for found, right in pairs]
    return float(tried[int(np.argmax(means))])


def false_alarms(matches: Sequence[Matches], score: float) -> int:
    """Return the number of detections with at least this score that found nothing."""
    return sum(int((~each.right & ~each.ignored & (each.scores >= score)).sum()) for each in matches)
