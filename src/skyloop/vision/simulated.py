"""Skyloop's own detector for people, cars and crates as the simulator draws them, and for nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from skyloop.vision.onnx_detector import OnnxDetector

#: The detector's network (320×256 px, classes ``person``, ``car``, ``box``), made by ``scripts/train_detector.py``.
SIMULATED_WEIGHTS: Final = Path(__file__).with_name("weights") / "figures.onnx"


def simulated_detector(*, score: float = 0.4, iou: float = 0.5, threads: int = 1) -> OnnxDetector:
    """Return a detector for the simulator's figures: ``person``, ``car``, and ``box`` for a crate.

    It was trained on rendered images only and is useless on images from a real drone.

    Args:
        score: Minimum score of a detection, 0 to 1.
        iou: Merge boxes of one class that overlap by more than this, 0 to 1.
        threads: CPU threads per image.

    Raises:
        MissingExtraError: ONNX Runtime or OpenCV is not installed.
        UsageError: An argument is out of its range.
    """
    return OnnxDetector(SIMULATED_WEIGHTS, score=score, iou=iou, threads=threads)
