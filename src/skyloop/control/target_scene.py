"""Match detections to objects, so that objects keep their identities when they cross, hide or return. Pure.

Detections are matched with filtered estimates of the objects' current positions, not with their positions in the last
image. The vehicle's own motion therefore does not matter, and look-alikes are distinguished by position and motion. The
pairs form the most likely overall assignment (SciPy's ``linear_sum_assignment``). If two objects explain a detection
almost equally well, neither is updated. Both then continue on their predicted paths until they separate.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import seconds
from skyloop.control.target_estimate import TRAITS, UNKNOWN, BoxView, CameraPose, TargetEstimator, Traits
from skyloop.estimation import assignment
from skyloop.vision.object_tracks import Detection

Floats = NDArray[np.float32]

_COLOUR_UNITS: Final = np.array([30.0, 10.0, 10.0, 30.0, 10.0, 10.0], np.float32)  # L, a, b; lighting affects L most
_OTHER: Final = 10.0  # colour difference between objects; for the same object it is usually below 0.5, sometimes 3
_OTHER_AGAIN: Final = 3.0  # colour difference above which an object that was briefly out of view counts as another
_MOMENT_S: Final = 0.3  # time out of view after which _OTHER_AGAIN applies
_UNLIKE: Final = 3.0  # weight of the colour difference relative to the position
_LEARNING: Final = 0.05  # learning rate of the colours per detection; the first few are averaged
_GATE: Final = 9.0  # maximum squared Mahalanobis distance per measurement
_NEVER: Final = 1e6  # cost of an impossible pair
_AMBIGUOUS: Final = 4.0  # difference of the doubled negative log-likelihood below which a match is ambiguous
_LATELY_S: Final = 1.2  # maximum time for which an unseen object can still explain a detection
_TOGETHER_S: Final = 3.0  # time after which two objects detected as one count as one
_FAR_BEHIND: Final = 1.3  # ratio of ranges above which an object is hidden by another one, not part of its box
_EARLIER_S: Final = 0.5  # time before a meeting at which velocities are not yet distorted by merging boxes
_APART_S: Final = 0.6  # time after a separation at which velocities are known again
_DIFFER_M_S: Final = 0.8  # minimum velocity difference before a meeting for telling two objects apart
_TURNED: Final = 0.3  # the objects count as confused if this fraction of that difference has reversed
_KEEP_S: Final = 2.0  # time to remember hidden objects; a later newcomer may be a different object
_YOUNG_S: Final = 0.5  # time to remember hidden objects that were never confirmed
_CONFIRMED: Final = 3  # number of detections needed to confirm an object
_OF_A_PART: Final = 1.0  # colour difference assumed for objects cut off by the image
_SETTLED: Final = 8  # number of detections after which an object can contest others; new ones may be two in one
_YOUNG: Final = 4.0  # extra cost for an object with few detections
_WELL_KNOWN: Final = 15  # number of detections from which an object's colours are known
_SURE: Final = 0.35  # minimum score of a detection that may be a new object


@dataclass(slots=True, eq=False)
class SceneObject:
    """A detected object."""

    number: int  #: number that identifies the object; never reused
    class_name: str  #: class of the detections
    estimator: TargetEstimator  #: filter for the object's motion
    detection: Detection  #: the last detection
    looks: Floats  #: colours, (6,): see :func:`skyloop.vision.appearance.colours`
    places: Floats  #: colours of the last detection that was not cut off by the image, (n, 6)
    hits: int  #: number of detections
    first_ns: int  #: time of the first detection
    last_ns: int  #: time of the last detection
    seen: bool = True  #: whether the object was detected in the newest image
    whole: bool = True  #: whether the last detection showed the whole object
    contested_ns: int = 0  #: time when the object was last contested
    contested: bool = False  #: whether a detection in the newest image may show this object or another one

    #: velocities of the last half second
    velocities: deque[tuple[int, NDArray[np.float64]]] = field(default_factory=deque)

    @property
    def confirmed(self) -> bool:
        """Whether the object has been detected often enough to be trusted."""
        return self.hits >= _CONFIRMED

    def learn(self, places: Floats) -> None:
        """Update the colours with those of the strips in the newest detection, (n, 6)."""
        self.places = places
        self.looks = self.looks + max(_LEARNING, 1.0 / self.hits) * (_nearest(self.looks, places) - self.looks)

    def remember(self, at_ns: int) -> None:
        """Record the current velocity for later use by :attr:`earlier`."""
        self.velocities.append((at_ns, self.estimator.at(at_ns).velocity))
        while len(self.velocities) > 1 and seconds(at_ns - self.velocities[1][0]) >= _EARLIER_S:
            self.velocities.popleft()

    @property
    def earlier(self) -> NDArray[np.float64]:
        """The velocity about half a second before the last detection, (2,) [m/s]."""
        return self.velocities[0][1] if self.velocities else np.zeros(2)

    def exchange(self, other: SceneObject) -> None:
        """Exchange motion and detections with another object, but keep numbers and colours."""
        for name in ("estimator", "detection", "hits", "last_ns", "seen", "contested", "velocities"):
            mine, its = getattr(self, name), getattr(other, name)
            setattr(self, name, its)
            setattr(other, name, mine)


class _Seen(NamedTuple):
    detection: Detection
    view: BoxView
    looks: Floats

    @property
    def whole(self) -> bool:
        """Whether both the top and the bottom of the object are in the image."""
        return self.view.bottom is not None and self.view.top is not None


def unlikeness(one: Floats, other: Floats) -> float:
    """Return the squared colour difference of two objects, in units of the usual variation due to light and folds.

    ``other`` contains the colours of one box, (6,), or of n strips of a box, (n, 6); the most similar strip is used.
    """
    return float(np.min(_unlike(one, other)))


def _nearest(one: Floats, places: Floats) -> Floats:
    """Return the most similar colours among the strips of a box, (6,)."""
    places = np.atleast_2d(places)
    nearest: Floats = places[int(np.argmin(_unlike(one, places)))]
    return nearest


def _unlike(one: Floats, other: Floats) -> Floats:
    return np.asarray(np.sum(((one - other) / _COLOUR_UNITS) ** 2, axis=-1))


def _is_about(thing: SceneObject, at_ns: int) -> bool:
    """Return whether an object was seen a moment ago or may have been in view since then."""
    seen_s = seconds(at_ns - (thing.estimator.seen_ns or 0))
    return seen_s < _LATELY_S or (seen_s < _TOGETHER_S and seconds(at_ns - thing.contested_ns) < _LATELY_S)


def _is_merged(thing: SceneObject, other: SceneObject, seen: _Seen, camera: CameraPose, at_ns: int) -> bool:
    """Return whether a detection may show two objects, because another object's centre is in it, not far behind."""
    state = other.estimator.at(at_ns)
    middle = camera.pixel(state.middle)
    x, y, width, height = seen.detection.box
    if middle is None or not (x <= middle[0] <= x + width and y <= middle[1] <= y + height):
        return False
    away, behind = (
        float(np.hypot(*(foot[:2] - camera.position[:2]))) for foot in (thing.estimator.at(at_ns).foot, state.foot)
    )
    return behind < _FAR_BEHIND * away


class Scene:
    """The detected objects."""

    def __init__(self, *, relative: bool = False, traits: dict[str, Traits] | None = None) -> None:
        """Initialise an empty scene; ``traits`` maps classes to traits replacing :data:`~.target_estimate.TRAITS`."""
        self.objects: dict[int, SceneObject] = {}  #: objects by number
        self.kept: set[int] = set()  #: numbers of objects that are never forgotten, however long they are hidden
        #: numbers of objects that are not matched with detections, because their return is decided elsewhere
        self.dormant: set[int] = set()
        self._relative = relative
        self.traits = TRAITS | (traits or {})  #: traits by class, for new objects
        self._met: dict[frozenset[int], tuple[int, int, NDArray[np.float64]]] = {}
        self._numbers = itertools.count(1)
        self._assign = assignment("matching detections", "detect")

    def update(
        self, detections: Sequence[Detection], looks: Sequence[Floats], camera: CameraPose, at_ns: int, *, ground: bool
    ) -> None:
        """Match the detections in the next image.

        ``looks`` contains the colours of each detection: (6,), or (n, 6) for n strips from left to right. ``ground``
        states whether the camera's height above the ground is known.
        """
        self._forget(at_ns)
        seen = [
            _Seen(one, view, colours)
            for one, colours in zip(detections, looks, strict=True)
            if (view := BoxView.of(one.box, camera)) is not None
        ]
        for each in self.objects.values():
            each.seen = each.contested = False
        left = self._match(seen, camera, at_ns)
        self._untangle(at_ns)
        for new in left:
            if new.detection.score >= _SURE:
                self._add(new, camera, at_ns, ground=ground)

    def _match(self, seen: list[_Seen], camera: CameraPose, at_ns: int) -> list[_Seen]:
        """Update the objects that match a detection; return the unmatched detections."""
        things = [each for number, each in self.objects.items() if number not in self.dormant]
        if not things or not seen:
            return seen
        costs = np.full((len(things), len(seen)), _NEVER)
        for i, thing in enumerate(things):
            for j, one in enumerate(seen):
                unlike = unlikeness(thing.looks, one.looks) if one.whole else _OF_A_PART
                most = _OTHER if seconds(at_ns - thing.last_ns) < _MOMENT_S else _OTHER_AGAIN
                if one.detection.class_name == thing.class_name and (unlike < most or thing.hits < _WELL_KNOWN):
                    fit, cost = thing.estimator.distance(one.view, camera, at_ns)
                    if fit < _GATE:
                        costs[i, j] = cost + _UNLIKE * unlike + (0.0 if thing.hits >= _SETTLED else _YOUNG)
        shift = float(costs.min())  # the assignment minimises sums, so impossible pairs must be the most expensive
        rows, columns = self._assign(np.where(costs < _NEVER, costs - shift, _NEVER))
        pairs = [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if costs[i, j] < _NEVER]
        matched = {i for i, _ in pairs}
        used = set()
        for i, j in pairs:
            used.add(j)
            rivals = [
                k
                for k in range(len(things))
                if k not in matched
                and things[k].hits >= _SETTLED
                and _is_about(things[k], at_ns)
                and (costs[k, j] < costs[i, j] + _AMBIGUOUS or _is_merged(things[i], things[k], seen[j], camera, at_ns))
            ]
            if rivals and things[i].confirmed:
                for k in (i, *rivals):
                    self._meet(things[i], things[k])
                for k in (i, *rivals):
                    things[k].contested, things[k].contested_ns = True, at_ns
                continue
            thing, one = things[i], seen[j]
            if thing.estimator.update(one.view, camera, at_ns):
                thing.seen, thing.detection, thing.hits = True, one.detection, thing.hits + 1
                thing.whole, thing.last_ns = one.whole, max(at_ns, thing.last_ns)
                if one.whole:
                    thing.learn(one.looks)
                thing.remember(at_ns)
        return [seen[j] for j in range(len(seen)) if j not in used]

    def _meet(self, one: SceneObject, other: SceneObject) -> None:
        """Remember the relative velocity of two objects before they merged."""
        pair = frozenset({one.number, other.number})
        if len(pair) == 2 and pair not in self._met:
            self._met[pair] = one.number, other.number, one.earlier - other.earlier

    def _untangle(self, at_ns: int) -> None:
        """Exchange two objects that were confused: each now moves as the other did before they met.

        The vehicle's own motion affects both velocities equally, so it does not change their difference.
        """
        for pair, (first, second, before) in list(self._met.items()):
            one, other = self.objects.get(first), self.objects.get(second)
            if one is None or other is None:
                del self._met[pair]
                continue
            apart_s = seconds(at_ns - max(one.contested_ns, other.contested_ns))
            if apart_s > _TOGETHER_S:
                del self._met[pair]
            if apart_s < _APART_S or not (one.seen and other.seen):
                continue
            after = one.estimator.at(at_ns).velocity - other.estimator.at(at_ns).velocity
            self._met.pop(pair, None)
            if float(np.hypot(*before)) > _DIFFER_M_S and float(after @ before) < -_TURNED * float(before @ before):
                one.exchange(other)

    def _add(self, new: _Seen, camera: CameraPose, at_ns: int, *, ground: bool) -> None:
        name = new.detection.class_name
        estimator = TargetEstimator(self.traits.get(name, UNKNOWN), relative=self._relative)
        estimator.start(new.view, camera, at_ns, ground=ground)
        number = next(self._numbers)
        places = np.atleast_2d(new.looks)
        self.objects[number] = SceneObject(
            number, name, estimator, new.detection, places[len(places) // 2], places, 1, at_ns, at_ns
        )

    def _forget(self, at_ns: int) -> None:
        for number, each in list(self.objects.items()):
            unseen_s = seconds(at_ns - max(each.estimator.seen_ns or 0, each.contested_ns))
            if number not in self.kept and unseen_s > (_KEEP_S if each.confirmed else _YOUNG_S):
                del self.objects[number]
