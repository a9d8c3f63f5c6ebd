"""Tracks who controls the vehicle: this program, another operator, or the vehicle's own failsafe. Pure.

A remote control, a ground station or the autopilot itself may change the mode. Skyloop leaves the vehicle in a mode
that it did not choose; only a new action from an application takes the vehicle back.
"""

from __future__ import annotations

from typing import Final

from skyloop.clock import nanoseconds
from skyloop.errors import DriverError
from skyloop.messages import AnyAction, Attitude, Position, Velocity
from skyloop.vehicles.mavlink.autopilots import AutopilotProfile
from skyloop.vehicles.mavlink.manoeuvres import STRAYED_NS
from skyloop.vehicles.mavlink.telemetry import VehicleState

LATE_NS: Final = nanoseconds(3.0)  #: longest delay before a requested mode change takes effect
PAUSE_NS: Final = nanoseconds(0.5)  #: pause after which the same action is a new decision, not a repeat
_SET_POINTS: Final = (Velocity, Attitude, Position)


class FlightOwnership:
    """Decides who is flying, based on the modes that the vehicle reports and the modes requested here."""

    def __init__(self, autopilot: AutopilotProfile) -> None:
        self.foreign_mode = ""  #: mode, not chosen here, that now flies the vehicle; empty if there is none
        self._autopilot = autopilot
        self._by_itself = False  # whether its own failsafe chose the mode, in which we may still hold or land it
        self._steering = False  # whether this program started or took over the flight
        self._from = ""  # the mode at the time of the last decision; empty once one of our modes has been reported
        self._foreign_ns: int | None = None  # when the vehicle entered a mode that was not chosen here
        self._applied: tuple[type[AnyAction] | None, int] = (None, 0)  # type and time of the last action
        self._repeated: type[AnyAction] | None = None  # the type of action whose repeats don't take the vehicle back
        self._asked: dict[str, int] = {}  # when each mode was last requested

    @property
    def others(self) -> str:
        """The mode in which another operator is flying the vehicle; empty if there is none."""
        return "" if self._by_itself else self.foreign_mode

    def is_foreign(self, vehicle: VehicleState) -> bool:
        """Return whether the mode can't be the result of any decision made here."""
        autopilot, mode = self._autopilot, vehicle.mode
        if mode in (autopilot.GUIDED, autopilot.HOLD, autopilot.ARMING, self._from) or mode in autopilot.TAKING_OFF:
            return False
        if mode in autopilot.LANDING and autopilot.LAND in self._asked:
            return False
        return not self._is_left_to_nobody(vehicle)

    def _is_left_to_nobody(self, vehicle: VehicleState) -> bool:
        """Return whether the vehicle's failsafe chose a mode in which it sinks unless a pilot is at the sticks."""
        return vehicle.failsafe and vehicle.mode in self._autopilot.NEEDS_STICKS and not vehicle.remote

    # Decisions ---------------------------------------------------------------------------------------------------

    def check(self, action: AnyAction, now_ns: int, *, new: bool) -> None:
        """Refuse an action that would take the vehicle from another operator without a new decision to do so.

        Repeating the same action in a loop does not count as a new decision. Raises :class:`DriverError`.
        """
        (_, at_ns), self._applied = self._applied, (type(action), now_ns)
        if not self.foreign_mode:
            return
        decided = new and (type(action) is not self._repeated or now_ns - at_ns > PAUSE_NS)
        if isinstance(action, _SET_POINTS) or not decided:
            raise DriverError(
                f"the vehicle is in {self.foreign_mode}, which was not chosen here: "
                "hover, take off or land first to take it over"
            )
        self._repeated = None

    def take(self, action: AnyAction, vehicle: VehicleState | None, *, alone: bool, new: bool) -> None:
        """Record that this action puts the vehicle under our control.

        ``alone``: whether a failsafe requested it with no pilot in command; ``new``: whether an application just did.
        """
        begins = not self._steering or not isinstance(action, _SET_POINTS)
        if alone or (new and begins):
            self._from = "" if vehicle is None else vehicle.mode
        self._steering, self._by_itself, self.foreign_mode = True, False, ""

    def on_mode_asked(self, mode: str, now_ns: int) -> None:
        """Record that we requested a mode."""
        self._asked[mode] = now_ns

    def was_just_asked(self, mode: str, now_ns: int) -> bool:
        """Return whether a mode may be the delayed effect of our own command."""
        return now_ns - self._asked.get(mode, -LATE_NS) < LATE_NS

    # Reports of the vehicle --------------------------------------------------------------------------------------

    def on_mode(self, mode: str) -> None:
        """Record that the vehicle left the mode of the last decision; a return to it is another operator's choice."""
        if mode != self._from:
            self._from = ""

    def observe(self, vehicle: VehicleState, now_ns: int) -> bool:
        """Return whether a vehicle that we were flying is in a foreign mode, so that nothing is sent to it."""
        if not self._steering or not self.is_foreign(vehicle):
            self._foreign_ns = None
            self.on_mode(vehicle.mode)
            return False
        if self._foreign_ns is None:
            self._foreign_ns = now_ns
        return True

    def is_lost(self, now_ns: int) -> bool:
        """Return whether the foreign mode has lasted long enough for us to give up control."""
        return self._foreign_ns is not None and now_ns - self._foreign_ns >= STRAYED_NS

    def leave(self, vehicle: VehicleState) -> bool:
        """Leave the vehicle in its present mode; return whether we may still hold or land it."""
        self.foreign_mode, self._repeated = vehicle.mode, self._applied[0]
        self._asked.clear()
        self._by_itself = self._steering = self._is_left_to_nobody(vehicle)
        return self._by_itself

    def on_link_lost(self) -> None:
        """When the vehicle is found again, treat its mode as chosen by others unless the proxy chose it."""
        self._from = ""

    def on_flight_over(self) -> None:
        """Discard the state of the flight: the vehicle is on the ground, and its next pilot starts from scratch."""
        self._steering, self._by_itself, self.foreign_mode, self._from = False, False, "", ""
        self._foreign_ns, self._repeated = None, None
        self._asked.clear()
