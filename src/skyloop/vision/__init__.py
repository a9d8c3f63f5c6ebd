"""Computer vision: markers, gates, colours, trackers of a box, detectors, optical flow, lenses and calibration.

Needs the extra ``vision``, detectors ``detect``; OpenCV and ONNX Runtime are imported when they are first used.
"""

from skyloop.vision.board import Board, BoardFinder, BoardView
from skyloop.vision.calibrating import Collector, calibrate
from skyloop.vision.colour import BlobDetector, BlobSighting
from skyloop.vision.detection import Detection, ObjectDetector
from skyloop.vision.detector_layouts import Layout
from skyloop.vision.flow import GroundTracker
from skyloop.vision.gates import GateDetector, GateSighting
from skyloop.vision.learned import LearnedTracker
from skyloop.vision.lens import project, undistort, unproject
from skyloop.vision.long_term import LongTermTracker
from skyloop.vision.markers import MarkerDetector, MarkerSighting
from skyloop.vision.median_flow import MedianFlowTracker
from skyloop.vision.object_tracks import ObjectTracks, TrackedObject
from skyloop.vision.onnx_detector import OnnxDetector
from skyloop.vision.planar import PlanarSighting
from skyloop.vision.poles import PoleDetector, PoleSighting
from skyloop.vision.simulated import simulated_detector
from skyloop.vision.trackers import CorrelationTracker
from skyloop.vision.tracking import Tracker, TrackResult

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
