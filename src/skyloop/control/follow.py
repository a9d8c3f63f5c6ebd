"""Follow a marker by the camera at a distance and straight before its face; search for it when it is not seen."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from skyloop.clock import nanoseconds
from skyloop.control.behaviour import Behaviour
from skyloop.control.follow_law import FollowLaw, FollowSettings, Mode
from skyloop.messages import Points, Polyline, Text
from skyloop.messages.relayed import Colour, Shape
from skyloop.vision import MarkerDetector, MarkerSighting

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

_COLOURS: dict[Mode, Colour] = {
    Mode.FOLLOWING: (64, 220, 100),
    Mode.RECOVERING: (255, 180, 60),
    Mode.SEARCHING: (120, 190, 255),
}
_OTHER: Colour = (150, 150, 150)


@dataclass(slots=True)
class FollowScore:
    """How well it went, counted from the first sighting on. Ranges are estimates, from the vehicle's centre."""

    frames: int = 0  #: since the first sighting, that one included
    in_view: int = 0  #: of those, how many showed the marker
    frames_before: int = 0  #: before the first sighting
    first_seen_ns: int | None = None  #: capture of the first frame that showed it
    ranges: list[tuple[int, float]] = field(default_factory=list)  #: one a sighting: capture [ns], error [m]

    @property
    def share_in_view(self) -> float | None:
        """Share of the frames that showed the marker, 0 to 1; None if it was never seen."""
        return self.in_view / self.frames if self.frames else None

    def range_errors_m(self, after_s: float = 0.0) -> list[float]:
        """Return estimated minus wanted distance of each sighting from ``after_s`` after the first one on."""
        begin = (self.first_seen_ns or 0) + nanoseconds(after_s)
        return [error for at_ns, error in self.ranges if at_ns >= begin]

    def count(self, captured_ns: int, range_error_m: float | None) -> None:
        """Count a frame.

        Args:
            captured_ns: Its capture.
            range_error_m: Estimated minus wanted distance; None if the marker was not in the frame.
        """
        if range_error_m is not None:
            if self.first_seen_ns is None:
                self.first_seen_ns = captured_ns
            self.in_view += 1
            self.ranges.append((captured_ns, range_error_m))
        if self.first_seen_ns is None:
            self.frames_before += 1
        else:
            self.frames += 1


class FollowMarker(Behaviour):
    """Finds a marker and follows it. The vehicle must be airborne when :meth:`run` is called.

    Every frame is annotated with what was seen.

    Attributes:
        marker_id: Which marker is followed.
        score: How well it went.
    """

    name = "follow"
    losses = frozenset({Mode.RECOVERING, Mode.SEARCHING})

    def __init__(
        self,
        drone: Drone,
        marker_id: int = 0,
        *,
        size_m: float = 0.3,
        dictionary: str = "4x4_50",
        camera: str | None = None,
        settings: FollowSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly.
            marker_id: Which marker.
            size_m: Edge of the marker's black square.
            dictionary: The marker's dictionary.
            camera: Whose frames to use; None is the vehicle's first camera.
            settings: Of the law; None are the defaults.

        Raises:
            UnknownNameError: There is no such camera or dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        self.marker_id = marker_id
        self.score = FollowScore()
        self._follow_law = FollowLaw(settings)
        self._detector = MarkerDetector(dictionary, size_m)
        super().__init__(drone, self._follow_law, camera)

    @property
    def mode(self) -> Mode:
        """What the behaviour is doing: searching, following or recovering."""
        return self._follow_law.mode

    @property
    def phase(self) -> Mode:
        """The same as :attr:`mode`, by the name that all behaviours have for it."""
        return self.mode

    @property
    def distance_m(self) -> float:
        """The wanted distance from the marker [m]."""
        return self._follow_law.settings.distance_m

    def look(self, frame: Frame) -> list[Shape]:
        """Detect the marker, update the law, and count the frame."""
        seen = self._detector.detect(frame)
        mine = next((one for one in seen if one.id == self.marker_id), None)
        self.score.count(frame.captured_ns, None if mine is None else self._use(mine, frame))
        return self._drawing(frame, seen, mine)

    def _use(self, sighting: MarkerSighting, frame: Frame) -> float:
        """Update the law; return estimated minus wanted distance [m]."""
        place = sighting.position_in_body(self._mounting)
        if frame.feedback is not None:
            normal = sighting.normal_in_body(self._mounting)
            self._follow_law.see(place, normal, frame.feedback, frame.captured_ns, trust=1.0 - sighting.ambiguity)
        return math.hypot(*place) - self.distance_m

    def _drawing(self, frame: Frame, seen: list[MarkerSighting], mine: MarkerSighting | None) -> list[Shape]:
        height, width = frame.shape[:2]
        colour = _COLOURS[self.mode]
        shapes: list[Shape] = [Polyline(one.outline, True, _OTHER) for one in seen if one is not mine]
        if mine is None:
            shapes.append(Text(f"{self.mode} marker {self.marker_id}", (8.0, 16.0), colour))
            return shapes
        outline = mine.outline
        centre = (sum(x for x, _ in outline) / 4, sum(y for _, y in outline) / 4)
        below = (min(x for x, _ in outline), max(y for _, y in outline) + 14.0)
        return [
            *shapes,
            Polyline(((width / 2, height / 2), centre), False, colour),
            Polyline(outline, True, colour),
            Points((outline[0], centre), colour),
            Text(f"marker {mine.id}  {math.hypot(*mine.position_in_body(self._mounting)):.2f} m", below, colour),
        ]
