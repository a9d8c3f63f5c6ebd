"""Computer vision: markers, gates, colours, optical flow of the ground, lens models and camera calibration.

Needs the extra ``vision``; OpenCV is imported when it is first used.
"""

from skyloop.vision.board import Board, BoardFinder, BoardView
from skyloop.vision.calibrating import Collector, calibrate
from skyloop.vision.colour import BlobDetector, BlobSighting
from skyloop.vision.flow import GroundTracker
from skyloop.vision.gates import GateDetector, GateSighting
from skyloop.vision.lens import project, undistort, unproject
from skyloop.vision.markers import MarkerDetector, MarkerSighting
from skyloop.vision.planar import PlanarSighting

__all__ = [
    "BlobDetector",
    "BlobSighting",
    "Board",
    "BoardFinder",
    "BoardView",
    "Collector",
    "GateDetector",
    "GateSighting",
    "GroundTracker",
    "MarkerDetector",
    "MarkerSighting",
    "PlanarSighting",
    "calibrate",
    "project",
    "undistort",
    "unproject",
]
