"""Seeing: marker detection and pose. Needs the extra ``vision``; OpenCV is imported when something is detected."""

from skyloop.vision.markers import MarkerDetector, MarkerSighting

__all__ = ["MarkerDetector", "MarkerSighting"]
