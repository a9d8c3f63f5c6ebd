"""Detectors of the YOLO and DETR families, loaded from a user's ONNX file and run on the CPU by ONNX Runtime.

A network's family is recognised by the layout of its outputs.
YOLOv5 and v7 return rows of centre, size, objectness and class scores; YOLOv8, v9 and v11 return the same, transposed
and without objectness; YOLOv10 and other exports that need no suppression return corners, score and class. YOLOX
returns offsets on the grid of its strides, unless exported with ``--decode_in_inference``. DETR's descendants return
boxes as fractions of the image, together with logits or scores.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError, UsageError
from skyloop.files import MAX_TEXT, read_text
from skyloop.vision.lens import pixels_of
from skyloop.vision.object_tracks import Detection, Floats, suppress
from skyloop.vision.onnx import load_network, reason
from skyloop.vision.opencv import opencv
from skyloop.vision.tracking import Image


class Layout(StrEnum):
    """The meaning of a network's outputs, and the kind of input it expects."""

    YOLO5 = "yolo5"  #: (1, n, 5 + classes), pixels, objectness: YOLOv5, v6 and v7
    YOLO8 = "yolo8"  #: (1, 4 + classes, n), pixels: YOLOv8, v9, v11
    END_TO_END = "end-to-end"  #: (1, n, 6) left, top, right, bottom, score, class: YOLOv10, exports with suppression
    YOLOX = "yolox"  #: (1, n, 5 + classes), offsets on a grid; the input is BGR of 0 to 255
    YOLOX_DECODED = "yolox-decoded"  #: like YOLOX, but in pixels
    RT_DETR = "rt-detr"  #: (1, n, 4 + classes), fractions of the image
    DETR = "detr"  #: boxes (1, n, 4), fractions of the image, and logits or scores (1, n, classes)
    RF_DETR = "rf-detr"  #: like DETR, but the input is normalised by ImageNet's mean and deviation
    LISTS = "lists"  #: boxes (n, 4) in pixels, scores (n) and labels (n): torchvision, RT-DETR with its postprocessor


#: Layouts for which the whole image is stretched instead of letterboxed.
STRETCHED: Final = frozenset({Layout.RT_DETR, Layout.DETR, Layout.RF_DETR})
#: Layouts that take BGR from 0 to 255 instead of RGB from 0 to 1.
RAW_BGR: Final = frozenset({Layout.YOLOX, Layout.YOLOX_DECODED})
#: Layouts whose boxes overlap and need suppression.
SUPPRESSED: Final = frozenset({Layout.YOLO5, Layout.YOLO8, Layout.YOLOX, Layout.YOLOX_DECODED})

_STRIDES: Final = ((8, 16, 32), (8, 16, 32, 64))  # strides of the grids of YOLOX models [px]
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
    """Recognise a network's layout from the size of its input and the named outputs of one run on any image.

    Raises FileFormatError if the outputs fit no family or several. ``classes`` is the number of class names.
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
    """Decode a network's outputs, given the size of its input [px]. Rows with non-finite values pass unchanged.

    Raises FileFormatError if the outputs' shapes don't match the layout.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # hostile numbers become infinite and are dropped later
        if layout is Layout.LISTS:
            boxes, scores, labels = _lists(outputs)
            return Found(boxes, scores, _whole(labels))
        if layout in (Layout.DETR, Layout.RF_DETR):
            shares, certainties = _pair(outputs)
            return _shared(_numbers(shares)[0], _as_scores(_numbers(certainties)[0]), width, height)
        rows = _numbers(_single(outputs, layout))[0]
        if layout is Layout.END_TO_END:
            _columns(rows, 6, layout, outputs, exactly=True)
            return Found(rows[:, :4], rows[:, 4], _whole(rows[:, 5]))
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
        f"its outputs ({describe(outputs)}) have no known layout: they must be one output of YOLOv5 to v11, YOLOX or "
        "RT-DETR, boxes and logits of a DETR, or boxes, scores and labels, of one image, without masks or keypoints. "
        "If they are ambiguous, give layout=, one of " + ", ".join(each.value for each in Layout)
    )


def _single(outputs: Outputs, layout: Layout) -> Array:
    """Return the only output for one image; ignore further outputs (of a training head) if the first one fits."""
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
    """Distinguish boxes from logits, by name if both could be boxes."""
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
    """Return whether centres and sizes are fractions of the image, including those of queries that found nothing."""
    finite = boxes[np.isfinite(boxes).all(axis=1)]
    return bool(len(finite)) and bool(((finite >= -0.5) & (finite <= 1.5)).all())


def _as_scores(values: Floats) -> Floats:
    """Return scores unchanged, but logits after a sigmoid; values outside 0 to 1 mean logits."""
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
    """Choose each row's best class. NaN counts as the best score, so that its row is dropped later."""
    if not len(scores):
        return Found(corners, np.zeros(0), np.zeros(0, np.int64))
    classes = np.argmax(scores, axis=1)
    return Found(corners, scores[np.arange(len(scores)), classes], classes.astype(np.int64))


def _whole(labels: Floats) -> NDArray[np.int64]:
    """Return class numbers; -1 for labels that are not finite, whose rows are dropped later."""
    finite = np.where(np.isfinite(labels), labels, -1.0)
    return np.clip(np.round(finite), -1, 1e6).astype(np.int64)


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
    """Return the layout with this name; raise UsageError if there is none."""
    if name is None:
        return None
    try:
        return Layout(name)
    except ValueError:
        known = ", ".join(each.value for each in Layout)
        raise UsageError(f"layout is {name!r} and must be one of {known}") from None


_GREY: Final = 114  # grey level of the padding of letterboxed images, the same as in YOLO's training
_MEAN: Final = np.array([0.485, 0.456, 0.406], np.float32).reshape(3, 1, 1)  # ImageNet's mean, for RF-DETR
_DEVIATION: Final = np.array([0.229, 0.224, 0.225], np.float32).reshape(3, 1, 1)
_SIDE: Final = 640  # default side for a network that takes any size
_MOST_SIDE: Final = 4096  # maximum side of an input image [px]
_MOST: Final = 1000  # maximum number of best boxes that are compared with each other
_TYPES: Final = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class OnnxDetector:
    """Runs a YOLO or DETR network, recognised by its outputs, as a detector. Call it from one thread only.

    Attributes:
        layout: Layout of the network's outputs.
        names: Class names by number.
        size: Width and height of the network's input [px].
        dropped: Number of detections dropped because a value was not finite or the score was not from 0 to 1.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        score: float = 0.4,
        iou: float = 0.5,
        names: Sequence[str] | Mapping[int, str] | Path | str | None = None,
        threads: int = 1,
        layout: Layout | str | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        """Load the network and recognise its layout by running it on an empty image.

        Args:
            path: The ONNX file.
            score: Minimum score of a detection, 0 to 1.
            iou: Merge boxes of one class that overlap by more than this (intersection over union), 0 to 1.
            names: Class names: a list, a mapping from numbers, or a text file with one per line. If None, the names in
                the file's metadata are used, as written by Ultralytics, or else the numbers.
            threads: CPU threads per image; more than 1 takes CPU time away from other flight code.
            layout: Layout of the outputs, in case it is ambiguous.
            size: Width and height of the input [px], for a network that takes any size.

        Raises:
            MissingExtraError: ONNX Runtime or OpenCV is not installed.
            UsageError: An argument is out of its range, or there is no such file.
            FileFormatError: The file is not an ONNX file, or its network belongs to no known family.
        """
        for name, value in (("score", score), ("iou", iou)):
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 <= value <= 1.0:
                raise UsageError(f"{name} is {value!r} and must be a number from 0 to 1")
        if isinstance(threads, bool) or not isinstance(threads, int) or not 1 <= threads <= 64:
            raise UsageError(f"threads is {threads!r} and must be a whole number from 1 to 64")
        wanted = layout_named(layout)
        if size is not None:
            _check_size(size)
        self._score, self._iou = float(score), float(iou)
        self._path = Path(path)
        if not self._path.is_file():
            raise UsageError(f"there is no file {path}: give the ONNX file of a detector")
        self._cv = opencv("detecting")
        self._errors, self._session = load_network(self._path, threads, "detecting with an ONNX file")
        metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        task = metadata.get("task", "detect")
        if task != "detect":
            raise FileFormatError(f"{path} is a network for {task!r}, and must be one for 'detect'")
        self.names: dict[int, str] = _names(metadata.get("names"), self._path) if names is None else _given(names)
        self._input, self._type, self.size = self._check_inputs(size, metadata)
        self.dropped = 0
        self.layout = Layout.YOLO8 if wanted is None else wanted  # a blank image is the same in every layout
        blank = self._run(np.full((self.size[1], self.size[0], 3), _GREY, np.uint8))
        try:
            if wanted is None:
                self.layout = tell_layout(blank, *self.size, len(self.names) or None)
            decode(self.layout, blank, *self.size)
            self._check_names(class_count(self.layout, blank))
        except FileFormatError as error:
            raise FileFormatError(f"{path}: {error}") from None

    def detect(self, image: Image) -> list[Detection]:
        """Return the objects in the image, the most confident first.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or (h, w) grey, of any size.

        Raises:
            UsageError: The image has a wrong shape or type.
            FileFormatError: The network can't be run.
        """
        pixels = pixels_of(image)
        if pixels.ndim == 2:
            pixels = self._cv.cvtColor(pixels, self._cv.COLOR_GRAY2BGR)
        fitted, scale, shift = self._fit(pixels)
        found = decode(self.layout, self._run(fitted), *self.size)
        return self._detections(found, scale, shift, (pixels.shape[1], pixels.shape[0]))

    def _fit(self, pixels: Image) -> tuple[Image, NDArray[np.float64], NDArray[np.float64]]:
        """Return the image fitted to the input size, its scale (x, y) and the position of its corner (x, y)."""
        width, height = self.size
        rows, columns = pixels.shape[:2]
        if self.layout in STRETCHED:
            stretched = self._cv.resize(pixels, (width, height), interpolation=self._cv.INTER_LINEAR)
            return stretched, np.array([width / columns, height / rows]), np.zeros(2)
        factor = min(width / columns, height / rows)
        wide, high = max(round(columns * factor), 1), max(round(rows * factor), 1)
        if (wide, high) != (columns, rows):
            pixels = self._cv.resize(pixels, (wide, high), interpolation=self._cv.INTER_LINEAR)
        left, top = ((width - wide) // 2, (height - high) // 2) if self.layout not in RAW_BGR else (0, 0)
        canvas = np.full((height, width, 3), _GREY, np.uint8)
        canvas[top : top + high, left : left + wide] = pixels
        return canvas, np.array([wide / columns, high / rows]), np.array([left, top], np.float64)

    def _run(self, fitted: Image) -> dict[str, Any]:
        values: Any = np.stack(self._cv.split(fitted))  # channels first; several times faster than a transposed copy
        if self.layout not in RAW_BGR:
            values = values[::-1]
            if self._type is not np.uint8:
                values = np.divide(values, np.float32(255), dtype=np.float32)
                if self.layout is Layout.RF_DETR:
                    values = (values - _MEAN) / _DEVIATION
        tensor = np.ascontiguousarray(values[None], self._type)
        feed: dict[str, Any] = {self._input: tensor}
        for other in self._session.get_inputs():
            if other.name != self._input:  # RT-DETR's postprocessor needs the image size to scale its boxes
                feed[other.name] = np.array([self.size], np.int64)
        try:
            results = self._session.run(None, feed)
        except self._errors as error:
            raise FileFormatError(f"{self._path} can't be run on {_shape(tensor.shape)}: {reason(error)}") from error
        named = dict(zip((each.name for each in self._session.get_outputs()), results, strict=True))
        if not all(isinstance(each, np.ndarray) for each in results):
            raise FileFormatError(f"{self._path} returns sequences and must return arrays")
        return named

    def _detections(
        self, found: Found, scale: NDArray[np.float64], shift: NDArray[np.float64], size: tuple[int, int]
    ) -> list[Detection]:
        sound = np.isfinite(found.corners).all(axis=1) & (found.scores >= -1e-3) & (found.scores <= 1.001)
        self.dropped += int((~sound).sum())
        kept = np.flatnonzero(sound & (found.scores >= self._score) & (found.classes >= 0))
        kept = kept[np.argsort(-found.scores[kept], kind="stable")[:_MOST]]
        corners = (found.corners[kept] - np.tile(shift, 2)) / np.tile(scale, 2)
        corners = np.clip(corners, 0.0, np.tile(np.array(size, np.float64), 2))
        large = (corners[:, 2] - corners[:, 0] > 0) & (corners[:, 3] - corners[:, 1] > 0)
        corners, kept = corners[large], kept[large]
        scores, classes = np.clip(found.scores[kept], 0.0, 1.0), found.classes[kept]
        chosen = suppress(corners, scores, classes, self._iou) if self.layout in SUPPRESSED else np.arange(len(kept))
        made = []
        for row in chosen:
            left, top, right, bottom = (float(each) for each in corners[row])
            number = int(classes[row])
            name = self.names.get(number, str(number))
            made.append(Detection((left, top, right - left, bottom - top), float(scores[row]), number, name))
        return made

    def _check_inputs(
        self, size: tuple[int, int] | None, metadata: Mapping[str, str]
    ) -> tuple[str, Any, tuple[int, int]]:
        """Return the input's name, type and image size."""
        inputs = self._session.get_inputs()
        extra = [each.name for each in inputs[1:] if each.name != "orig_target_sizes"]
        shown = ", ".join(f"{each.name} {each.type} {tuple(each.shape)}" for each in inputs) or "none"
        if not inputs or extra:
            raise FileFormatError(f"{self._path} has the inputs {shown} and must have exactly one, an image")
        first = inputs[0]
        shape = list(first.shape)
        if len(shape) != 4 or first.type not in _TYPES or (shape[1] not in (3, None) and not isinstance(shape[1], str)):
            raise FileFormatError(
                f"{self._path} has the input {shown} and must have one of shape (1, 3, height, width) and type float, "
                "float16 or uint8"
            )
        if isinstance(shape[0], int) and shape[0] != 1:
            raise FileFormatError(f"{self._path} takes {shape[0]} images at a time: export it for batches of 1")
        fixed = [each if isinstance(each, int) and each > 0 else None for each in (shape[3], shape[2])]
        if size is None:
            asked = _literal(metadata.get("imgsz"))
            both = [int(each) for each in asked] if _is_pair(asked) else [_SIDE, _SIDE]
            size = both[1], both[0]  # Ultralytics stores the height first
        elif any(own is not None and own != given for own, given in zip(fixed, size, strict=True)):
            raise UsageError(f"size is {size!r}, but {self._path} takes only {_shape(shape)}: leave size out")
        width, height = (given if own is None else own for own, given in zip(fixed, size, strict=True))
        if not (0 < width <= _MOST_SIDE and 0 < height <= _MOST_SIDE):
            raise FileFormatError(f"{self._path} takes {width}×{height} pixels, but the limit is {_MOST_SIDE}")
        return first.name, _TYPES[first.type], (width, height)

    def _check_names(self, classes: int | None) -> None:
        # A DETR has an extra class for "no object".
        spare = 1 if self.layout in (Layout.DETR, Layout.RF_DETR) else 0
        if classes is not None and self.names and max(self.names) >= classes + spare:
            raise FileFormatError(f"it has {classes} classes, but {len(self.names)} names")


def _names(text: str | None, path: Path) -> dict[int, str]:
    """Read the class names from a file's metadata: a dict or list in Python notation, as Ultralytics writes it."""
    if text is None:
        return {}
    value = _literal(text)
    if isinstance(value, list | tuple):
        value = dict(enumerate(value))
    if not isinstance(value, dict) or not all(
        isinstance(k, int) and not isinstance(k, bool) and k >= 0 and isinstance(v, str) for k, v in value.items()
    ):
        raise FileFormatError(f"{path}: the names in its metadata can't be read ({text[:60]!r}): give names=")
    return dict(value)


def _given(names: Sequence[str] | Mapping[int, str] | Path | str) -> dict[int, str]:
    if isinstance(names, str | Path):
        try:
            lines = read_text(names, "the names", MAX_TEXT).splitlines()
        except FileFormatError as error:
            raise UsageError(f"names is {str(names)!r} and can't be read as a text file: {error}") from error
        names = [line.strip() for line in lines if line.strip()]
    pairs: dict[Any, Any] = dict(names) if isinstance(names, Mapping) else dict(enumerate(names))
    sound = all(isinstance(k, int) and k >= 0 and isinstance(v, str) and v for k, v in pairs.items())
    if not pairs or not sound:
        raise UsageError(f"names is {names!r} and must be a list of names, a mapping from numbers, or a text file")
    return pairs


def _literal(text: str | None) -> Any:
    """Parse a value in Python notation; None if it is malformed or too long."""
    if text is None or len(text) > 1_000_000:
        return None
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return None


def _is_pair(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(e, int) and e > 0 for e in value)


def _check_size(size: Any) -> None:
    if not _is_pair(size) or not all(32 <= each <= _MOST_SIDE and math.isfinite(each) for each in size):
        raise UsageError(f"size is {size!r} and must be width and height in pixels, 32 to {_MOST_SIDE} each")


def _shape(shape: Sequence[Any]) -> str:
    return "×".join(str(each) for each in shape)
