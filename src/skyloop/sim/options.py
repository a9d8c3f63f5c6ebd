"""Options of a simulated world and its drones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from skyloop.messages import ACTION_NAMES
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA, CameraModel
from skyloop.sim.pacing import MOST_LAG_S
from skyloop.sim.parameters import VehicleParameters, with_scaled_flaws
from skyloop.sim.world import Wind, World
from skyloop.sim.world_file import load_world

#: What simulated vehicles do by themselves; to places, and back to their start, the proxy flies them.
EVERY_ACTION: Final = frozenset(ACTION_NAMES.values()) - {"position", "return_to_start"}
STANDARD_VEHICLE: Final = VehicleParameters()


@dataclass(frozen=True, slots=True)
class SimOptions:
    """Options of a simulated world and its drones.

    Attributes:
        world: Name of a shipped world, or path of a world file.
        seed: Of all noise and gusts.
        speed: Of simulated time, relative to real time.
        cameras: Of each drone.
        noise: Factor of the sensors' noise and biases.
        wind: Factor of the world's wind.
        battery: Charge at the start, 0 to 1.
        quality: Of the images: ``fast``, ``smooth`` or ``best``.
        native: Actions that the drone's driver supports natively.
        position: Whether the drone reports its position.
        velocity: Whether the drone reports its velocity; it flies by it all the same.
        truth: Whether the drone reports its true state too.
        rate_hz: Of the reports.
        most_lag_s: How far the world may be behind the clock before it gives the rest up [s].
        parameters: Of the vehicles.
        autopilot: The real firmware that flies the drones: ``ardupilot``, ``betaflight`` or ``px4``.
        autopilot_folder: Where the firmware keeps its settings; None: they last as long as the drone.
    """

    world: str = "room"
    seed: int = 0
    speed: float = 1.0
    cameras: tuple[CameraModel, ...] = (FRONT_CAMERA, BOTTOM_CAMERA)
    noise: float = 1.0
    wind: float = 1.0
    battery: float = 1.0
    quality: str = "smooth"
    native: frozenset[str] = EVERY_ACTION
    position: bool = True
    velocity: bool = True
    truth: bool = True
    rate_hz: float = 40.0
    most_lag_s: float = MOST_LAG_S
    parameters: VehicleParameters = STANDARD_VEHICLE
    autopilot: str | None = None
    autopilot_folder: str | None = None

    def load_world(self) -> World:
        """Load the world.

        Raises:
            UnknownNameError: There is no such world.
            FileFormatError: The world's file is invalid.
        """
        return load_world(self.world, self.seed)

    def blowing(self, wind: Wind) -> Wind:
        """Return a world's wind multiplied by the factor :attr:`wind`."""
        x, y, z = wind.mean_m_s
        mean = (x * self.wind, y * self.wind, z * self.wind)
        return replace(wind, mean_m_s=mean, gust_m_s=wind.gust_m_s * self.wind)

    def vehicle(self) -> VehicleParameters:
        """Return the vehicle, with its sensors' noise and biases multiplied by the factor :attr:`noise`."""
        return with_scaled_flaws(self.parameters, self.noise)
