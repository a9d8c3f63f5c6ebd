"""A behaviour that flies through a series of gates of known colours and sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from skyloop.control.behaviour import LOST, SEARCHING, SEEN, Behaviour
from skyloop.control.course_law import CourseLaw, CourseSettings, GatePlace, Pole
from skyloop.control.gate_law import GateLaw, GatePhase, GateSettings
from skyloop.errors import UsageError
from skyloop.messages import Polyline, Severity, Text
from skyloop.messages.parameter import WorldGeometry
from skyloop.messages.relayed import Shape
from skyloop.vision import GateDetector, GateSighting, PoleDetector

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

_COLOURS = {GatePhase.SEARCHING: SEARCHING, GatePhase.RECOVERING: LOST}


@dataclass(frozen=True, slots=True)
class GateKind:
    """The appearance of a gate on a course."""

    name: str
    colour: tuple[int, int, int]  #: red, green, blue, 0 to 255
    inner_size_m: tuple[float, float] = (1.2, 1.2)  #: width and height of the opening
    turning: float = 1.0  #: direction to turn first if the gate is out of view: positive for left, negative for right


#: The gates in the simulated world ``gates``.
FIVE_GATES = (
    GateKind("gate 1", (235, 110, 20)),
    GateKind("gate 2", (31, 143, 224)),
    GateKind("gate 3", (224, 194, 31)),
    GateKind("gate 4", (57, 181, 74)),
    GateKind("gate 5", (194, 63, 180)),
)


@dataclass(frozen=True, slots=True)
class Course:
    """A course with a map of its gates and poles, in the axes and yaw convention of the vehicle [m, rad]."""

    gates: tuple[GateKind, ...]  #: gates in order
    places: tuple[GatePlace, ...]  #: positions of the gates
    poles: tuple[Pole, ...] = ()  #: other obstacles
    #: red, green and blue, 0 to 255; None if the camera can't recognise poles by colour
    pole_colour: tuple[int, int, int] | None = None
    start: tuple[float, float] = (0.0, 0.0)  #: take-off position: x and y [m]
    map_m: float = 0.05  #: standard deviation of the positions [m]

    def __post_init__(self) -> None:
        if len(self.gates) != len(self.places):
            raise UsageError(f"each gate needs one place: got {len(self.gates)} gates and {len(self.places)} places")


#: The gates in the simulated worlds ``race0`` to ``race3``.
RACE_GATES = (
    GateKind("gate 1", (31, 143, 224)),
    GateKind("gate 2", (224, 194, 31)),
    GateKind("gate 3", (57, 181, 74)),
    GateKind("gate 4", (194, 63, 180)),
)
RACE_POLES = (208, 31, 31)  #: colour of the poles in these worlds
#: The track in the world ``race0``. The seed moves the start in ``race1`` and ``race2``, and in ``race2`` the gates and
#: poles as well, by up to 0.45 m along each horizontal axis.
RACE_TRACK = Course(
    RACE_GATES,
    (
        GatePlace(1.5, 0.75, 1.05, math.radians(-44.7)),
        GatePlace(3.15, 2.25, 1.8, math.radians(134.6)),
        GatePlace(-3.0, -0.75, 1.05, math.radians(179.9)),
        GatePlace(0.0, -2.25, 1.8, 0.0),
    ),
    (Pole(0.0, 2.25), Pole(3.0, 0.75), Pole(-4.5, -0.75), Pole(-1.5, -2.25)),
    RACE_POLES,
    start=(-4.5, 2.25),
)


def course_in(geometry: WorldGeometry, gates: Sequence[GateKind] = RACE_GATES) -> Course:
    """Build a course from a simulated world's map, using the named gates, the first start position and all poles.

    Args:
        geometry: The world's map, from a simulated drone's parameter ``world.geometry``.
        gates: The gates of the course, in order, named as in the world.

    Raises:
        UsageError: The world lacks one of the gates or has no start position.
    """
    openings = {opening.name: opening for opening in geometry.gates}
    if missing := [gate.name for gate in gates if gate.name not in openings]:
        raise UsageError(f"world {geometry.name!r} has no {', '.join(missing)}; its gates are {', '.join(openings)}")
    if not geometry.starts:
        raise UsageError(f"world {geometry.name!r} has no start")
    places = (openings[gate.name] for gate in gates)
    return Course(
        tuple(gates),
        tuple(GatePlace(*place.position, place.yaw) for place in places),
        tuple(Pole(*s.position[:2], s.size[0] / 2, s.size[2]) for s in geometry.solids if s.name.startswith("pole")),
        RACE_POLES,
        geometry.starts[0].position[:2],
    )


class FlyThroughGates(Behaviour):
    """Flies through a series of gates of known colours and hovers behind the last one.

    Given a :class:`Course`, it follows the map and corrects it with camera sightings. It flies around poles and other
    gates to the front of each gate, then through it in the gate's direction. If a gate stays out of sight, the vehicle
    hovers and the behaviour ends with a warning.

    Gates are detected by colour. After losing sight of a gate, the vehicle holds its position, turns to where it
    expects the gate, and then searches for it. The vehicle must be airborne when :meth:`run` is called.

    Attributes:
        passed: Number of gates flown through.
    """

    name = "gates"
    losses = frozenset({GatePhase.RECOVERING, GatePhase.SEARCHING})

    def __init__(
        self,
        drone: Drone,
        gates: Sequence[GateKind] | Course = FIVE_GATES,
        *,
        camera: str | None = None,
        settings: GateSettings | CourseSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly.
            gates: The gates in order, or a course with a map.
            camera: Camera to use; None for the vehicle's first camera.
            settings: :class:`CourseSettings` for a course, :class:`GateSettings` for gates; None for the defaults.

        Raises:
            UsageError: There are no gates, a colour has no hue, or the settings are for the other control law.
            UnknownNameError: The vehicle has no such camera.
            MissingExtraError: OpenCV is not installed.
        """
        course = gates if isinstance(gates, Course) else None
        self._gates = gates.gates if isinstance(gates, Course) else tuple(gates)
        if not self._gates:
            raise UsageError("there is no gate to fly through")
        self._detectors = [GateDetector(gate.colour, gate.inner_size_m) for gate in self._gates]
        self._poles: PoleDetector | None = None
        if course is None:
            if isinstance(settings, CourseSettings):
                raise UsageError("CourseSettings need a course with a map: give a Course, or GateSettings")
            self._gate_law: GateLaw | CourseLaw = GateLaw(settings)
            self._gate_law.next_gate(turning=self._gates[0].turning)
        else:
            if isinstance(settings, GateSettings):
                raise UsageError("a course with a map needs CourseSettings, not GateSettings")
            widths = [gate.inner_size_m[0] for gate in course.gates]
            wanted = settings or replace(CourseSettings(), map_m=course.map_m)
            self._gate_law = CourseLaw(course.places, widths, course.poles, course.start, wanted)
            if course.poles and course.pole_colour is not None:
                self._poles = PoleDetector(course.pole_colour)
        self.passed = 0
        super().__init__(drone, self._gate_law, camera)

    @property
    def phase(self) -> GatePhase:
        """The current phase."""
        return self._gate_law.phase

    @property
    def gate(self) -> GateKind | None:
        """The next gate; None after the last one."""
        return self._gates[self.passed] if self.passed < len(self._gates) else None

    def look(self, frame: Frame) -> list[Shape]:
        """Detect the next gate and any poles on the map, update the law, and end the behaviour if the law is stuck."""
        if self.phase is GatePhase.PASSED:
            self._next()
        gate = self.gate
        if gate is None:
            return []
        seen = self._detectors[self.passed].detect(frame)
        if seen and frame.feedback is not None:
            nearest = seen[0]
            self._gate_law.see(
                nearest.position_in_body(self._mounting),
                nearest.normal_in_body(self._mounting),
                frame.feedback,
                frame.captured_ns,
                trust=1.0 - nearest.ambiguity,
            )
        law = self._gate_law
        if isinstance(law, CourseLaw):
            if self._poles is not None and frame.feedback is not None:
                for pole in self._poles.detect(frame):
                    law.see_pole(pole.ray_in_body(self._mounting), frame.feedback, frame.captured_ns)
            if law.stuck is not None and not self.done:
                self.finish(law.stuck, Severity.WARNING)
        return self._drawing(gate, seen)

    def _next(self) -> None:
        before = self._gates[self.passed]
        self.passed += 1
        gate = self.gate
        if gate is None:
            self.finish(f"through {before.name}, the last of {len(self._gates)}")
        else:
            self.emit(f"through {before.name}, next is {gate.name}")
            if isinstance(self._gate_law, CourseLaw):
                self._gate_law.next_gate()
            else:
                self._gate_law.next_gate(turning=gate.turning)

    def _drawing(self, gate: GateKind, seen: list[GateSighting]) -> list[Shape]:
        colour = _COLOURS.get(self.phase, SEEN)
        shapes: list[Shape] = [Text(f"{gate.name}: {self.phase.value}", (8.0, 16.0), colour)]
        for one in seen[:1]:
            x, y = one.outline[3]
            shapes += [Polyline(one.outline, True, colour), Text(f"{one.distance_m:.2f} m", (x, y + 14.0), colour)]
        return shapes
