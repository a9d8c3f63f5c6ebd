"""A vehicle that records its commands, and an emulated drone on a manual clock."""

from __future__ import annotations

from dataclasses import replace

from skyloop.clock import ManualClock
from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    FlightState,
    Hover,
    Idle,
    Land,
    ResetEmergency,
    Takeoff,
)
from skyloop.sim.parameters import Limits
from skyloop.sim.reports import VehicleFeedback
from skyloop.vehicles.ardrone.emulator.logic import ArdroneLogic
from skyloop.vehicles.ardrone.wire.at import Argument, format_command
from skyloop.vehicles.ardrone.wire.navdata import State

RESTING = VehicleFeedback(
    time_s=0.0,
    state=FlightState.LANDED,
    emergency_reason="",
    battery=1.0,
    battery_v=12.3,
    roll_rad=0.0,
    pitch_rad=0.0,
    yaw_rad=0.0,
    altitude_m=0.0,
    velocity_m_s=(0.0, 0.0, 0.0),
    angular_velocity_rad_s=(0.0, 0.0, 0.0),
    acceleration_m_s2=(0.0, 0.0, 9.80665),
)

_NEXT = {
    Takeoff: FlightState.TAKING_OFF,
    Land: FlightState.LANDING,
    Hover: FlightState.HOVERING,
    Attitude: FlightState.FLYING,
    EmergencyStop: FlightState.EMERGENCY,
    ResetEmergency: FlightState.LANDED,
}


class RecordingVehicle:
    """Goes at once into the state that a command requests."""

    def __init__(self, state: FlightState = FlightState.LANDED) -> None:
        self.state = state
        self.told: list[AnyAction] = []
        self.limits = Limits()
        self.lying = True  #: whether it lies on the ground, so that a reset works

    def command(self, action: AnyAction) -> AnyAction:
        self.told.append(action)
        if isinstance(action, ResetEmergency) and not self.lying:
            return Idle()
        self.state = _NEXT[type(action)]
        return action

    ceiling_m = 100.0

    def set_limits(self, limits: Limits) -> None:
        self.limits = limits

    def take_commands(self) -> list[AnyAction]:
        told, self.told = self.told, []
        return told


class Bench:
    """A main board on the bench: its vehicle, its clock, and the output of its control port."""

    def __init__(self, version: int = 2, state: FlightState = FlightState.LANDED) -> None:
        self.vehicle = RecordingVehicle(state)
        self.clock = ManualClock()
        self.texts: list[bytes] = []
        self.logic = ArdroneLogic(self.vehicle, self.texts.append, self.clock, version=version)
        self._sequence = 0

    def say(self, name: str, *arguments: Argument) -> None:
        """Send a command with the next sequence number in a separate datagram."""
        self._sequence += 1
        self.logic.receive(format_command(name, self._sequence, *arguments))

    def configure(self, key: str, value: str) -> None:
        self.say("CONFIG", key, value)

    def wait(self, seconds: float, believed: VehicleFeedback = RESTING) -> None:
        """Let time pass without a command."""
        self.clock.advance(seconds)
        self.logic.supervise(replace(believed, state=self.vehicle.state))

    @property
    def state(self) -> State:
        return self.logic.state(video=False)
