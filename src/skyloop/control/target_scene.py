"""Which detection is which thing: things that were seen keep their identity while they cross, hide and return. Pure.

Detections are matched with filters of where things are, not of where they were in the last image, so the vehicle's own
motion does no harm, and two that look alike are told apart by place and motion. The pairs are the likeliest ones
altogether (SciPy's ``linear_sum_assignment``). A detection that another thing could explain nearly as well is used for
neither: both go on by their motion until they are apart.
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
from skyloop.control.target_estimate import TRAITS, UNKNOWN, TargetEstimator, Traits
from skyloop.control.target_view import BoxView, Camera
from skyloop.estimation import assignment
from skyloop.vision.object_tracks import Detection

Floats = NDArray[np.float32]

_COLOUR_UNITS: Final = np.array([30.0, 10.0, 10.0, 30.0, 10.0, 10.0], np.float32)  # of L, a, b: light changes L most
_OTHER: Final = 10.0  # unlikeness from which something is another thing; its own: mostly below 0.5, at times 3
_OTHER_AGAIN: Final = 3.0  # the same, of what was not seen for a moment
_MOMENT_S: Final = 0.3
_UNLIKE: Final = 3.0  # weight of the unlikeness against that of where things are
_LEARNING: Final = 0.05  # of the colours, by one detection; of the first ones the mean
_GATE: Final = 9.0  # of the squared Mahalanobis distance by the number of what was measured
_NEVER: Final = 1e6
_AMBIGUOUS: Final = 4.0  # of the likelihood's negative logarithm, doubled: less is not clear
_LATELY_S: Final = 1.2  # a thing that was seen so lately may be what a detection shows
_TOGETHER_S: Final = 3.0  # two that are detected as one for longer are believed to be one
_FAR_BEHIND: Final = 1.3  # times as far: what is so far behind another thing is hidden by it, and not part of its box
_EARLIER_S: Final = 0.5  # before two met: what pulls at them as their boxes merge has not begun then
_APART_S: Final = 0.6  # after they parted: how they move on is known then
_DIFFER_M_S: Final = 0.8  # between their velocities before: else nothing tells them apart
_TURNED: Final = 0.3  # of that difference, the other way round, from which they were taken for each other
_KEEP_S: Final = 2.0  # things that are hidden are remembered for so long: what comes after that may be another one
_YOUNG_S: Final = 0.5  # and those that were seen only once
_CONFIRMED: Final = 3  # detections
_OF_A_PART: Final = 1.0  # unlikeness of what the image cuts off: its halves are others
_SETTLED: Final = 8  # detections: what was seen less often, perhaps two as one, contests nothing of others
_YOUNG: Final = 4.0  # by which its costs are higher
_WELL_KNOWN: Final = 15  # detections: its colours are known then
_SURE: Final = 0.35  # score of a detection that may be a new thing


@dataclass(slots=True, eq=False)
class SceneObject:
    """One thing.

    Attributes:
        number: By which it is known; never given to another one.
        class_name: Of its detections.
        estimator: Where it is.
        detection: The last one.
        looks: Its colours, (6,): see :func:`skyloop.vision.appearance.colours`.
        places: Those of the last detection that the image did not cut off, (n, 6).
        whole: Whether the last detection was of the whole thing.
        hits: How often it was detected.
        first_ns: When it was detected first.
        last_ns: When it was detected last.
        seen: Whether it was detected in the newest image.
        contested_ns: When it was contested last.
        velocities: Of the last half second.
        contested: Whether it may have been in the newest image, but so may another thing have been.
    """

    number: int
    class_name: str
    estimator: TargetEstimator
    detection: Detection
    looks: Floats
    places: Floats
    hits: int
    first_ns: int
    last_ns: int
    seen: bool = True
    whole: bool = True
    contested_ns: int = 0
    contested: bool = False

    velocities: deque[tuple[int, NDArray[np.float64]]] = field(default_factory=deque)

    @property
    def confirmed(self) -> bool:
        """Whether it was seen often enough to be believed."""
        return self.hits >= _CONFIRMED

    def learn(self, places: Floats) -> None:
        """Update the colours with those at places of its newest detection, (n, 6)."""
        self.places = places
        self.looks = self.looks + max(_LEARNING, 1.0 / self.hits) * (_nearest(self.looks, places) - self.looks)

    def remember(self, at_ns: int) -> None:
        """Keep the velocity of this time for :attr:`earlier`."""
        self.velocities.append((at_ns, self.estimator.at(at_ns).velocity))
        while len(self.velocities) > 1 and seconds(at_ns - self.velocities[1][0]) >= _EARLIER_S:
            self.velocities.popleft()

    @property
    def earlier(self) -> NDArray[np.float64]:
        """Its velocity about half a second before it was seen last, (2,) [m/s]."""
        return self.velocities[0][1] if self.velocities else np.zeros(2)

    def exchange(self, other: SceneObject) -> None:
        """Exchange all but the numbers."""
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
        """Whether the image cuts off neither its upper nor its lower end."""
        return self.view.bottom is not None and self.view.top is not None


def unlikeness(one: Floats, other: Floats) -> float:
    """Return how much two things differ in their colours: squared, in units of what light and folds change.

    Args:
        one: Of a thing, (6,).
        other: Of a thing (6,), or of places in a box (n, 6), of which the most similar counts.
    """
    return float(np.min(_unlike(one, other)))


def _nearest(one: Floats, places: Floats) -> Floats:
    """Return the most similar of the colours of places in a box, (6,)."""
    places = np.atleast_2d(places)
    nearest: Floats = places[int(np.argmin(_unlike(one, places)))]
    return nearest


def _unlike(one: Floats, other: Floats) -> Floats:
    return np.asarray(np.sum(((one - other) / _COLOUR_UNITS) ** 2, axis=-1))


def _is_about(thing: SceneObject, at_ns: int) -> bool:
    """Whether a thing was seen a moment ago, or may have been seen all the time since it was."""
    seen_s = seconds(at_ns - (thing.estimator.seen_ns or 0))
    return seen_s < _LATELY_S or (seen_s < _TOGETHER_S and seconds(at_ns - thing.contested_ns) < _LATELY_S)


def _is_merged(thing: SceneObject, other: SceneObject, seen: _Seen, camera: Camera, at_ns: int) -> bool:
    """Whether a detection may be of two things together: the other's middle is in the box, and not far behind."""
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
    """The things that were detected.

    Attributes:
        objects: By number.
        kept: Numbers of those that are not forgotten, however long they are hidden.
        dormant: Numbers of those that no detection is matched with: whether they are back is decided elsewhere.
        traits: Of classes, for things that are new.
    """

    def __init__(self, *, relative: bool = False, traits: dict[str, Traits] | None = None) -> None:
        """Begin without things.

        Args:
            relative: Whether the vehicle does not know its own velocity.
            traits: Of classes, in place of those in :data:`~.target_estimate.TRAITS`.

        Raises:
            MissingExtraError: SciPy is not installed.
        """
        self.objects: dict[int, SceneObject] = {}
        self.kept: set[int] = set()
        self.dormant: set[int] = set()
        self._relative = relative
        self.traits = TRAITS | (traits or {})
        self._met: dict[frozenset[int], tuple[int, int, NDArray[np.float64]]] = {}
        self._numbers = itertools.count(1)
        self._assign = assignment("matching detections", "detect")

    def update(
        self, detections: Sequence[Detection], looks: Sequence[Floats], camera: Camera, at_ns: int, *, ground: bool
    ) -> None:
        """Match the detections of the next image.

        Args:
            detections: Of one image.
            looks: The colours of each: (6,), or (n, 6) at n places from its left to its right.
            camera: That took it.
            at_ns: Its capture.
            ground: Whether the camera's height above the ground is known.
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

    def _match(self, seen: list[_Seen], camera: Camera, at_ns: int) -> list[_Seen]:
        """Update the things that are found among the detections; return the detections that are left."""
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
        shift = float(costs.min())  # the assignment minimises sums: all costs must be better than no pair
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
        """Remember how two moved against each other before they were seen as one."""
        pair = frozenset({one.number, other.number})
        if len(pair) == 2 and pair not in self._met:
            self._met[pair] = one.number, other.number, one.earlier - other.earlier

    def _untangle(self, at_ns: int) -> None:
        """Exchange two that were taken for each other: after they met, each moves on as the other did before.

        Whatever the vehicle's own motion adds to both velocities does not matter to their difference.
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

    def _add(self, new: _Seen, camera: Camera, at_ns: int, *, ground: bool) -> None:
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
