"""Follow anything: what is in a box of the image, or whatever is of a class."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from skyloop.control.behaviour import Behaviour, camera_info
from skyloop.control.chase_law import LOSSES, FollowMode, TargetPhase
from skyloop.control.chase_settings import ChaseSettings
from skyloop.control.target_estimate import Traits
from skyloop.control.target_follower import FollowStatus, TargetFollower
from skyloop.errors import UsageError
from skyloop.messages.relayed import Shape
from skyloop.vision.object_tracks import Detection, ObjectDetector
from skyloop.vision.tracking import Box

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.client.results import Result


class FollowTarget(Behaviour):
    """Keeps a target in view, at a distance; circles it; or only looks at it. It must be airborne when it runs.

    The target is what is in a box of the first frame, or the largest thing of a class. It is tracked by its looks and,
    where there is a detector, by its detections, and is not mixed up with look-alikes. While it is hidden the vehicle
    flies on by its last motion for a moment, then hovers, then looks around; after ``give_up_s`` the behaviour ends,
    hovering. The vehicle needs neither position nor map. One that reports no velocity is flown by attitude.

    Attributes:
        follower: What finds the target and computes the set-points.
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
            box: The target in the first frame: x, y, width, height [px].
            class_name: Follow the largest thing of this class, if there is no box. Needs a detector.
            distance_m: Horizontal distance to keep; None: the settings'.
            bearing_rad: Where to be as seen from the target, counter-clockwise from where it moves to: 0 is ahead of
                it, π behind. None: on any side, or the settings'.
            mode: ``follow``, ``orbit`` or ``look``.
            detector: Searches every frame; or the name of a processor whose results are detections, such as that of
                ``skyloop detect``. None: the target is tracked by its looks alone.
            height_m: How high the target is, if that is known, for its distance; else that of its class is taken. With
                neither, the drone only turns until its own motion has shown the range.
            traits: All that is known of the target, in place of ``height_m``.
            camera: Whose frames to use; None is the vehicle's first camera.
            settings: Of the law; None are the defaults. They are brought within the drone's ``limits.*``.

        Raises:
            UnknownNameError: There is no such camera.
            UsageError: There is neither a box nor a class; or the camera does not look forward; or a number is out of
                its range; or the vehicle reports no velocity, and takes no attitudes.
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
            raise UsageError(f"detector is {detector!r} and must have detect(image), or be the name of a processor")
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
        if isinstance(detector, str):
            self.processors = (detector,)
        else:
            self.processors = ()
        super().__init__(drone, self.follower, camera)

    @property
    def phase(self) -> TargetPhase:
        """What becomes of it."""
        return self.follower.phase

    @property
    def status(self) -> FollowStatus:
        """How it goes, as of the newest frame."""
        return self.follower.status

    def look(self, frame: Frame) -> list[Shape]:
        """Find the target."""
        return self.follower.look(frame)

    def on_frame(self, frame: Frame) -> None:
        """Find the target and steer; at the end of patience hover and let :meth:`run` return."""
        super().on_frame(frame)
        if self.follower.over and not self.done:
            self.finish("gave up: the target was lost for too long")

    def on_result(self, result: Result) -> None:
        """Use the detections of a processor in frames of this behaviour's camera; it may see others' too."""
        if result.camera == self._mounting.name:
            self.follower.detected(detections_of(result.value), result.captured_ns)


def _box(box: Sequence[float]) -> Box:
    try:
        x, y, width, height = (float(part) for part in box)
    except (TypeError, ValueError):
        raise UsageError(f"the box is {box!r} and must be x, y, width and height in pixels") from None
    return x, y, width, height


def detections_of(value: Any) -> list[Detection]:
    """Return the detections in a result of ``skyloop detect``.

    Args:
        value: The result's value; what is no detection in it is left out.
    """
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
