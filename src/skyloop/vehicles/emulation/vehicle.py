"""The body that flies: one drone of a simulation, as the firmware's flight logic sees it."""

from __future__ import annotations

from typing import Protocol

from skyloop.messages import AnyAction, FlightState
from skyloop.sim.parameters import Limits
from skyloop.sim.simulation import Simulation


class Vehicle(Protocol):
    """A body with motors and an autopilot that holds attitude, velocity and altitude."""

    @property
    def state(self) -> FlightState: ...

    @property
    def ceiling_m(self) -> float:
        """Height of its world [m]."""

    def command(self, action: AnyAction) -> AnyAction:
        """Command the body.

        Returns:
            What was applied, :class:`skyloop.messages.Idle` where it was ignored.
        """

    def set_limits(self, limits: Limits) -> None: ...


class SimulatedVehicle:
    """A drone of a simulation; see :class:`Vehicle`.

    Args:
        simulation: Flies it.
        drone: Its number.
    """

    def __init__(self, simulation: Simulation, drone: int) -> None:
        self._simulation = simulation
        self._drone = drone

    @property
    def state(self) -> FlightState:
        """Flight state, as it is."""
        return self._simulation.state(self._drone)

    @property
    def ceiling_m(self) -> float:
        """Height of its world [m]."""
        return self._simulation.world.room.size_m[2]

    def command(self, action: AnyAction) -> AnyAction:
        """Command the body, and return what was applied."""
        return self._simulation.command(self._drone, action)

    def set_limits(self, limits: Limits) -> None:
        """Set the limits of its set-points."""
        self._simulation.set_limits(self._drone, limits)
