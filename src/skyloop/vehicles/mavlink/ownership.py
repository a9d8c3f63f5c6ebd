"""Ownership of the vehicle: this program, another operator, or the vehicle's own failsafe. Pure.

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

LATE_NS: Final = nanoseconds(3.0)  #: how late a requested mode change may take effect
PAUSE_NS: Final = nanoseconds(0.5)  #: the same action after a longer pause is a new decision, not a repeat
_SET_POINTS: Final = (Velocity, Attitude, Position)


class FlightOwnership:
    """Ownership of the flight, judged by the reported modes and the modes requested here."""

    def __init__(self, autopilot: AutopilotProfile) -> None:
        self.left_to = ""  #: a mode chosen elsewhere that flies the vehicle now; empty: ours, or without a pilot
        self._autopilot = autopilot
        self._by_itself = False  # its own failsafe chose the mode: the vehicle is still ours to hold and to land
        self._steering = False  # this flight was started or taken over here
        self._from = ""  # the mode at the last decision; empty once one of our modes has been reported
        self._foreign_ns: int | None = None  # when the vehicle entered a mode that was not chosen here
        self._applied: tuple[type[AnyAction] | None, int] = (None, 0)  # kind and time of the last action
        self._repeated: type[AnyAction] | None = None  # the action whose repeats don't take the vehicle back
        self._asked: dict[str, int] = {}  # when each mode was last requested

    @property
    def others(self) -> str:
        """The mode in which another operator flies the vehicle; empty if there is none."""
        return "" if self._by_itself else self.left_to

    def is_foreign(self, vehicle: VehicleState) -> bool:
        """Return whether the mode can't follow from any decision made here."""
        autopilot, mode = self._autopilot, vehicle.mode
        if mode in (autopilot.GUIDED, autopilot.HOLD, autopilot.ARMING, self._from) or mode in autopilot.TAKING_OFF:
            return False
        if mode in autopilot.LANDING and autopilot.LAND in self._asked:
            return False
        return not self._is_left_to_nobody(vehicle)

    def _is_left_to_nobody(self, vehicle: VehicleState) -> bool:
        """Return whether its failsafe chose a mode that sinks without a pilot at the sticks."""
        return vehicle.failsafe and vehicle.mode in self._autopilot.NEEDS_STICKS and not vehicle.remote

    # Decisions ---------------------------------------------------------------------------------------------------

    def check(self, action: AnyAction, now_ns: int, *, new: bool) -> None:
        """Refuse an action that would take the vehicle from another operator without a new decision to do so.

        A program that repeats the same action in a loop makes no new decision either.

        Args:
            action: The requested action.
            now_ns: The present time.
            new: Whether an application newly requested it.

        Raises:
            DriverError: Another operator has the vehicle.
        """
        (_, at_ns), self._applied = self._applied, (type(action), now_ns)
        if not self.left_to:
            return
        decided = new and (type(action) is not self._repeated or now_ns - at_ns > PAUSE_NS)
        if isinstance(action, _SET_POINTS) or not decided:
            raise DriverError(
                f"the vehicle is in {self.left_to}, which was not chosen here: "
                "hover, take off or land first to take it over"
            )
        self._repeated = None

    def take(self, action: AnyAction, vehicle: VehicleState | None, *, alone: bool, new: bool) -> None:
        """Record that this action now flies the vehicle from here.

        Args:
            action: The accepted action.
            vehicle: The vehicle's state; None while nothing is received.
            alone: Whether a failsafe requested it, without a pilot in command.
            new: Whether an application newly requested it.
        """
        begins = not self._steering or not isinstance(action, _SET_POINTS)
        if alone or (new and begins):
            self._from = "" if vehicle is None else vehicle.mode
        self._steering, self._by_itself, self.left_to = True, False, ""

    def on_mode_asked(self, mode: str, now_ns: int) -> None:
        """Record a mode request made here."""
        self._asked[mode] = now_ns

    def was_just_asked(self, mode: str, now_ns: int) -> bool:
        """Return whether a mode may be the late effect of our own command."""
        return now_ns - self._asked.get(mode, -LATE_NS) < LATE_NS

    # Reports of the vehicle --------------------------------------------------------------------------------------

    def on_mode(self, mode: str) -> None:
        """Record that the vehicle left the mode of the last decision: a return to it is another operator's choice."""
        if mode != self._from:
            self._from = ""

    def observe(self, vehicle: VehicleState, now_ns: int) -> bool:
        """Return whether a vehicle flown from here is in a foreign mode, in which nothing is sent to it."""
        if not self._steering or not self.is_foreign(vehicle):
            self._foreign_ns = None
            self.on_mode(vehicle.mode)
            return False
        if self._foreign_ns is None:
            self._foreign_ns = now_ns
        return True

    def is_lost(self, now_ns: int) -> bool:
        """Return whether the foreign mode has lasted long enough to leave the vehicle to it."""
        return self._foreign_ns is not None and now_ns - self._foreign_ns >= STRAYED_NS

    def leave(self, vehicle: VehicleState) -> bool:
        """Leave the vehicle in its present mode; return whether it is still ours to hold and to land."""
        self.left_to, self._repeated = vehicle.mode, self._applied[0]
        self._asked.clear()
        self._by_itself = self._steering = self._is_left_to_nobody(vehicle)
        return self._by_itself

    def on_link_lost(self) -> None:
        """Treat whatever mode the vehicle is found in again as foreign, unless it was chosen here."""
        self._from = ""

    def on_flight_over(self) -> None:
        """Forget the flight: the vehicle is on the ground, and its next pilot starts over."""
        self._steering, self._by_itself, self.left_to, self._from = False, False, "", ""
        self._foreign_ns, self._repeated = None, None
        self._asked.clear()
