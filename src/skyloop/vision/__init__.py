"""Computer vision: markers, gates, colours, trackers of a box, optical flow of the ground, lenses and calibration.

Needs the extra ``vision``; OpenCV is imported when it is first used.
"""

from skyloop.vision.board import Board, BoardFinder, BoardView
from skyloop.vision.calibrating import Collector, calibrate
from skyloop.vision.colour import BlobDetector, BlobSighting
from skyloop.vision.correlation import CorrelationTracker
from skyloop.vision.flow import GroundTracker
from skyloop.vision.gates import GateDetector, GateSighting
from skyloop.vision.learned import LearnedTracker
from skyloop.vision.lens import project, undistort, unproject
from skyloop.vision.long_term import LongTermTracker
from skyloop.vision.markers import MarkerDetector, MarkerSighting
from skyloop.vision.median_flow import MedianFlowTracker
from skyloop.vision.planar import PlanarSighting
from skyloop.vision.tracking import Tracker, TrackResult

__all__ = [
    "BlobDetector",
    "BlobSighting",
    "Board",
    "BoardFinder",
    "BoardView",
    "Collector",
    "CorrelationTracker",
    "GateDetector",
    "GateSighting",
    "GroundTracker",
    "LearnedTracker",
    "LongTermTracker",
    "MarkerDetector",
    "MarkerSighting",
    "MedianFlowTracker",
    "PlanarSighting",
    "TrackResult",
    "Tracker",
    "calibrate",
    "project",
    "undistort",
    "unproject",
]
