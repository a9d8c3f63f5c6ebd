"""Controllers: the base class for an application's control loop, ready-made behaviours, and their building blocks."""

from skyloop.control.approach import ApproachMarker, LandOnMarker, OrbitMarker, OrbitPlace
from skyloop.control.behaviour import Behaviour
from skyloop.control.chase_law import ChaseSettings, FollowMode
from skyloop.control.controller import Controller, RunSummary
from skyloop.control.follow import FollowMarker
from skyloop.control.gates import FIVE_GATES, RACE_GATES, RACE_TRACK, Course, FlyThroughGates, GateKind, course_in
from skyloop.control.image_servo import FlowHover, ImageServo
from skyloop.control.onnx_policy import OnnxPolicy, PolicyNetwork, PolicyPhase
from skyloop.control.path import Circle, FunctionPath, Lemniscate, Path, Polyline, Spline
from skyloop.control.path_law import (
    AlongPath,
    FixedYaw,
    FollowPath,
    LookAt,
    PathLaw,
    PathSettings,
    TrackingError,
    Waypoints,
    YawMode,
)
from skyloop.control.route import Finding, Look, Photo, Route, RouteCheck, RouteWaypoint, Wait, load_route, save_route
from skyloop.control.route_law import FlyRoute
from skyloop.control.target_follower import FollowTarget
from skyloop.control.waypoint import DeadReckoning, Fix, PositionSource, Waypoint

__all__ = [
    "AlongPath",
    "ApproachMarker",
    "Behaviour",
    "ChaseSettings",
    "Circle",
    "Controller",
    "Course",
    "DeadReckoning",
    "FIVE_GATES",
    "Finding",
    "Fix",
    "FixedYaw",
    "FlowHover",
    "FlyThroughGates",
    "FlyRoute",
    "FollowMarker",
    "FollowMode",
    "FollowPath",
    "FollowTarget",
    "FunctionPath",
    "GateKind",
    "ImageServo",
    "LandOnMarker",
    "Lemniscate",
    "Look",
    "LookAt",
    "OnnxPolicy",
    "OrbitMarker",
    "OrbitPlace",
    "Path",
    "PathLaw",
    "PathSettings",
    "Photo",
    "Polyline",
    "PolicyNetwork",
    "PolicyPhase",
    "PositionSource",
    "RACE_GATES",
    "RACE_TRACK",
    "Route",
    "RouteCheck",
    "RouteWaypoint",
    "RunSummary",
    "Spline",
    "TrackingError",
    "Wait",
    "Waypoint",
    "Waypoints",
    "YawMode",
    "course_in",
    "load_route",
    "save_route",
]
