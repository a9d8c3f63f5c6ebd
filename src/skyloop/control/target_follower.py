"""Follow any target: the content of a box in the image, or any object of a class.

:class:`TargetFollower` finds the target in frames and computes the set-points; it has no thread or clock.
:class:`FollowTarget`, or a page, gives it frames and feedback and sends the set-points.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from skyloop.clock import seconds
from skyloop.control.airframe import AirframeLaw, Part, not_ahead
from skyloop.control.behaviour import Behaviour, camera_info
from skyloop.control.chase_law import LOSSES, ChaseLaw, ChaseSettings, FollowMode, TargetPhase
from skyloop.control.limiting import Array
from skyloop.control.target_estimate import Camera, TargetEstimator, Traits, predicted_box
from skyloop.control.target_finder import Sighting, TargetFinder
from skyloop.errors import UsageError
from skyloop.messages import Attitude, CameraInfo, Feedback, Points, Polyline, Text, Velocity
from skyloop.messages.relayed import Colour, Shape
from skyloop.poses import mounting_rotation
from skyloop.vision.object_tracks import Detection, ObjectDetector
from skyloop.vision.tracking import Box, outline

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.client.results import Result


_SEEN: Final[Colour] = (64, 220, 100)
_LOST: Final[Colour] = (255, 180, 60)
_OTHER: Final[Colour] = (150, 150, 150)
_TRACE_S: Final = 4.0  # duration of the drawn track
_TRACE_EACH_S: Final = 0.2  # interval between points of the drawn track
_FEET_M: Final = 0.08  # distance of the feet below the body's centre; heights are measured from the feet


@dataclass(frozen=True, slots=True)
class FollowStatus:
    """The state of a pursuit."""

    phase: str
    mode: FollowMode
    box: Box | None  #: box of the target in the newest frame [px]; None if the frame does not show it
    confidence: float | None  #: confidence, 0 to 1; see :attr:`skyloop.control.target_finder.Sighting.confidence`
    class_name: str | None
    predicted_px: tuple[float, float] | None = None  #: expected position of the target's middle in the newest frame
    range_m: float | None = None  #: horizontal distance from the camera
    range_deviation_m: float | None = None
    bearing_rad: float | None = None  #: angle to the target, counter-clockwise from straight ahead
    speed_m_s: float | None = None  #: speed of the target; None if the vehicle does not know its own
    lost_s: float = 0.0  #: time since the last sighting; 0 while the target is in sight and before the first sighting
    problem: str = ""  #: why following as wanted is not possible; empty if it is
    unknown: str = ""  #: unknown part of the vehicle's motion, which makes it hover whatever the set-point


class TargetFollower(AirframeLaw):
    """Follows a target. Call it from one thread."""

    def __init__(
        self,
        camera: CameraInfo,  # the camera, including its mounting; it must look forward
        *,
        box: Box | None = None,  # box of the target in the first frame given to :meth:`look`: x, y, width, height [px]
        # class of which to follow the largest object if there is no box; needs detections
        class_name: str | None = None,
        mode: FollowMode = FollowMode.FOLLOW,  # how to follow
        detector: ObjectDetector | None = None,  # detector to run on every frame on the thread that calls :meth:`look`
        detects: bool = False,  # whether detections arrive from elsewhere through :meth:`detected`
        traits: Traits | None = None,  # prior knowledge about the target; None for that of its class
        settings: ChaseSettings | None = None,  # settings of the law; None for the defaults
    ) -> None:
        """Initialise the follower; UsageError without a target, or for a camera that does not look forward."""
        if mounting_rotation(camera)[0, 2] < 0.5:
            raise UsageError(f"camera {camera.name!r} does not look forward, as following needs")
        if box is None and class_name is None:
            raise UsageError("a target needs a box in the image, or the name of a class that the detector knows")
        if box is None and detector is None and not detects:
            raise UsageError(f"following any {class_name!r} needs a detector: give detector=…, or a box")
        if box is not None and not all(np.isfinite(part) for part in box):
            raise UsageError(f"the box is {box!r} and must consist of finite numbers")
        super().__init__(Part.ATTITUDE, Part.VELOCITY)
        self._law = ChaseLaw(settings, FollowMode(mode))
        self._camera = camera
        self._detector = detector
        self._box, self._class_name, self._traits = box, class_name, traits
        self.finder: TargetFinder | None = None  #: None before the first frame
        self._seen_ns: int | None = None  # capture time of the last frame that showed, or may have shown, the target
        self.sighting = Sighting(None, None)  #: the result of searching the newest frame
        self._view: Camera | None = None  # camera of the newest frame
        self._frame_ns: int | None = None
        self._trace: deque[tuple[int, Array]] = deque()

    @property
    def settings(self) -> ChaseSettings:
        """Goal, gains and limits. Can be replaced in flight."""
        return self._law.settings

    @settings.setter
    def settings(self, settings: ChaseSettings) -> None:
        self._law.settings = settings

    @property
    def mode(self) -> FollowMode:
        """How to follow the target. Can be changed in flight."""
        return self._law.mode

    @mode.setter
    def mode(self, mode: FollowMode) -> None:
        self._law.mode = FollowMode(mode)

    @property
    def phase(self) -> TargetPhase:
        """Phase at the last set-point."""
        return self._law.phase

    @property
    def over(self) -> bool:
        """Whether the follower has given up."""
        return self.phase is TargetPhase.GIVEN_UP

    def feedback(self, feedback: Feedback) -> None:
        """Update with the vehicle's newest state."""
        if self.finder is None:
            self.airframe.by_tilt = feedback.velocity_m_s is None
        super().feedback(feedback)
        if not self._relative and self.airframe.feedback is not None:
            self._law.feedback(self.airframe.feedback)

    def pause(self) -> None:
        """Restart the set-points from rest and keep the target."""
        super().pause()
        self._law.pause()

    @property
    def _relative(self) -> bool:
        """Whether the vehicle reports no velocity and is flown by attitude."""
        return self.airframe.by_tilt

    def look(self, frame: Frame) -> list[Shape]:
        """Find the target in the next frame, from the given box on; return the box, track and phase to draw.

        The first box must fit into the image, and the camera's intrinsics must be known, or this raises UsageError.
        """
        state, newest = frame.feedback, self.airframe.feedback
        if newest is not None and not_ahead(frame.captured_ns, newest.captured_ns) is None:
            state = None  # the frame is stamped ahead or there is no recent feedback, so the pose is unknown
        # A vehicle without a known velocity hovers at its last position.
        motion = self.airframe.at(frame.captured_ns) or self.airframe.newest
        if state is None or motion is None:
            return [Text("the vehicle's attitude is not known yet", (8.0, 16.0), _LOST)]
        if frame.intrinsics is None:
            raise UsageError(f"camera {self._camera.name!r} has no intrinsics: calibrate it (skyloop camera calibrate)")
        ground = state.altitude_m is not None
        body = motion.position.copy()
        if state.altitude_m is not None:
            body[2] = state.altitude_m + _FEET_M
        rates = (0.0, 0.0)
        if state.angular_velocity_rad_s is None and state.yaw_rad is not None:
            # Without a gyroscope, the attitude arrives rarely and images are stamped on arrival.
            rates = motion.yaw_rate, self.airframe.tilt_rate_rad_s
            if frame.captured_ns > state.captured_ns:
                state = msgspec.structs.replace(state, yaw_rad=motion.yaw)
        size = (frame.shape[1], frame.shape[0])
        risen_m = None if self._relative else float(motion.position[2])
        view = Camera.at(self._camera, state, body, frame.intrinsics, size, rates, risen_m)
        if view is None:
            return [Text("the vehicle's attitude is not known yet", (8.0, 16.0), _LOST)]
        if self.finder is None:
            self.finder = TargetFinder(
                box=self._box,
                class_name=self._class_name,
                traits=self._traits,
                nominal_m=self.settings.distance_m,
                relative=self._relative,
            )
        found = None if self._detector is None else self._detector.detect(frame)
        self._view, self._frame_ns = view, frame.captured_ns
        self.sighting = self.finder.see(frame, view, frame.captured_ns, ground=ground, detections=found)
        if self.sighting.box is not None or self.sighting.contested:
            self._seen_ns = frame.captured_ns
        return self._drawing(frame.captured_ns)

    def detected(self, detections: Sequence[Detection], captured_ns: int) -> None:
        """Use a processor's detections for a recent frame, which arrive after that frame."""
        if self.finder is not None:
            ground = self.airframe.feedback is not None and self.airframe.feedback.altitude_m is not None
            if self.finder.detected(detections, captured_ns, ground=ground):
                self._seen_ns = max(captured_ns, self._seen_ns or 0)

    def step(self, now_ns: int) -> Velocity | Attitude:
        """Compute the set-point for now [ns on the proxy's clock], or hold the vehicle while its motion is unknown.

        A vehicle that does not report its velocity is flown by attitude.
        """
        if not self._ready(now_ns):
            return Attitude() if self._relative else Velocity()
        self._since_s(now_ns)
        self._seen_ns = not_ahead(self._seen_ns, now_ns)
        finder = self.finder
        return self._law.step(
            now_ns,
            self._motion(now_ns),
            self._altitude,
            self._estimator,
            self._seen_ns,
            () if finder is None else finder.others(now_ns),
            candidate=None if finder is None else finder.candidate(now_ns),
            relative=self._relative,
            position=self.airframe.position_m(now_ns),
        )

    @property
    def _estimator(self) -> TargetEstimator | None:
        return None if self.finder is None else self.finder.estimator

    @property
    def status(self) -> FollowStatus:
        """The state of the pursuit at the newest frame and set-point."""
        estimator, at_ns = self._estimator, self._frame_ns
        box, confidence = self.sighting.box, self.sighting.confidence
        class_name = self._class_name if self.finder is None else self.finder.class_name
        known = FollowStatus(self.phase.value, self.mode, box, confidence, class_name, unknown=self.problem)
        if estimator is None or at_ns is None or self._view is None:
            return known
        state = estimator.at(at_ns)
        away = state.foot[:2] - self._view.position[:2]
        ahead = self._view.rotation[:, 2]
        return replace(
            known,
            predicted_px=self._view.pixel(state.middle),
            range_m=float(np.hypot(*away)),
            range_deviation_m=state.range_deviation_m,
            bearing_rad=float(np.arctan2(ahead[0] * away[1] - ahead[1] * away[0], ahead[:2] @ away)),
            speed_m_s=None if self._relative else float(np.hypot(*state.velocity)),
            lost_s=0.0 if box is not None or self._seen_ns is None else seconds(at_ns - self._seen_ns),
            problem=self._problem(),
        )

    def _problem(self) -> str:
        if self.problem:
            return self.problem
        if self.sighting.contested:
            return "a look-alike is at its expected position"
        return "at the end of the leash" if self._law.held_by else ""

    def _drawing(self, captured_ns: int) -> list[Shape]:
        assert self.finder is not None
        view, estimator = self._view, self.finder.estimator
        assert view is not None
        box = self.sighting.box
        colour = _SEEN if box is not None else _LOST
        # A processor draws its own detections on their frames.
        found = () if self._detector is None else self.finder.detections[:16]
        shapes: list[Shape] = [Polyline(one.outline, True, _OTHER) for one in found if box is None or one.box != box]
        if estimator is None:
            return [*shapes, Text(self.phase.value, (8.0, 16.0), colour)]
        state = estimator.at(captured_ns)
        if not self._trace or seconds(captured_ns - self._trace[-1][0]) >= _TRACE_EACH_S:
            self._trace.append((captured_ns, state.foot))
        while self._trace and seconds(captured_ns - self._trace[0][0]) > _TRACE_S:
            self._trace.popleft()
        trace = [pixel for _, foot in self._trace if (pixel := view.pixel(foot)) is not None]
        if len(trace) > 1 and not self._relative:
            shapes.append(Polyline(tuple(trace), False, colour))
        if box is not None:
            shapes.append(Polyline(outline(box), True, colour))
        elif self.phase in LOSSES:
            expected = predicted_box(view, state.foot, state.height_m)
            if expected is not None:
                shapes.append(Polyline(outline(expected), True, _LOST))
        middle = view.pixel(state.middle)
        if middle is not None:
            shapes.append(Points((middle,), colour))
        sure = "" if self.sighting.confidence is None else f" {self.sighting.confidence:.0%}"
        name = self.finder.class_name or "target"
        text = f"{name}{sure}  {self.phase.value}  {state.range_m:.1f} ± {state.range_deviation_m:.1f} m"
        return [*shapes, Text(text, (8.0, 16.0), colour)]


class FollowTarget(Behaviour):
    """Keeps a target in view at a distance, circles it, or only turns towards it. The vehicle must be airborne.

    The target is the content of a box in the first frame, or the largest object of a class. It is tracked by appearance
    and, with a detector, by its detections, and is not confused with look-alikes. While it is hidden, the vehicle first
    follows its predicted motion, then hovers, then looks around. After ``give_up_s`` the behaviour ends in a hover. The
    vehicle needs neither a position nor a map. A vehicle that reports no velocity is flown by attitude.

    Attributes:
        follower: Finds the target and computes the set-points.
    """

    name = "follow target"
    losses = LOSSES

    def __init__(
        self,
        drone: Drone,
        box: Sequence[float] | None = None,
        *,
        class_name: str | None = None,
        distance_m: float | None = None,
        bearing_rad: float | None = None,
        mode: FollowMode | str = FollowMode.FOLLOW,
        detector: ObjectDetector | str | None = None,
        height_m: float | None = None,
        traits: Traits | None = None,
        camera: str | None = None,
        settings: ChaseSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly.
            box: Box of the target in the first frame: x, y, width, height [px].
            class_name: Class of which to follow the largest object if there is no box. Needs a detector.
            distance_m: Horizontal distance to keep; None for that of the settings.
            bearing_rad: Side of the target to stay on, as seen from it, counter-clockwise from its direction of motion:
                0 is ahead of it, π behind. None for any side, or for that of the settings.
            mode: ``follow``, ``orbit`` or ``look``.
            detector: Detector that searches every frame, or the name of a processor whose results are detections, such
                as that of ``skyloop detect``. None tracks the target by appearance only.
            height_m: The target's height, if known, to estimate its distance; otherwise its class determines the
                height. With neither, the drone only turns until its own motion has revealed the range.
            traits: Complete prior knowledge about the target, instead of ``height_m``.
            camera: Camera to use; None for the vehicle's first camera.
            settings: Settings of the law; None for the defaults. Clamped to the drone's ``limits.*``.

        Raises:
            UnknownNameError: There is no such camera.
            UsageError: There is neither a box nor a class, the camera does not look forward, a number is out of its
                range, or the vehicle neither reports velocity nor accepts attitude set-points.
            MissingExtraError: OpenCV or, for detections, SciPy is not installed.
        """
        given = {"distance_m": distance_m, "bearing_rad": bearing_rad}
        chosen = replace(settings or ChaseSettings(), **{k: v for k, v in given.items() if v is not None})
        chosen = chosen.within(dict(drone.config.items()))
        if height_m is not None:
            traits = replace(traits or Traits(), height_m=height_m, height_share=0.05)
        if mode not in list(FollowMode):
            raise UsageError(f"mode is {mode!r} and must be one of {', '.join(FollowMode)}")
        if detector is not None and not isinstance(detector, str | ObjectDetector):
            raise UsageError(f"detector is {detector!r} and needs a detect(image) method, or must name a processor")
        self.follower = TargetFollower(
            camera_info(drone, camera),
            box=None if box is None else _box(box),
            class_name=class_name,
            mode=FollowMode(mode),
            detector=None if isinstance(detector, str) else detector,
            detects=isinstance(detector, str),
            traits=traits,
            settings=chosen,
        )
        self.processors = (detector,) if isinstance(detector, str) else ()
        super().__init__(drone, self.follower, camera)

    @property
    def phase(self) -> TargetPhase:
        """The current phase."""
        return self.follower.phase

    @property
    def status(self) -> FollowStatus:
        """The state of the pursuit at the newest frame."""
        return self.follower.status

    def look(self, frame: Frame) -> list[Shape]:
        """Find the target."""
        return self.follower.look(frame)

    def on_frame(self, frame: Frame) -> None:
        """Find the target and steer. After ``give_up_s``, hover and let :meth:`run` return."""
        super().on_frame(frame)
        if self.follower.over and not self.done:
            self.finish("gave up: the target was lost for too long")

    def on_result(self, result: Result) -> None:
        """Use a processor's detections in frames from this behaviour's camera; ignore those from other cameras."""
        if result.camera == self._mounting.name:
            self.follower.detected(detections_of(result.value), result.captured_ns)


def _box(box: Sequence[float]) -> Box:
    try:
        x, y, width, height = (float(part) for part in box)
    except (TypeError, ValueError):
        raise UsageError(f"the box is {box!r} and must be x, y, width and height in pixels") from None
    return x, y, width, height


def detections_of(value: Any) -> list[Detection]:
    """Return the detections in a result of ``skyloop detect``, skipping malformed ones."""
    found = []
    given = value.get("detections") if isinstance(value, dict) else None
    for one in given if isinstance(given, list | tuple) else ():
        try:
            x, y, width, height = (float(part) for part in one["box"])
            score, class_id = float(one["score"]), int(one["class_id"])
            name = str(one["class_name"])
        except (KeyError, TypeError, ValueError, OverflowError):
            continue
        if all(map(math.isfinite, (x, y, width, height, score))) and min(width, height) > 0.0:
            found.append(Detection((x, y, width, height), score, class_id, name))
    return found
