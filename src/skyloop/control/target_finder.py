"""Find a target in a series of images by means of a box tracker and, if there is a detector, its detections.

The finder uses no drone, thread or clock; call it from one thread only. The tracker
(:class:`skyloop.vision.LongTermTracker`) models the target's appearance, and the scene (:mod:`.target_scene`) models
where all objects are and how they move. Each can find the target when the other fails. To avoid confusion, the
tracker's box must be where the target can be. After a loss, a new object must also be where the target can be, and must
be the only one that looks like the target.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from skyloop.clock import seconds
from skyloop.control.target_estimate import TRAITS, BoxView, CameraPose, TargetEstimator, TargetState, Traits
from skyloop.control.target_range import RangeEstimator, estimator_of
from skyloop.control.target_scene import Scene, SceneObject, unlikeness
from skyloop.errors import UsageError
from skyloop.vision import LongTermTracker
from skyloop.vision.appearance import colours
from skyloop.vision.object_tracks import Detection
from skyloop.vision.tracking import LEAST_PX, Box, Image, TrackResult, overlap, overlap_area

_SAME: Final = 0.4  # minimum overlap of two boxes that show the same object
_POINTED_AT: Final = 0.3  # minimum overlap between the user's box and the detection that it selects
_TRACKER_NOISE: Final = 0.06  # noise of the tracker's edges as a fraction of the box height; detectors are sharper
_TRACKER_NOISE_LATE: Final = 0.25  # the same while late detections provide the size, because the tracker's size drifts
_TAKEN: Final = 0.5  # if this fraction of the tracker's box is inside another object's box, it contains that object
_FITS: Final = 12.0  # maximum squared Mahalanobis distance per measurement for a box of the target
_DOUBT: Final = 6  # number of consecutive images with an impossible box after which the tracker is corrected
_LATELY_S: Final = 1.0  # time to keep clear of other objects after they were last seen
_DORMANT_S: Final = 1.0  # time out of view after which the target must be recognised again
_SIMILAR: Final = 1.6  # maximum mean colour difference between the target and a newcomer that may be the target
_LOOKED_AT: Final = 5  # number of images needed to judge a newcomer
_LOOKED_AT_IN_DOUBT: Final = 10  # number of images needed in case of doubt, to determine the newcomer's motion
_LOOKED_AT_LONGEST: Final = 20  # number of images after which a rejected newcomer is no longer considered
_OF_LATE: Final = 8  # number of images over which the mean difference is averaged
_TWIN: Final = 0.6  # colour difference below which only position and motion distinguish an object from the target
_TWIN_S: Final = 60.0  # time after the last sighting of a look-alike during which a newcomer may be that look-alike
_TWIN_OFF_M: Final = 1.0  # maximum distance of a newcomer from the target's expected position during this time ...
_TWIN_OFF_M_S: Final = 0.5  # ... plus this for each second unseen [m/s]
_OTHER_WAY_M_S: Final = 2.2  # maximum difference between a newcomer's velocity and the target's before it was hidden
_GOES_ON_S: Final = 6.0  # time for which a hidden target is assumed to keep its direction
_CLEARLY: Final = 1.0  # minimum difference in similarity to the second most similar newcomer
_FAST_M_S: Final = 4.0  # maximum assumed speed of an unseen object
_KEPT_FRAMES: Final = 12  # number of recent frames kept for detections that arrive late


@dataclass(frozen=True, slots=True)
class Sighting:
    """The result of searching one image."""

    box: Box | None  #: x, y, width, height [px]; None if the target was not found
    confidence: float | None  #: probability that the tracker is right, or score of a detection, 0 to 1
    contested: bool = False  #: whether the target may be in view but is indistinguishable from another object


@dataclass(slots=True, eq=False)
class _Seen:
    image: Image
    camera: CameraPose
    captured_ns: int
    box: Box | None = None  # box of the target


class TargetFinder:
    """Finds a target in a sequence of images."""

    def __init__(
        self,
        *,
        box: Box | None = None,
        class_name: str | None = None,
        traits: Traits | None = None,
        nominal_m: float = 4.0,
        relative: bool = False,
    ) -> None:
        """Initialise the finder with the target's box in the first image [px] or with a class.

        Given only a class, the target is its largest detection. ``nominal_m`` is the initial range if there is no cue.
        ``relative`` means that the vehicle does not know its own velocity.
        """
        if box is None and class_name is None:
            raise UsageError("a target needs a box in the image, or the name of a class that the detector knows")
        self.estimator: TargetEstimator | None = None  #: filter for the target's motion; None before the first sighting
        self.class_name = class_name
        self.detections: tuple[Detection, ...] = ()  #: detections in the newest image that a detector searched
        self._first_box = box
        self._given, self._unnamed = traits, class_name is None
        self._nominal_m, self._relative = nominal_m, relative
        self._tracker = LongTermTracker()
        self._tracking, self._tracker_noise = False, _TRACKER_NOISE
        self._scene: Scene | None = None
        self._number: int | None = None  # the target's number in the scene
        self._frames: deque[_Seen] = deque(maxlen=_KEPT_FRAMES)
        self._middle: tuple[float, float] | None = None  # expected position of the target in the newest image [px]
        self._doubts = 0
        self._twin_ns: int | None = None  # last time when both the target and a look-alike were in view
        self._newcomers: dict[int, tuple[int, float]] = {}  # number of images, mean colour difference from the target
        self._ground = False  # whether the camera's height above the ground is known in the newest image
        self._agreed = 0  # number of consecutive images in which tracker and detector agree

    def see(
        self,
        image: Image,
        camera: CameraPose,
        captured_ns: int,
        *,
        ground: bool,
        detections: Sequence[Detection] | None,
    ) -> Sighting:
        """Find the target in the next image.

        ``ground`` states whether the camera's height above the ground is known. ``detections`` is None if no detector
        has searched the image.
        """
        self._frames.append(_Seen(image, camera, captured_ns))
        self._ground = ground
        tracked = TrackResult(None, 0.0)
        if self._tracking:
            self._shift(camera, captured_ns)
            tracked = self._tracker.update(image)
        elif self._first_box is not None:
            self._tracker.start(image, self._first_box)
            self._tracking = True
            tracked = TrackResult(self._first_box, 1.0, 1.0)
            self._begin(self._first_box, camera, captured_ns, ground=ground)
            self._first_box = None
        if detections is not None:
            self._use(detections, self._frames[-1], tracked, ground=ground)
        if not self._is_backed(tracked.box, detections):
            tracked = TrackResult(None, 0.0)
        sighting = self._decide(image, camera, captured_ns, tracked)
        self._frames[-1].box = sighting.box
        self._middle = None if self.estimator is None else camera.pixel(self.estimator.at(captured_ns).middle)
        return sighting

    def detected(self, detections: Sequence[Detection], captured_ns: int, *, ground: bool) -> bool:
        """Use detections that arrive after their image was processed; return whether they show or may show the target.

        If the tracker missed the target in that image or found it elsewhere, it restarts from the detection. Detections
        are ignored if their image is not among the most recent images passed to :meth:`see`.
        """
        frame = next((one for one in self._frames if one.captured_ns == captured_ns), None)
        if frame is None:
            return False
        self._ground = ground
        self._use(detections, frame, TrackResult(frame.box, 0.0), ground=ground)
        target = self.target
        self._tracker_noise = _TRACKER_NOISE if target is None else _TRACKER_NOISE_LATE
        if target is None or not target.seen:
            return target is not None and target.contested
        if frame.box is None or overlap(frame.box, target.detection.box) < _SAME:
            # The detector has identified the target and the tracker has not, so drop the tracker's model.
            self._tracking = self._tracking and frame.box is not None
            self._resume(frame.image, target.detection.box)
            # The tracker's next step starts from that image, not from the newest one.
            self._middle = frame.camera.pixel(target.estimator.at(captured_ns).middle)
        return True

    @property
    def target(self) -> SceneObject | None:
        """The target among the detected objects; None if no detector knows it."""
        return None if self._scene is None or self._number is None else self._scene.objects.get(self._number)

    def candidate(self, at_ns: int) -> TargetState | None:
        """Return the state of a recently seen object that may be the lost target and is worth a closer look."""
        scene, found = self._scene, None
        if scene is None or self._number not in scene.dormant:
            return None
        for number, (images, mean) in self._newcomers.items():
            thing = scene.objects.get(number)
            if thing is None or seconds(at_ns - thing.last_ns) > _LATELY_S or images > _LOOKED_AT_LONGEST:
                continue
            if mean < 2.0 * _SIMILAR and (found is None or mean < found[0]):
                found = mean, thing
        return None if found is None else found[1].estimator.at(at_ns)

    def others(self, at_ns: int) -> list[TargetState]:
        """Return the states of other objects that are confirmed and were detected in the last second."""
        if self._scene is None:
            return []
        return [
            each.estimator.at(at_ns)
            for number, each in self._scene.objects.items()
            if number != self._number and each.confirmed and seconds(at_ns - (each.estimator.seen_ns or 0)) < _LATELY_S
        ]

    def _shift(self, camera: CameraPose, captured_ns: int) -> None:
        """Shift the tracker by the image motion expected from rotation, flight and the target's own motion."""
        if self.estimator is None or self._middle is None:
            return
        middle = camera.pixel(self.estimator.at(captured_ns).middle)
        if middle is not None:
            self._tracker.shift(middle[0] - self._middle[0], middle[1] - self._middle[1])

    # The tracker ---------------------------------------------------------------------------------------------------

    def _begin(self, box: Box, camera: CameraPose, captured_ns: int, *, ground: bool) -> None:
        traits = self._given or TRAITS.get(self.class_name or "")
        view = BoxView.of(box, camera, _TRACKER_NOISE)
        if view is None:
            raise UsageError("the box is straight above or below the vehicle and has no bearing: turn or move")
        self.estimator = estimator_of(self.class_name, traits, nominal_m=self._nominal_m, relative=self._relative)
        self.estimator.start(view, camera, captured_ns, ground=ground)

    def _decide(self, image: Image, camera: CameraPose, captured_ns: int, tracked: TrackResult) -> Sighting:
        """Decide where the target is in this image, from its detection or the tracker."""
        target, estimator = self.target, self.estimator
        if estimator is None:
            return Sighting(None, None)
        if target is not None and target.seen and target.estimator.seen_ns == captured_ns:
            box = target.detection.box
            agrees = tracked.box is not None and overlap(tracked.box, box) >= _SAME
            if not agrees:
                self._resume(image, box)
            return Sighting(box, tracked.confidence if agrees else target.detection.score)
        contested = target is not None and target.contested
        # While two objects appeared as one, it is unknown which one the tracker followed.
        unsure = target is not None and target.contested_ns > (target.estimator.seen_ns or 0)
        if tracked.box is None or unsure or self._is_taken(tracked.box):
            return Sighting(None, None, contested)
        return self._by_tracker(tracked, tracked.box, camera, captured_ns, estimator)

    def _by_tracker(
        self, tracked: TrackResult, box: Box, camera: CameraPose, captured_ns: int, estimator: TargetEstimator
    ) -> Sighting:
        view = BoxView.of(box, camera, self._tracker_noise)
        if view is None or estimator.seen_ns is None:
            return Sighting(None, None)
        if estimator.seen_ns == captured_ns:  # the initial box
            return Sighting(box, tracked.confidence)
        fit, _ = estimator.distance(view, camera, captured_ns)
        if fit > _FITS and not self._is_within_reach(view, camera, captured_ns, estimator):
            self._doubts += 1
            if self._doubts >= _DOUBT:
                self._tracker.refuse()
                self._doubts = 0
            return Sighting(None, None)
        self._doubts = 0
        if fit > _FITS or not estimator.update(view, camera, captured_ns):
            return Sighting(None, None)
        return Sighting(box, tracked.confidence)

    def _is_within_reach(self, view: BoxView, camera: CameraPose, captured_ns: int, estimator: TargetEstimator) -> bool:
        """Return whether an unseen target could have reached the tracker's box and, if so, move the estimate there."""
        assert estimator.seen_ns is not None
        unseen_s = seconds(captured_ns - estimator.seen_ns)
        if unseen_s < _DORMANT_S or self._number is not None:
            return False
        before = estimator.at(captured_ns)
        again = estimator.again(captured_ns)
        again.start(view, camera, captured_ns, ground=self._ground)
        way_m = math.dist(again.at(captured_ns).foot[:2], before.foot[:2])
        if way_m > _FAST_M_S * unseen_s + before.place_m:
            return False
        self.estimator = again
        return True

    def _is_backed(self, box: Box | None, detections: Sequence[Detection] | None) -> bool:
        """Return whether, according to the detector, the tracker's box may be the target's.

        The tracker may get stuck on an object that hides the target. If the detector knows the target, the tracker is
        therefore trusted only between searched images, and only for a second.
        """
        target, scene = self.target, self._scene
        if box is None or target is None or scene is None or target.seen:
            return True
        if target.number in scene.dormant:
            return False
        return detections is None or any(overlap(one.box, box) >= _SAME for one in detections)

    def _is_taken(self, box: Box) -> bool:
        """Return whether the box belongs to another object that was detected in this image."""
        if self._scene is None or self._number is None:
            return False
        now, taken = self._frames[-1].captured_ns, _TAKEN * box[2] * box[3]
        return any(
            each.seen and each.estimator.seen_ns == now and overlap_area(box, each.detection.box) >= taken
            for number, each in self._scene.objects.items()
            if number != self._number
        )

    def _resume(self, image: Image, box: Box) -> None:
        if min(box[2:]) < LEAST_PX:
            return
        if self._tracking:
            self._tracker.resume(image, box)
        else:
            self._tracker.start(image, box)
            self._tracking = True

    # Detections ----------------------------------------------------------------------------------------------------

    def _use(self, detections: Sequence[Detection], frame: _Seen, tracked: TrackResult, *, ground: bool) -> None:
        if self._scene is None:
            given = {} if self._given is None or self.class_name is None else {self.class_name: self._given}
            self._scene = Scene(relative=self._relative, traits=given)
        scene = self._scene
        self.detections = tuple(detections)
        target = self.target
        if target is not None and target.estimator.seen_ns is not None:
            gone = seconds(frame.captured_ns - target.last_ns) > _DORMANT_S
            scene.dormant = {target.number} if gone else set()
        looks = [colours(frame.image, one.box) for one in detections]
        scene.update(detections, looks, frame.camera, frame.captured_ns, ground=ground)
        if target is not None:
            if target.seen and self._is_unsure(scene, target):
                target.estimator = self._learning(target, frame, back=True)
            self.estimator = target.estimator  # confused objects may have been exchanged
        if target is None:
            self._choose(scene, frame, tracked)
        elif target.number in scene.dormant:
            self._recognise(scene, target, frame)
        else:
            self._newcomers.clear()
            self._note_twins(scene, target, frame.captured_ns)

    def _choose(self, scene: Scene, frame: _Seen, tracked: TrackResult) -> None:
        """Choose the detection that matches the user's box, the tracker's box or the class."""
        candidates = [each for each in scene.objects.values() if each.seen and self._may_be(each)]
        if not self._tracking:
            confirmed = [each for each in candidates if each.confirmed]
            if self.class_name is not None and confirmed:
                self._adopt(scene, max(confirmed, key=lambda each: each.detection.box[3]), frame)
                self._resume(frame.image, self.target.detection.box if self.target else (0, 0, 0, 0))
            return
        box = tracked.box
        if box is None:
            return
        best = max(candidates, key=lambda each: overlap(each.detection.box, box), default=None)
        at_start = len(self._frames) == 1
        if best is None or overlap(best.detection.box, box) < (_POINTED_AT if at_start else _SAME):
            self._agreed = 0
            return
        self._agreed += 1
        if at_start or self._agreed >= 3:
            self._adopt(scene, best, frame)

    def _recognise(self, scene: Scene, target: SceneObject, frame: _Seen) -> None:
        """Accept a newcomer as the target if its position is plausible and it is the only object that looks like it."""
        assert target.estimator.seen_ns is not None
        likely: list[tuple[float, SceneObject]] = []
        for each in scene.objects.values():
            newcomer = each.first_ns > target.estimator.seen_ns and each.seen and self._may_be(each)
            if not newcomer or each.number == target.number or min(each.detection.box[2:]) < LEAST_PX:
                continue
            view = BoxView.of(each.detection.box, frame.camera)
            if view is None or target.estimator.distance(view, frame.camera, frame.captured_ns)[0] > _FITS:
                continue
            images, mean = self._newcomers.get(each.number, (0, 0.0))
            if images and not self._is_expected(target, each, mean, frame.captured_ns):
                images = 0  # start over because two objects may have merged in an image
            if each.whole:
                images += 1
                mean += (unlikeness(target.looks, each.places) - mean) / min(images, _OF_LATE)
                self._newcomers[each.number] = images, mean
            if images:
                likely.append((mean, each))
        likely.sort(key=lambda one: one[0])
        if not likely or likely[0][0] > _SIMILAR:
            return
        mean, found = likely[0]
        if self._newcomers[found.number][0] < (_LOOKED_AT if mean < _TWIN else _LOOKED_AT_IN_DOUBT):
            return
        if len(likely) > 1 and likely[1][0] - likely[0][0] < _CLEARLY:
            return  # the candidates are indistinguishable
        if not self._is_expected(target, found, mean, frame.captured_ns):
            return
        # The first boxes of a reappearing object also contain part of the occluder, so keep the old colours.
        found.looks, found.hits = target.looks, target.hits + found.hits
        self._adopt(scene, found, frame, back=True)
        del scene.objects[target.number]

    def _note_twins(self, scene: Scene, target: SceneObject, at_ns: int) -> None:
        """Record whether a look-alike is in view in addition to the target."""
        if target.seen and any(
            each.seen and each.whole and each.confirmed and unlikeness(target.looks, each.looks) < _TWIN
            for each in scene.objects.values()
            if each is not target
        ):
            self._twin_ns = at_ns

    def _is_expected(self, target: SceneObject, found: SceneObject, mean: float, at_ns: int) -> bool:
        """Return whether a newcomer moves like the target and, if there is a look-alike, appears where expected."""
        assert target.estimator.seen_ns is not None
        expected, is_at = target.estimator.at(at_ns), found.estimator.at(at_ns)
        unseen_s = seconds(at_ns - target.estimator.seen_ns)
        off_m = math.dist(expected.foot[:2], is_at.foot[:2])
        off_m_s = math.dist(expected.velocity, is_at.velocity)
        if self._twin_ns is not None and seconds(at_ns - self._twin_ns) < _TWIN_S:
            return off_m < _TWIN_OFF_M + _TWIN_OFF_M_S * unseen_s and off_m_s < _OTHER_WAY_M_S
        return mean < _TWIN or unseen_s > _GOES_ON_S or off_m_s < _OTHER_WAY_M_S

    def _may_be(self, each: SceneObject) -> bool:
        return self.class_name is None or each.class_name == self.class_name

    def _is_unsure(self, scene: Scene, thing: SceneObject) -> bool:
        """Return whether an object that is assumed to be on the ground might instead hang on a wall."""
        traits = scene.traits.get(thing.class_name)
        unsure = traits is None or (traits is self._given and self._unnamed and traits.on_ground is None)
        return unsure and not isinstance(thing.estimator, RangeEstimator)

    def _learning(self, thing: SceneObject, frame: _Seen, *, back: bool) -> TargetEstimator:
        """Return a filter that learns the range of an object in a frame; ``back`` marks the return of a lost target."""
        before = self.estimator
        if isinstance(before, RangeEstimator) and not back:
            return before
        view = BoxView.of(thing.detection.box, frame.camera)
        if view is None:
            return thing.estimator
        if isinstance(before, RangeEstimator):
            new = before.again(frame.captured_ns)
        else:
            new = estimator_of(None, self._given, nominal_m=self._nominal_m, relative=self._relative)
        new.start(view, frame.camera, frame.captured_ns, ground=self._ground)
        return new

    def _adopt(self, scene: Scene, thing: SceneObject, frame: _Seen, *, back: bool = False) -> None:
        if self._given is not None and self.class_name is None:  # traits from the user take precedence over the class
            scene.traits[thing.class_name] = self._given
            if self.estimator is not None:
                thing.estimator = self.estimator
        if self._is_unsure(scene, thing):
            thing.estimator = self._learning(thing, frame, back=back)
        self._number = thing.number
        self.class_name = thing.class_name
        self.estimator = thing.estimator
        scene.kept = {thing.number}
        scene.dormant = set()
        self._doubts = 0
