"""OpenCV's learned trackers, with weights that the user gives.

ViTTrack (``cv2.TrackerVit``) is one ONNX file, NanoTrack (``cv2.TrackerNano``) two: backbone, and neck and head.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from skyloop.errors import FileFormatError, UnsupportedError, UsageError
from skyloop.messages.geometry import within
from skyloop.vision import onnx
from skyloop.vision.opencv import opencv
from skyloop.vision.tracking import Box, Image, Tracker, TrackResult


class LearnedTracker(Tracker):
    """Tracks by a neural network, through OpenCV, on the processor. The score is the network's own.

    The weights are not part of Skyloop: the OpenCV Zoo offers ``object_tracking_vittrack_2023sep.onnx``, the repository
    of NanoTrack its two files.
    """

    def __init__(self, weights: Path | str, head: Path | str | None = None, *, lost_below: float = 0.3) -> None:
        """Load the weights.

        Args:
            weights: ONNX file of ViTTrack or, with ``head``, of NanoTrack's backbone.
            head: ONNX file of NanoTrack's neck and head.
            lost_below: Score below which the target is lost.

        Raises:
            MissingExtraError: OpenCV is not installed.
            UnsupportedError: This OpenCV was built without that tracker.
            UsageError: A file is not there.
            FileFormatError: A file is not the weights of that tracker, or takes too much to load (tried in a child
                process, as in :func:`skyloop.vision.onnx.load_network`).
        """
        self._cv: Any = opencv("tracking")
        self._lost_below = lost_below
        name = "TrackerVit" if head is None else "TrackerNano"
        if not (hasattr(self._cv, f"{name}_create") and hasattr(self._cv, f"{name}_Params")):
            raise UnsupportedError(
                f"this OpenCV, {self._cv.__version__}, has no {name}: install opencv-python-headless 4.10 or newer"
            )
        self._name, files = name, [_existing(path) for path in (weights, head) if path is not None]
        self._given = ", ".join(files)
        onnx.try_alone(*files, tracker=name)
        try:
            self._tracker: Any = onnx.load_tracker(self._cv, name, files)
        except self._cv.error as error:
            raise FileFormatError(
                f"{self._given} can't be loaded as the weights of {name}: {onnx.reason(error)}"
            ) from error

    def _start(self, image: Image, box: Box) -> None:
        x, y, width, height = (round(part) for part in box)
        self._call("init", self._coloured(image), (x, y, width, height))

    def _update(self, image: Image) -> TrackResult:
        _, found = self._call("update", self._coloured(image))
        score = within(float(self._tracker.getTrackingScore()), 0.0, 1.0)
        x, y, width, height = (float(part) for part in found)
        lost = score < self._lost_below or width <= 0 or height <= 0
        return TrackResult(None if lost else (x, y, width, height), score)

    def _call(self, method: str, *arguments: Any) -> Any:
        """Call OpenCV's tracker; a file with another network often loads, and fails here."""
        try:
            return getattr(self._tracker, method)(*arguments)
        except self._cv.error as error:
            raise FileFormatError(
                f"{self._given} does not work as the weights of {self._name}: {onnx.reason(error)}"
            ) from error

    def _coloured(self, image: Image) -> Any:
        return image if image.ndim == 3 else self._cv.cvtColor(image, self._cv.COLOR_GRAY2BGR)


def _existing(path: Path | str) -> str:
    if not Path(path).is_file():
        raise UsageError(f"there is no file {path}: give the ONNX file with the tracker's weights")
    return str(path)
