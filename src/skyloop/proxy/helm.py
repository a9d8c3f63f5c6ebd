"""The one hand on the driver: what the vehicle takes goes to it, the rest to the software autopilot.

Not thread-safe: the flight's lock is held around every call, which keeps the driver's calls one at a time.
"""

from __future__ import annotations

from skyloop.drivers.base import Driver
from skyloop.messages import (
    ACTION_NAMES,
    Action,
    AnyAction,
    Attitude,
    Capabilities,
    FlightState,
    Hover,
    Idle,
    Land,
    Takeoff,
    Velocity,
)
from skyloop.proxy.autopilot import Autopilot, software_actions
from skyloop.proxy.vehicle import Vehicle

_FLYING = (Takeoff, Hover, Attitude, Velocity)


class Helm:
    """Makes the vehicle do things."""

    def __init__(self, driver: Driver, capabilities: Capabilities, vehicle: Vehicle) -> None:
        software = software_actions(capabilities.actions)
        self.native = frozenset(kind for kind, name in ACTION_NAMES.items() if name in capabilities.actions)
        self.supported: frozenset[type[Action]] = self.native | {
            kind for kind, name in ACTION_NAMES.items() if name in software
        }
        self.why_not = capabilities.why_not
        self.autopilot = Autopilot(capabilities.actions) if software else None
        if self.autopilot is not None:
            vehicle.state_of = self.autopilot.state
        self._driver = driver
        self._vehicle = vehicle
        self._in_force: AnyAction = Idle()
        self._noticed = False

    @property
    def state(self) -> FlightState:
        """The flight state now, which may be newer than the last feedback."""
        return self._vehicle.state_of(self._vehicle.told_state)

    @property
    def airborne(self) -> bool:
        """Whether the vehicle flies, or may: one that never tells its state does from its first command on."""
        state = self.state
        return state.airborne or (state is FlightState.UNKNOWN and isinstance(self._in_force, _FLYING))

    def execute(self, action: AnyAction, now_ns: int) -> AnyAction:
        """Do a supported action and return what was really applied. Raises what the driver raises."""
        if type(action) in self.native:
            applied = self._driver.apply(action)
            if self.autopilot is not None:
                self.autopilot.stop(action.name)
        else:
            self._start(action, now_ns)
            applied = action
        self._in_force = applied
        return applied

    def failsafe(self, action: Hover | Land, now_ns: int) -> bool:
        """Do this with nobody at the controls; whether it was taken. The driver tells its own failure."""
        if type(action) in self.native:
            try:
                taken = self._driver.failsafe(action)
            except Exception as error:  # noqa: BLE001  it is told, and tried again
                self._vehicle.driver_failed("failsafe", error)
                return False
            if taken and self.autopilot is not None:
                self.autopilot.stop(action.name)
        elif type(action) in self.supported:
            self._start(action, now_ns)
            taken = True
        else:
            return False
        if taken:
            self._in_force = action
        return taken

    def step(self, now_ns: int) -> AnyAction | None:
        """Let the software autopilot steer, if it does; what it made the driver apply."""
        if self.autopilot is None:
            return None
        feedback = self._vehicle.feedback_now
        if not self._noticed and feedback is not None and feedback.altitude is not None:
            self._noticed = True
            self.autopilot.notice(feedback)
        action = self.autopilot.step(now_ns, feedback)
        if action is None:
            return None
        try:
            return self._driver.apply(action)
        except Exception as error:  # noqa: BLE001  it is told, and the next step tries again
            self._vehicle.driver_failed("autopilot", error)
            return None

    def _start(self, action: AnyAction, now_ns: int) -> None:
        assert self.autopilot is not None
        assert isinstance(action, Takeoff | Hover | Land | Velocity)
        self.autopilot.start(action, now_ns, self._vehicle.feedback_now)
