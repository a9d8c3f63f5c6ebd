"""Output layouts of YOLO and DETR networks in ONNX files: recognition and decoding. Pure.

YOLOv5 and v7 return rows of centre, size, objectness and class scores; YOLOv8, v9 and v11 the same, transposed and
without objectness; YOLOv10 and other exports that need no suppression return corners, score and class. YOLOX returns
offsets on the grid of its strides, unless exported with ``--decode_in_inference``. DETR's descendants return boxes as
fractions of the image, together with logits or scores.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError, UsageError
from skyloop.vision.object_tracks import Floats


class Layout(StrEnum):
    """The meaning of a network's outputs, and the kind of input it expects."""

    YOLO5 = "yolo5"  #: (1, n, 5 + classes), pixels, objectness: YOLOv5, v6 and v7
    YOLO8 = "yolo8"  #: (1, 4 + classes, n), pixels: YOLOv8, v9, v11
    END_TO_END = "end-to-end"  #: (1, n, 6) left, top, right, bottom, score, class: YOLOv10, exports with suppression
    YOLOX = "yolox"  #: (1, n, 5 + classes), offsets on a grid; the input is BGR of 0 to 255
    YOLOX_DECODED = "yolox-decoded"  #: as YOLOX, but in pixels
    RT_DETR = "rt-detr"  #: (1, n, 4 + classes), fractions of the image
    DETR = "detr"  #: boxes (1, n, 4), fractions of the image, and logits or scores (1, n, classes)
    RF_DETR = "rf-detr"  #: as DETR, but the input is normalised by ImageNet's mean and deviation
    LISTS = "lists"  #: boxes (n, 4) in pixels, scores (n) and labels (n): torchvision, RT-DETR with its postprocessor


#: Layouts that take the whole image stretched instead of letterboxed.
STRETCHED: Final = frozenset({Layout.RT_DETR, Layout.DETR, Layout.RF_DETR})
#: Layouts that take BGR from 0 to 255 instead of RGB from 0 to 1.
RAW_BGR: Final = frozenset({Layout.YOLOX, Layout.YOLOX_DECODED})
#: Layouts whose boxes overlap and need suppression.
SUPPRESSED: Final = frozenset({Layout.YOLO5, Layout.YOLO8, Layout.YOLOX, Layout.YOLOX_DECODED})

_STRIDES: Final = ((8, 16, 32), (8, 16, 32, 64))  # grids of YOLOX models [px]
_FEW: Final = 1000  # maximum number of queries of a network without suppression (usual: 100 to 900, mostly 300)

Array = NDArray[np.generic]
Outputs = Mapping[str, Array]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Rows of a network's output: candidate detections."""

    corners: Floats  #: left, top, right, bottom in pixels of the network's input, (n, 4)
    scores: Floats  #: scores, 0 to 1, (n,)
    classes: NDArray[np.int64]  #: (n,)


def grid_places(width: int, height: int) -> tuple[int, ...]:
    """Return the possible numbers of grid cells of an input [px], first for strides up to 32, then up to 64."""
    return tuple(sum((width // s) * (height // s) for s in strides) for strides in _STRIDES)


def describe(outputs: Outputs) -> str:
    """Describe the names and shapes of outputs for an error message."""
    return ", ".join(f"{name} {tuple(value.shape)}" for name, value in outputs.items()) or "none"


def tell_layout(outputs: Outputs, width: int, height: int, classes: int | None = None) -> Layout:
    """Recognise a network's layout from its outputs by name, from one run on any image; width and height of its input.

    FileFormatError if they fit none of the families, or several. ``classes`` is the number of known class names.
    """
    if len(outputs) == 3:
        _lists(outputs)
        return Layout.LISTS
    if len(outputs) == 2:
        _pair(outputs)
        named = {name.lower() for name in outputs}
        return Layout.RF_DETR if named == {"dets", "labels"} else Layout.DETR
    if len(outputs) != 1:
        raise _unknown(outputs)
    values = next(iter(outputs.values()))
    if values.ndim != 3 or values.shape[0] != 1:
        raise _unknown(outputs)
    rows, columns = values.shape[1:]
    places = grid_places(width, height)
    if columns in places and rows >= 5:
        return Layout.YOLO8
    if rows in places and classes is not None and columns == 4 + classes:
        return Layout.YOLO8  # transposed
    if rows in places and columns >= 6:
        if not _decoded(_numbers(values)[0], width, height):
            return Layout.YOLOX
        raise FileFormatError(
            f"its output ({describe(outputs)}) is in pixels and may be from YOLOX or YOLOv6, which differ in their "
            f"input: give layout={Layout.YOLOX_DECODED.value!r} or layout={Layout.YOLO5.value!r}"
        )
    if rows in [3 * each for each in places] and columns >= 6:
        return Layout.YOLO5
    if rows <= _FEW and columns == 6:
        if classes == 2 and _shares(_numbers(values)[0, :, :4]):
            raise FileFormatError(
                f"its output ({describe(outputs)}) may be corners, score and class, or a box and the scores of two "
                f"classes: give layout={Layout.END_TO_END.value!r} or layout={Layout.RT_DETR.value!r}"
            )
        return Layout.END_TO_END
    if rows <= _FEW and columns >= 5 and _shares(_numbers(values)[0, :, :4]):
        return Layout.RT_DETR
    raise _unknown(outputs)


def class_count(layout: Layout, outputs: Outputs) -> int | None:
    """Return the number of classes that have scores; None if the outputs give class numbers instead."""
    if layout in (Layout.END_TO_END, Layout.LISTS):
        return None
    if layout in (Layout.DETR, Layout.RF_DETR):
        return int(_pair(outputs)[1].shape[2])
    shape = _single(outputs, layout).shape
    if layout is Layout.YOLO8:
        return int(min(shape[1:])) - 4
    return int(shape[2]) - (4 if layout is Layout.RT_DETR else 5)


def decode(layout: Layout, outputs: Outputs, width: int, height: int) -> Found:
    """Decode a network's outputs into boxes, scores and classes. Rows with non-finite values pass unchanged.

    Args:
        layout: Layout of the outputs.
        outputs: Outputs by name.
        width: Width of the network's input [px].
        height: Height of the network's input [px].

    Raises:
        FileFormatError: The shapes of the outputs don't match the layout.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # hostile numbers become infinite and are dropped later
        if layout is Layout.LISTS:
            boxes, scores, labels = _lists(outputs)
            finite = np.where(np.isfinite(labels), labels, -1.0)
            return Found(boxes, scores, _whole(finite))
        if layout in (Layout.DETR, Layout.RF_DETR):
            shares, certainties = _pair(outputs)
            return _shared(_numbers(shares)[0], _as_scores(_numbers(certainties)[0]), width, height)
        rows = _numbers(_single(outputs, layout))[0]
        if layout is Layout.END_TO_END:
            _columns(rows, 6, layout, outputs, exactly=True)
            return Found(rows[:, :4], rows[:, 4], _whole(np.where(np.isfinite(rows[:, 5]), rows[:, 5], -1.0)))
        if layout is Layout.YOLO8 and rows.shape[0] < rows.shape[1]:
            rows = rows.T
        if layout in (Layout.RT_DETR, Layout.YOLO8):
            _columns(rows, 5, layout, outputs)
            if layout is Layout.RT_DETR:
                return _shared(rows[:, :4], rows[:, 4:], width, height)
            return _surest(_corners(rows[:, :4]), rows[:, 4:])
        _columns(rows, 6, layout, outputs)
        boxes = rows[:, :4]
        if layout is Layout.YOLOX:
            centres, strides = _grid(len(rows), width, height, outputs)
            boxes = np.hstack([boxes[:, :2] * strides + centres, np.exp(boxes[:, 2:]) * strides])
        return _surest(_corners(boxes), rows[:, 5:] * rows[:, 4:5])


def _unknown(outputs: Outputs) -> FileFormatError:
    return FileFormatError(
        f"its outputs ({describe(outputs)}) have no known layout: one output of YOLOv5 to v11, YOLOX or RT-DETR, "
        "boxes and logits of a DETR, or boxes, scores and labels; for bare detection, one image at a time. "
        "If they are ambiguous, give layout=, one of " + ", ".join(each.value for each in Layout)
    )


def _single(outputs: Outputs, layout: Layout) -> Array:
    """Return the only output for one image; if the first one fits, ignore others (of a training head)."""
    values = next(iter(outputs.values()), None)
    if values is None or values.ndim != 3 or values.shape[0] != 1:
        raise FileFormatError(
            f"its outputs ({describe(outputs)}) don't fit layout {layout.value!r}: the first must have shape (1, …, …)"
        )
    return values


def _columns(rows: Floats, least: int, layout: Layout, outputs: Outputs, *, exactly: bool = False) -> None:
    if rows.shape[1] < least or (exactly and rows.shape[1] != least):
        raise FileFormatError(
            f"its outputs ({describe(outputs)}) don't fit layout {layout.value!r}: "
            f"a row must have {'' if exactly else 'at least '}{least} numbers"
        )


def _numbers(values: Array) -> Floats:
    try:
        return np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise FileFormatError(f"its output is {values.dtype} and must be numeric") from None


def _pair(outputs: Outputs) -> tuple[Array, Array]:
    """Tell boxes from logits, by name if both could be boxes."""
    shapes = [value.shape for value in outputs.values()]
    if len(shapes) != 2 or any(len(s) != 3 or s[0] != 1 for s in shapes) or shapes[0][1] != shapes[1][1]:
        raise _unknown(outputs)
    may_be = [name for name, value in outputs.items() if value.shape[2] == 4]
    named = [name for name in may_be if "box" in name.lower() or "dets" in name.lower()]
    if len(may_be) != 1 and len(named) != 1:
        raise _unknown(outputs)
    boxes = named[0] if len(named) == 1 else may_be[0]
    other = next(name for name in outputs if name != boxes)
    return outputs[boxes], outputs[other]


def _lists(outputs: Outputs) -> tuple[Floats, Floats, Floats]:
    """Return boxes (n, 4), scores (n) and labels (n), after removing a leading axis for a single image."""
    single = {name.lower(): _numbers(value) for name, value in outputs.items()}
    single = {name: value[0] if value.ndim > 1 and value.shape[0] == 1 else value for name, value in single.items()}
    boxes = [value for name, value in single.items() if "box" in name]
    scores = [value for name, value in single.items() if "score" in name]
    labels = [value for name, value in single.items() if "label" in name or "class" in name]
    if len(outputs) != 3 or not len(boxes) == len(scores) == len(labels) == 1:
        raise _unknown(outputs)
    rows = boxes[0].reshape(-1, 4) if boxes[0].size % 4 == 0 else boxes[0]
    score, label = scores[0].reshape(-1), labels[0].reshape(-1)
    if rows.ndim != 2 or not len(rows) == len(score) == len(label):
        raise _unknown(outputs)
    return rows, score, label


def _shares(boxes: Floats) -> bool:
    """Return whether centres and sizes are fractions of the image, even those of queries that found nothing."""
    finite = boxes[np.isfinite(boxes).all(axis=1)]
    return bool(len(finite)) and bool(((finite >= -0.5) & (finite <= 1.5)).all())


def _as_scores(values: Floats) -> Floats:
    """Return scores unchanged and logits through a sigmoid; values outside 0 to 1 mean logits."""
    finite = values[np.isfinite(values)]
    if len(finite) and (finite.min() < 0.0 or finite.max() > 1.0):
        return np.asarray(1.0 / (1.0 + np.exp(-values)), np.float64)
    return values


def _corners(boxes: Floats) -> Floats:
    half = boxes[:, 2:] / 2
    return np.hstack([boxes[:, :2] - half, boxes[:, :2] + half])


def _shared(boxes: Floats, scores: Floats, width: int, height: int) -> Found:
    return _surest(_corners(boxes * np.array([width, height, width, height], np.float64)), scores)


def _surest(corners: Floats, scores: Floats) -> Found:
    """Take each row's best class. NaN counts as the best, so that its row is dropped later."""
    if not len(scores):
        return Found(corners, np.zeros(0), np.zeros(0, np.int64))
    classes = np.argmax(scores, axis=1)
    return Found(corners, scores[np.arange(len(scores)), classes], classes.astype(np.int64))


def _whole(labels: Floats) -> NDArray[np.int64]:
    return np.clip(np.round(labels), -1, 1e6).astype(np.int64)


def _grid(rows: int, width: int, height: int, outputs: Outputs) -> tuple[Floats, Floats]:
    """Return the corner and stride of each grid cell [px], (n, 2) and (n, 1)."""
    for strides, places in zip(_STRIDES, grid_places(width, height), strict=True):
        if places == rows:
            return _places(strides, width, height)
    raise FileFormatError(
        f"its outputs ({describe(outputs)}) don't fit layout 'yolox': an input of {width}×{height} pixels has "
        + " or ".join(str(each) for each in grid_places(width, height))
        + " places"
    )


def _places(strides: Sequence[int], width: int, height: int) -> tuple[Floats, Floats]:
    corners, sizes = [], []
    for stride in strides:
        y, x = np.mgrid[0 : height // stride, 0 : width // stride]
        corners.append(np.stack([x.ravel(), y.ravel()], axis=1) * float(stride))
        sizes.append(np.full((x.size, 1), float(stride)))
    return np.vstack(corners), np.vstack(sizes)


def _decoded(rows: Floats, width: int, height: int) -> bool:
    """Return whether centres are in pixels, near their grid cells, rather than offsets from those cells."""
    strides = _STRIDES[grid_places(width, height).index(len(rows))]
    corners, sizes = _places(strides, width, height)
    with np.errstate(invalid="ignore"):
        off = np.nanmedian(np.abs(rows[:, :2] - corners) / sizes) if np.isfinite(rows[:, :2]).any() else math.inf
        raw = np.nanmedian(np.abs(rows[:, :2])) if np.isfinite(rows[:, :2]).any() else math.inf
    return bool(off < raw)


def layout_named(name: str | Layout | None) -> Layout | None:
    """Check a layout's name."""
    if name is None:
        return None
    try:
        return Layout(name)
    except ValueError:
        known = ", ".join(each.value for each in Layout)
        raise UsageError(f"layout is {name!r} and must be one of {known}") from None
