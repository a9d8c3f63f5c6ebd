"""OpenCV, which the simulator's pictures need, with a clear word where it is not installed."""

from __future__ import annotations

from skyloop.errors import MissingExtraError

try:
    import cv2
except ImportError as error:
    raise MissingExtraError("the simulator", "sim", cause=str(error)) from error

__all__ = ["cv2"]
