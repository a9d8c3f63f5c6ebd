"""Detectors of the YOLO and DETR families, loaded from a user's ONNX file and run on the CPU by ONNX Runtime."""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError, UsageError
from skyloop.files import MAX_TEXT, read_text
from skyloop.vision.detector_layouts import (
    RAW_BGR,
    STRETCHED,
    SUPPRESSED,
    Found,
    Layout,
    class_count,
    decode,
    layout_named,
    tell_layout,
)
from skyloop.vision.object_tracks import Detection, suppress
from skyloop.vision.onnx import load_network, reason
from skyloop.vision.opencv import opencv
from skyloop.vision.planar import pixels_of
from skyloop.vision.tracking import Image

_GREY: Final = 114  # padding of letterboxed images, as YOLO networks are trained with
_MEAN: Final = np.array([0.485, 0.456, 0.406], np.float32).reshape(3, 1, 1)  # ImageNet's mean, for RF-DETR
_DEVIATION: Final = np.array([0.229, 0.224, 0.225], np.float32).reshape(3, 1, 1)
_SIDE: Final = 640  # default side for a network that takes any size
_MOST_SIDE: Final = 4096  # maximum side of an input image [px]
_MOST: Final = 1000  # number of best boxes to compare with one another
_TYPES: Final = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class OnnxDetector:
    """Runs a YOLO or DETR network, recognised by its outputs, as a detector. Call it from one thread.

    Attributes:
        layout: Layout of the network's outputs.
        names: Class names by number.
        size: Width and height of the network's input [px].
        dropped: Number of detections dropped for values that were not finite or a score outside 0 to 1.
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
            names: Class names: a list, a mapping from numbers, or a text file with one per line. None uses those in the
                file's metadata, as Ultralytics writes them, or the numbers.
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
        """Return the image fitted to the input size, its scale and its corner, the last two as x and y."""
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
            if other.name != self._input:  # RT-DETR with its postprocessor takes the image size for its boxes
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
            raise FileFormatError(f"{self._path} has the inputs {shown} and must have one, an image")
        first = inputs[0]
        shape = list(first.shape)
        if len(shape) != 4 or first.type not in _TYPES or (shape[1] not in (3, None) and not isinstance(shape[1], str)):
            raise FileFormatError(
                f"{self._path} has the input {shown} and must have (1, 3, height, width) of float, float16 or uint8"
            )
        if isinstance(shape[0], int) and shape[0] != 1:
            raise FileFormatError(f"{self._path} takes {shape[0]} images at a time: export it for one")
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
