"""Land on a marker that the downward camera sees, also when the marker moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from skyloop.control.behaviour import Behaviour
from skyloop.control.landing_law import LandingLaw, LandingPhase
from skyloop.control.landing_settings import LandingSettings
from skyloop.errors import UsageError
from skyloop.extend import let_go
from skyloop.messages import FlightState, Polyline, Severity, Text
from skyloop.messages.relayed import Colour, Shape
from skyloop.vision import MarkerDetector

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.messages import Attitude, Feedback, Velocity

_LOOKING: Colour = (120, 190, 255)
_SEEN: Colour = (64, 220, 100)


class LandOnMarker(Behaviour):
    """Searches the marker on a spiral, flies over it, descends with it, and stops the motors when it has landed.

    A marker that is lost on the way makes the vehicle climb where the marker must be, then search. Low over the marker,
    where it no longer fits into the image, the vehicle descends by the marker's predicted motion; it aborts and tries
    again where it would miss. After too many aborted attempts, or too long a time, it climbs to a safe height, hovers
    there, and :meth:`run` returns with :attr:`landed` false; so it does where others land the vehicle. The vehicle must
    be airborne when :meth:`run` is called; a :meth:`run` that ends earlier leaves it hovering where it is.

    Attributes:
        marker_id: Which marker.
    """

    name = "landing"
    losses = frozenset({LandingPhase.RECOVERING, LandingPhase.SEARCHING})

    def __init__(
        self,
        drone: Drone,
        marker_id: int = 30,
        *,
        size_m: float = 0.2,
        dictionary: str = "4x4_50",
        camera: str = "bottom",
        settings: LandingSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly.
            marker_id: Which marker.
            size_m: Edge of the marker's black square.
            dictionary: The marker's dictionary.
            camera: One that looks down.
            settings: Of the law; None are the defaults. They are brought within the drone's ``limits.*``.

        Raises:
            UnknownNameError: There is no such camera or dictionary.
            UsageError: The vehicle can't land by itself.
            MissingExtraError: OpenCV is not installed.
        """
        if "land" not in drone.capabilities.actions:
            raise UsageError("this vehicle can't land by itself")
        limits = {parameter.name: parameter.value for parameter in drone.config.parameters()}
        self._landing_law = LandingLaw((settings or LandingSettings()).within(limits))
        self._detector = MarkerDetector(dictionary, size_m)
        self.marker_id = marker_id
        self._flew = False
        super().__init__(drone, self._landing_law, camera)

    @property
    def phase(self) -> LandingPhase:
        """What the behaviour is doing."""
        return self._landing_law.phase

    @property
    def landed(self) -> bool:
        """Whether the vehicle stands on the marker."""
        return self.done and self.phase is LandingPhase.DOWN

    def on_feedback(self, feedback: Feedback) -> None:
        """Update the law and send its set-point; once it is down, wait until the vehicle reports that it has landed."""
        self._flew = self._flew or feedback.state.airborne
        down = self.phase is LandingPhase.DOWN
        if self._flew and feedback.state is FlightState.LANDED and not self.done:
            self.done = True
            text = "standing on the marker" if down else "the vehicle was landed, and not by this behaviour"
            self.emit(text, Severity.INFO if down else Severity.WARNING)
            self._end()
        if down or self.done:
            self._landing_law.feedback(feedback)  # others may take over and fly it from here
            return
        super().on_feedback(feedback)
        if self._frame_ns is not None and not self.blind and not self.done:
            self.fly(self.drone.now_ns)  # by each sample, and not by frames alone: gusts are answered sooner

    def on_frame(self, frame: Frame) -> None:
        """Search the frame; end the behaviour where the law has given up."""
        super().on_frame(frame)
        if not self.done and self._landing_law.safe(frame.captured_ns):
            self.finish("gave up: hovering at a safe height", Severity.WARNING)

    def look(self, frame: Frame) -> list[Shape]:
        """Detect the marker and update the law."""
        law = self._landing_law
        mine = next((one for one in self._detector.detect(frame) if one.id == self.marker_id), None)
        if mine is None:
            return [Text(f"marker {self.marker_id}: {self.phase.value}", (8.0, 16.0), _LOOKING)]
        if frame.feedback is not None:
            law.see(mine.position_in_body(self._mounting), frame.feedback, frame.captured_ns)
        shapes: list[Shape] = [
            Text(f"marker {self.marker_id}: {self.phase.value}", (8.0, 16.0), _SEEN),
            Polyline(mine.outline, True, _SEEN),
        ]
        if law.height_m is not None and law.target_speed_m_s is not None:
            shapes.append(Text(f"{law.height_m:.2f} m over it, at {law.target_speed_m_s:.2f} m/s", (8.0, 32.0), _SEEN))
        return shapes

    def steer(self, wanted: Velocity | Attitude) -> None:
        """Send velocities until the law is down; then let the vehicle's own landing stop the motors."""
        if self.phase is LandingPhase.DOWN:
            # Each step anew: a link that is down for a moment ends no landing.
            let_go(self.drone, "it is down on its marker", land=True)
        else:
            super().steer(wanted)
