"""The truth about the one target being followed, in addition to all others: for ``follow_flights.py``."""

from __future__ import annotations

from dataclasses import dataclass

from follow_truth import HIDDEN, FrameTruth, TargetTruth

from skyloop.messages import Feedback
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.sim.labels import TargetBox
from skyloop.sim.world import World


@dataclass(frozen=True, slots=True)
class Truth:
    """The truth at the capture of one frame."""

    image: FrameTruth  #: of the whole image
    box: TargetBox | None  #: the target's; None: not in the image
    hidden: bool  #: something occludes the target, wherever the camera points
    in_view: bool  #: the image shows the target's centre without occlusion
    distance_m: float  #: horizontal, from the vehicle's centre


class Judge:
    """Knows the truth of one target of a world.

    Args:
        world: The world of the flight.
        target: The target's name.
        camera: The vehicle's camera.
    """

    def __init__(self, world: World, target: str, camera: CameraModel = FRONT_CAMERA) -> None:
        self._truth = TargetTruth(world, camera)
        self._name = target

    def at(self, state: Feedback, captured_ns: int) -> Truth:
        """Return the truth at a capture, from the state reported nearest to it."""
        image = self._truth.at_capture(state, captured_ns)
        assert image is not None
        box = image.boxes.get(self._name)
        shown = self._name in image.in_image
        if shown:
            visible = 0.0 if box is None else box.visible
        else:
            visible = self._truth.visible_if_aimed(state, captured_ns, self._name)
        hidden = visible < HIDDEN
        return Truth(image, box, hidden, shown and not hidden, image.distances_m[self._name])
