"""What is true of the one target that is followed, on top of what is true of all: for ``follow_flights.py``."""

from __future__ import annotations

from dataclasses import dataclass

from follow_truth import HIDDEN, FrameTruth, TargetTruth

from skyloop.messages import Feedback
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.sim.labels import TargetBox
from skyloop.sim.world import World


@dataclass(frozen=True, slots=True)
class Truth:
    """What is true at the capture of one frame."""

    image: FrameTruth  #: of everything
    box: TargetBox | None  #: the target's; None: it is not in the image
    hidden: bool  #: something stands before the target, wherever the camera looks
    in_view: bool  #: the image shows the target's middle, and it is not hidden
    distance_m: float  #: horizontal, from the vehicle's centre


class Judge:
    """Knows the truth of one target of a world.

    Args:
        world: The world that is flown in.
        target: The target's name.
        camera: Of the vehicle.
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
