"""Fly through gates of known colours and sizes, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from skyloop.control.behaviour import Behaviour
from skyloop.control.gate_law import GateLaw, GatePhase, GateSettings
from skyloop.errors import UsageError
from skyloop.messages import Polyline, Text
from skyloop.messages.annotation import Colour, Shape
from skyloop.vision import GateDetector, GateSighting

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

_COLOURS: dict[GatePhase, Colour] = {
    GatePhase.SEARCHING: (120, 190, 255),
    GatePhase.RECOVERING: (255, 180, 60),
}
_SEEN: Colour = (64, 220, 100)


@dataclass(frozen=True, slots=True)
class GateKind:
    """What one gate of a course looks like."""

    name: str
    colour: tuple[int, int, int]  #: red, green, blue, 0 to 255
    inner_size_m: tuple[float, float] = (1.2, 1.2)  #: width and height of the opening
    turning: float = 1.0  #: which way to turn first when it is not in view: above 0 to the left, below to the right


#: The course of the world ``gates``.
FIVE_GATES = (
    GateKind("gate 1", (235, 110, 20)),
    GateKind("gate 2", (31, 143, 224)),
    GateKind("gate 3", (224, 194, 31)),
    GateKind("gate 4", (57, 181, 74)),
    GateKind("gate 5", (194, 63, 180)),
)


class FlyThroughGates(Behaviour):
    """Flies through gates of known colours, one after the other, and hovers behind the last.

    Each gate is searched by its colour. A gate that is lost on the way makes the vehicle hold its position and turn to
    where the gate must be, then search for it again. The vehicle must be airborne when :meth:`run` is called.

    Attributes:
        passed: How many gates were flown through.
    """

    name = "gates"
    losses = frozenset({GatePhase.RECOVERING, GatePhase.SEARCHING})

    def __init__(
        self,
        drone: Drone,
        gates: Sequence[GateKind] = FIVE_GATES,
        *,
        camera: str | None = None,
        settings: GateSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly.
            gates: The course, in order.
            camera: Whose frames to use; None is the vehicle's first camera.
            settings: Of the law; None are the defaults.

        Raises:
            UsageError: There is no gate, or a colour has no hue.
            UnknownNameError: The vehicle has no such camera.
            MissingExtraError: OpenCV is not installed.
        """
        if not gates:
            raise UsageError("there is no gate to fly through")
        self._gates = tuple(gates)
        self._detectors = [GateDetector(gate.colour, gate.inner_size_m) for gate in self._gates]
        self._gate_law = GateLaw(settings)
        self._gate_law.next_gate(turning=self._gates[0].turning)
        self.passed = 0
        super().__init__(drone, self._gate_law, camera)

    @property
    def phase(self) -> GatePhase:
        """What the behaviour is doing."""
        return self._gate_law.phase

    @property
    def gate(self) -> GateKind | None:
        """The gate that is next; None when all are passed."""
        return self._gates[self.passed] if self.passed < len(self._gates) else None

    def look(self, frame: Frame) -> list[Shape]:
        """Detect the nearest gate of the colour that is next, and update the law."""
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
        return self._drawing(gate, seen)

    def _next(self) -> None:
        before = self._gates[self.passed]
        self.passed += 1
        gate = self.gate
        if gate is None:
            self.finish(f"through {before.name}, the last of {len(self._gates)}")
        else:
            self.emit(f"through {before.name}, on to {gate.name}")
            self._gate_law.next_gate(turning=gate.turning)

    def _drawing(self, gate: GateKind, seen: list[GateSighting]) -> list[Shape]:
        colour = _COLOURS.get(self.phase, _SEEN)
        shapes: list[Shape] = [Text(f"{gate.name}: {self.phase.value}", (8.0, 16.0), colour)]
        for one in seen[:1]:
            x, y = one.outline[3]
            shapes += [Polyline(one.outline, True, colour), Text(f"{one.distance_m:.2f} m", (x, y + 14.0), colour)]
        return shapes
