"""Computer vision: detection of markers, gates, colours and objects, tracking, optical flow, lenses and calibration.

Requires the extra ``vision``, and ``detect`` for detectors. OpenCV and ONNX Runtime are imported on first use.
"""

from skyloop.vision.appearance import LongTermTracker
from skyloop.vision.calibrating import Board, BoardFinder, BoardView, Collector, calibrate
from skyloop.vision.flow import GroundTracker
from skyloop.vision.gates import BlobDetector, BlobSighting, GateDetector, GateSighting, PoleDetector, PoleSighting
from skyloop.vision.lens import project, undistort, unproject
from skyloop.vision.object_tracks import Detection, ObjectDetector, ObjectTracks, TrackedObject
from skyloop.vision.onnx_detector import Layout, OnnxDetector
from skyloop.vision.planar import MarkerDetector, MarkerSighting, PlanarSighting
from skyloop.vision.simulated import simulated_detector
from skyloop.vision.tracking import CorrelationTracker, LearnedTracker, MedianFlowTracker, Tracker, TrackResult

__all__ = [
    "BlobDetector",
    "BlobSighting",
    "Board",
    "BoardFinder",
    "BoardView",
    "Collector",
    "CorrelationTracker",
    "Detection",
    "GateDetector",
    "GateSighting",
    "GroundTracker",
    "Layout",
    "LearnedTracker",
    "LongTermTracker",
    "MarkerDetector",
    "MarkerSighting",
    "MedianFlowTracker",
    "ObjectDetector",
    "ObjectTracks",
    "OnnxDetector",
    "PlanarSighting",
    "PoleDetector",
    "PoleSighting",
    "TrackResult",
    "TrackedObject",
    "Tracker",
    "calibrate",
    "project",
    "simulated_detector",
    "undistort",
    "unproject",
]
