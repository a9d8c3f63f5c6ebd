"""Skyloop's own detector: people, cars and crates as the simulator draws them, and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from skyloop.vision.onnx_detector import OnnxDetector

#: Its network: 320×256 pixels, classes ``person``, ``car`` and ``box``. ``scripts/train_detector.py`` made it.
SIMULATED_WEIGHTS: Final = Path(__file__).with_name("weights") / "figures.onnx"


def simulated_detector(*, score: float = 0.4, iou: float = 0.5, threads: int = 1) -> OnnxDetector:
    """Return a detector of the simulator's figures: ``person``, ``car``, and ``box`` for a crate.

    It was trained only on rendered images and is useless on a real drone's.

    Args:
        score: Drop detections with a lower score, 0 to 1.
        iou: Merge boxes of one class that overlap more, 0 to 1.
        threads: CPU threads per image.

    Raises:
        MissingExtraError: ONNX Runtime or OpenCV is not installed.
        UsageError: An argument is out of its range.
    """
    return OnnxDetector(SIMULATED_WEIGHTS, score=score, iou=iou, threads=threads)
