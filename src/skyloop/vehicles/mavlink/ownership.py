"""Whose the vehicle is: flown from here, by somebody else, or left by its own failsafe. Pure.

A remote control, a ground station and the autopilot itself change the mode. A mode that was not chosen here is left
alone, and only an action that an application newly asked for takes the vehicle back.
"""

from __future__ import annotations

from typing import Final

from skyloop.clock import nanoseconds
from skyloop.errors import DriverError
from skyloop.messages import AnyAction, Attitude, Position, Velocity
from skyloop.vehicles.mavlink.autopilots import AutopilotProfile
from skyloop.vehicles.mavlink.manoeuvres import STRAYED_NS
from skyloop.vehicles.mavlink.telemetry import VehicleState

LATE_NS: Final = nanoseconds(3.0)  #: a command to change the mode may take effect so much later
PAUSE_NS: Final = nanoseconds(0.5)  #: an action after such a pause is no repeat
_SET_POINTS: Final = (Velocity, Attitude, Position)


class FlightOwnership:
    """Judges each mode that the vehicle reports by what was asked for here."""

    def __init__(self, autopilot: AutopilotProfile) -> None:
        self.left_to = ""  #: the mode that was not chosen here; empty: we are in command, or nobody is
        self._autopilot = autopilot
        self._by_itself = False  # it came there by its own failsafe, and is still ours to hold and to land
        self._steering = False  # this flight was begun, or taken, here
        self._from = ""  # the mode that it was in at the last decision; empty: one of ours was reported since
        self._foreign_ns: int | None = None  # since when it is in a mode that was not chosen here
        self._applied: tuple[type[AnyAction] | None, int] = (None, 0)  # the last action's kind, and when
        self._repeated: type[AnyAction] | None = None  # the action whose repeats don't take the vehicle back
        self._asked: dict[str, int] = {}  # modes, and when they were asked for last

    @property
    def others(self) -> str:
        """The mode that somebody else put the vehicle into, and flies it in; empty: none."""
        return "" if self._by_itself else self.left_to

    def is_foreign(self, vehicle: VehicleState) -> bool:
        """Return whether the mode is none that follows from what was decided here."""
        autopilot, mode = self._autopilot, vehicle.mode
        if mode in (autopilot.GUIDED, autopilot.HOLD, autopilot.ARMING, self._from) or mode in autopilot.TAKING_OFF:
            return False
        if mode in autopilot.LANDING and autopilot.LAND in self._asked:
            return False
        return not self._is_left_to_nobody(vehicle)

    def _is_left_to_nobody(self, vehicle: VehicleState) -> bool:
        """Return whether its own failsafe has handed it to sticks that nobody may hold: without them it sinks."""
        return vehicle.failsafe and vehicle.mode in self._autopilot.NEEDS_STICKS and not vehicle.remote

    # What is decided here ----------------------------------------------------------------------------------------

    def check(self, action: AnyAction, now_ns: int, *, new: bool) -> None:
        """Refuse an action that would take the vehicle from somebody else without a new decision to do so.

        A program that repeats the same action in a loop decides nothing new either.

        Args:
            action: What is asked for.
            now_ns: The present time.
            new: Whether an application newly asked for it.

        Raises:
            DriverError: Somebody else has the vehicle.
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
        """Note that the vehicle is flown from here now, by this action.

        Args:
            action: What was accepted.
            vehicle: What is known of it; None while nothing is received.
            alone: Whether nobody is in command: a failsafe.
            new: Whether an application newly asked for it.
        """
        begins = not self._steering or not isinstance(action, _SET_POINTS)
        if alone or (new and begins):
            self._from = "" if vehicle is None else vehicle.mode
        self._steering, self._by_itself, self.left_to = True, False, ""

    def on_mode_asked(self, mode: str, now_ns: int) -> None:
        """Note that a mode was asked for here."""
        self._asked[mode] = now_ns

    def was_just_asked(self, mode: str, now_ns: int) -> bool:
        """Return whether a mode may be the late effect of a command of ours."""
        return now_ns - self._asked.get(mode, -LATE_NS) < LATE_NS

    # What the vehicle reports ------------------------------------------------------------------------------------

    def on_mode(self, mode: str) -> None:
        """Note that it left the mode in which it was found at the last decision: back there it is by somebody else."""
        if mode != self._from:
            self._from = ""

    def observe(self, vehicle: VehicleState, now_ns: int) -> bool:
        """Return whether a vehicle that was flown from here is in a foreign mode: nothing is sent to it then."""
        if not self._steering or not self.is_foreign(vehicle):
            self._foreign_ns = None
            self.on_mode(vehicle.mode)
            return False
        if self._foreign_ns is None:
            self._foreign_ns = now_ns
        return True

    def is_lost(self, now_ns: int) -> bool:
        """Return whether the foreign mode has lasted for so long that the vehicle is left to it."""
        return self._foreign_ns is not None and now_ns - self._foreign_ns >= STRAYED_NS

    def leave(self, vehicle: VehicleState) -> bool:
        """Leave the vehicle to the mode that it is in; return whether it is still ours to hold and to land."""
        self.left_to, self._repeated = vehicle.mode, self._applied[0]
        self._asked.clear()
        self._by_itself = self._steering = self._is_left_to_nobody(vehicle)
        return self._by_itself

    def on_link_lost(self) -> None:
        """Take whatever mode the vehicle is found in again for foreign, unless it was chosen here."""
        self._from = ""

    def on_flight_over(self) -> None:
        """Forget the flight: the vehicle stands, and the next to fly it starts over."""
        self._steering, self._by_itself, self.left_to, self._from = False, False, "", ""
        self._foreign_ns, self._repeated = None, None
        self._asked.clear()
