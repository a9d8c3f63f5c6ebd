"""A processor that runs a detector, and draws what it found."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final

from skyloop.client import Frame
from skyloop.messages.relayed import Polyline, Shape, Text
from skyloop.processing.output import Output
from skyloop.vision.detection import Detection, ObjectDetector

MOST: Final = 64  #: detections of one frame that are published, the surest: a result has a limit of 32 768 bytes


class DetectionProcessor:
    """Publishes a detector's findings: ``{"detections": [{"box": …, "score": …, "class_id": …, "class_name": …}, …]}``.

    Each is drawn as a closed outline of four corners, and a text with its class and score.
    """

    def __init__(self, detector: ObjectDetector, classes: Collection[str] = ()) -> None:
        """Keep the detector.

        Args:
            detector: Called on the worker's thread.
            classes: Names of the classes that are published; none: all.
        """
        self._detector = detector
        self._classes = frozenset(classes)

    def process(self, frame: Frame) -> Output:
        """Detect in one frame."""
        found = [one for one in self._detector.detect(frame) if not self._classes or one.class_name in self._classes]
        found = found[:MOST]
        return Output({"detections": [_value(one) for one in found]}, [s for one in found for s in _shapes(one)])


def _value(one: Detection) -> dict[str, Any]:
    name = one.class_name[:64]
    return {"box": list(one.box), "score": one.score, "class_id": one.class_id, "class_name": name}


def _shapes(one: Detection) -> tuple[Shape, ...]:
    x, y, _, _ = one.box
    return Polyline(one.outline, closed=True), Text(f"{one.class_name[:64]} {one.score:.2f}", (x, y))
