"""The detector that is part of Skyloop: of people, cars and crates as the simulator draws them, and of nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from skyloop.vision.onnx_detector import OnnxDetector

#: Its network: 320×256 pixels, classes ``person``, ``car`` and ``box``. ``scripts/train_detector.py`` made it.
SIMULATED_WEIGHTS: Final = Path(__file__).with_name("weights") / "figures.onnx"


def simulated_detector(*, score: float = 0.4, iou: float = 0.5, threads: int = 1) -> OnnxDetector:
    """Return a detector of the simulator's figures: ``person``, ``car``, and ``box`` for a crate.

    It was trained with drawn pictures alone and is of no use on a real drone's.

    Args:
        score: Detections that are less sure are dropped, 0 to 1.
        iou: Boxes of one class that overlap more are one detection, 0 to 1.
        threads: Of the processor for one image.

    Raises:
        MissingExtraError: ONNX Runtime or OpenCV is not installed.
        UsageError: An argument is out of its range.
    """
    return OnnxDetector(SIMULATED_WEIGHTS, score=score, iou=iou, threads=threads)
