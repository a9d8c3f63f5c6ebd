"""Follow any target, given by a box in the image or by a class of objects.

:class:`TargetFollower` finds the target in frames and computes set-points; it uses no thread or clock.
:class:`FollowTarget`, or a page, passes frames and feedback to it and sends the set-points.
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
from skyloop.control.behaviour import LOST, OTHER, SEEN, Behaviour, camera_info
from skyloop.control.chase_law import LOSSES, ChaseLaw, ChaseSettings, FollowMode, TargetPhase
from skyloop.control.limiting import Array
from skyloop.control.target_estimate import CameraPose, TargetEstimator, Traits, predicted_box
from skyloop.control.target_finder import Sighting, TargetFinder
from skyloop.errors import UsageError
from skyloop.messages import Attitude, CameraInfo, Feedback, Points, Polyline, Text, Velocity
from skyloop.messages.relayed import Shape
from skyloop.poses import mounting_rotation
from skyloop.vision.object_tracks import Detection, ObjectDetector
from skyloop.vision.tracking import Box, outline

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.client.results import Result


_TRACE_S: Final = 4.0  # duration of the drawn track
_TRACE_EACH_S: Final = 0.2  # interval between points of the drawn track
_FEET_M: Final = 0.08  # vertical distance from the feet, from which heights are measured, to the body's centre


@dataclass(frozen=True, slots=True)
class FollowStatus:
    """The state of a pursuit."""

    phase: str
    mode: FollowMode
    box: Box | None  #: box of the target in the newest frame [px]; None if the frame does not show it
    confidence: float | None  #: see :attr:`skyloop.control.target_finder.Sighting.confidence`
    class_name: str | None
    predicted_px: tuple[float, float] | None = None  #: expected position of the target's centre in the newest frame
    range_m: float | None = None  #: horizontal distance from the camera to the target
    range_deviation_m: float | None = None
    bearing_rad: float | None = None  #: angle to the target, counter-clockwise from straight ahead
    speed_m_s: float | None = None  #: speed of the target; None if the vehicle does not know its own speed
    lost_s: float = 0.0  #: time since the last sighting; 0 while the target is in view or before the first sighting
    problem: str = ""  #: why the target can't be followed as requested; empty if it can
    unknown: str = ""  #: unknown part of the vehicle's motion, which makes it hover regardless of the set-point


class TargetFollower(AirframeLaw):
    """Follows a target. Call its methods from one thread only."""

    def __init__(
        self,
        camera: CameraInfo,  # the camera, including its mounting; it must face forward
        *,
        box: Box | None = None,  # box of the target in the first frame given to :meth:`look`: x, y, width, height [px]
        # if there is no box, the largest object of this class is followed; requires detections
        class_name: str | None = None,
        mode: FollowMode = FollowMode.FOLLOW,  # how to follow the target
        detector: ObjectDetector | None = None,  # detector for every frame, on the thread that calls :meth:`look`
        detects: bool = False,  # whether detections from elsewhere arrive through :meth:`detected`
        traits: Traits | None = None,  # prior knowledge about the target; None to use the class's
        settings: ChaseSettings | None = None,  # settings for the control law; None for the defaults
    ) -> None:
        """Initialise the follower; raise UsageError if there is no target or the camera does not face forward."""
        if mounting_rotation(camera)[0, 2] < 0.5:
            raise UsageError(f"camera {camera.name!r} does not face forward, as is required for following")
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
        self._view: CameraPose | None = None  # camera of the newest frame
        self._frame_ns: int | None = None
        self._trace: deque[tuple[int, Array]] = deque()

    @property
    def settings(self) -> ChaseSettings:
        """Goals, gains and limits, which can be replaced in flight."""
        return self._law.settings

    @settings.setter
    def settings(self, settings: ChaseSettings) -> None:
        self._law.settings = settings

    @property
    def mode(self) -> FollowMode:
        """How to follow the target, which can be changed in flight."""
        return self._law.mode

    @mode.setter
    def mode(self, mode: FollowMode) -> None:
        self._law.mode = FollowMode(mode)

    @property
    def phase(self) -> TargetPhase:
        """Phase when the last set-point was computed."""
        return self._law.phase

    @property
    def over(self) -> bool:
        """Whether the follower has given up on the target."""
        return self.phase is TargetPhase.GIVEN_UP

    def feedback(self, feedback: Feedback) -> None:
        """Update with the vehicle's newest state."""
        if self.finder is None:
            self.airframe.by_tilt = feedback.velocity_m_s is None
        super().feedback(feedback)
        if not self._relative and self.airframe.feedback is not None:
            self._law.feedback(self.airframe.feedback)

    def pause(self) -> None:
        """Restart the set-points from rest, but keep the target."""
        super().pause()
        self._law.pause()

    @property
    def _relative(self) -> bool:
        """Whether the vehicle reports no velocity and is flown by attitude."""
        return self.airframe.by_tilt

    def look(self, frame: Frame) -> list[Shape]:
        """Find the target in the next frame and return the shapes to draw: its box, its track and the phase.

        Raises UsageError if the first box lies outside the image or the camera's intrinsics are unknown.
        """
        state, newest = frame.feedback, self.airframe.feedback
        if newest is not None and not_ahead(frame.captured_ns, newest.captured_ns) is None:
            state = None  # the frame's time is in the future or there is no recent feedback, so the pose is unknown
        # If the velocity is unknown, the vehicle is hovering, so use its last known position.
        motion = self.airframe.at(frame.captured_ns) or self.airframe.newest
        if state is None or motion is None:
            return [Text("the vehicle's attitude is not known yet", (8.0, 16.0), LOST)]
        if frame.intrinsics is None:
            raise UsageError(f"camera {self._camera.name!r} has no intrinsics: calibrate it (skyloop camera calibrate)")
        ground = state.altitude_m is not None
        body = motion.position.copy()
        if state.altitude_m is not None:
            body[2] = state.altitude_m + _FEET_M
        rates = (0.0, 0.0)
        if state.angular_velocity_rad_s is None and state.yaw_rad is not None:
            # Vehicles without gyroscope data rarely report their attitude, and their images are stamped on arrival.
            rates = motion.yaw_rate, self.airframe.tilt_rate_rad_s
            if frame.captured_ns > state.captured_ns:
                state = msgspec.structs.replace(state, yaw_rad=motion.yaw)
        size = (frame.shape[1], frame.shape[0])
        risen_m = None if self._relative else float(motion.position[2])
        view = CameraPose.at(self._camera, state, body, frame.intrinsics, size, rates, risen_m)
        if view is None:
            return [Text("the vehicle's attitude is not known yet", (8.0, 16.0), LOST)]
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
        """Use detections from a processor, which arrive after the frame they belong to."""
        if self.finder is not None:
            ground = self.airframe.feedback is not None and self.airframe.feedback.altitude_m is not None
            if self.finder.detected(detections, captured_ns, ground=ground):
                self._seen_ns = max(captured_ns, self._seen_ns or 0)

    def step(self, now_ns: int) -> Velocity | Attitude:
        """Compute the current set-point, which makes the vehicle hover while its motion is unknown.

        Vehicles that don't report their velocity are flown by attitude. ``now_ns`` is on the proxy's clock.
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
        """The state of the pursuit as of the newest frame and set-point."""
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
        return "at the end of the leash" if self._law.constraint else ""

    def _drawing(self, captured_ns: int) -> list[Shape]:
        assert self.finder is not None
        view, estimator = self._view, self.finder.estimator
        assert view is not None
        box = self.sighting.box
        colour = SEEN if box is not None else LOST
        # Detections from a processor are not drawn here, because the processor annotates its frames itself.
        found = () if self._detector is None else self.finder.detections[:16]
        shapes: list[Shape] = [Polyline(one.outline, True, OTHER) for one in found if box is None or one.box != box]
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
                shapes.append(Polyline(outline(expected), True, LOST))
        middle = view.pixel(state.middle)
        if middle is not None:
            shapes.append(Points((middle,), colour))
        sure = "" if self.sighting.confidence is None else f" {self.sighting.confidence:.0%}"
        name = self.finder.class_name or "target"
        text = f"{name}{sure}  {self.phase.value}  {state.range_m:.1f} ± {state.range_deviation_m:.1f} m"
        return [*shapes, Text(text, (8.0, 16.0), colour)]


class FollowTarget(Behaviour):
    """Keeps a target in view at a distance, circles it or only turns towards it. The vehicle must be airborne.

    The target is the object inside a given box in the first frame, or the largest one of a class. It is tracked by
    appearance and, if there is a detector, by detections, and is distinguished from look-alikes. While it is hidden,
    the vehicle first follows its predicted motion, then hovers, then looks around. After ``give_up_s`` the behaviour
    ends in a hover. Neither a position nor a map is needed. Vehicles that report no velocity are flown by attitude.

    Attributes:
        follower: The object that finds the target and computes the set-points.
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
            class_name: If there is no box, the largest object of this class is followed; requires a detector.
            distance_m: Horizontal distance to keep; None for the distance in the settings.
            bearing_rad: Side of the target to stay on, as an angle counter-clockwise from its direction of motion: 0 is
                ahead of it, π behind it. If None, the settings apply, which allow any side by default.
            mode: ``follow``, ``orbit`` or ``look``.
            detector: Detector that searches every frame, or the name of a processor that returns detections, such as
                the one started by ``skyloop detect``. If None, the target is tracked by appearance only.
            height_m: The target's height, if known, for estimating its distance; by default, the typical height of its
                class. If neither is available, the drone only turns until its own motion has revealed the range.
            traits: All prior knowledge about the target, as an alternative to ``height_m``.
            camera: Camera to use; None for the vehicle's first camera.
            settings: Settings of the law; None for the defaults. Clamped to the drone's ``limits.*``.

        Raises:
            UnknownNameError: There is no such camera.
            UsageError: There is neither a box nor a class, the camera does not face forward, a number is out of range,
                or the vehicle neither reports its velocity nor accepts attitude set-points.
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
            raise UsageError(f"detector is {detector!r} and must have a detect(image) method or name a processor")
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
        """The state of the pursuit as of the newest frame."""
        return self.follower.status

    def look(self, frame: Frame) -> list[Shape]:
        """Find the target in a frame."""
        return self.follower.look(frame)

    def on_frame(self, frame: Frame) -> None:
        """Find the target and steer; after ``give_up_s``, hover and make :meth:`run` return."""
        super().on_frame(frame)
        if self.follower.over and not self.done:
            self.finish("gave up: the target was lost for too long")

    def on_result(self, result: Result) -> None:
        """Use a processor's detections if they are from this behaviour's camera."""
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
