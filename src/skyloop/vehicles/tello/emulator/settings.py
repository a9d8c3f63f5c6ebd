"""Settings of an emulated Tello."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from skyloop.faults import Faults
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA
from skyloop.sim.options import SimOptions
from skyloop.sim.parameters import Limits, VehicleParameters
from skyloop.vehicles.tello.wire.commands import FULL_CLIMB_M_S, FULL_SPEED_M_S, FULL_YAW_RATE_RAD_S, Sdk

REPORTS_HZ: Final = 50.0
TAKEOFF_ALTITUDE_M: Final = 0.8  #: of a recorded flight

#: Small and light. Mass, size and time of flight: Ryze, Tello specifications; rotors of 3 inches. What is not named is
#: the simulator's own vehicle.
TELLO: Final = VehicleParameters(
    mass_kg=0.087,
    radius_m=0.1,
    half_height_m=0.02,
    rotor_radius_m=0.038,
    rotor_height_m=0.03,
    takeoff_climb_m_s=0.7,  # 0.8 m in the 1.3 s between leaving the ground and hovering, of a recorded flight
    battery_full_v=4.35,
    battery_empty_v=3.3,
    battery_charge_c=3960.0,  # 1100 mAh
    battery_resistance_ohm=0.03,
    hover_power_w=17.0,  # 4.18 Wh in 13 minutes, less the electronics
    electronics_power_w=2.0,
)
LIMITS: Final = Limits(
    tilt_rad=0.35,
    climb_m_s=FULL_CLIMB_M_S,
    yaw_rate_rad_s=FULL_YAW_RATE_RAD_S,
    altitude_m=10.0,
    speed_m_s=FULL_SPEED_M_S * 2**0.5,  # both sticks in their corners
    takeoff_altitude_m=TAKEOFF_ALTITUDE_M,
)

#: Calibration of one such drone as published with tello_ros, for its pictures of 960×720.
FRONT: Final = replace(
    FRONT_CAMERA,
    width=960,
    height=720,
    fps=30.0,
    fx=921.170702,
    fy=919.018377,
    cx=459.904354,
    cy=351.238301,
    distortion=(-0.033458, 0.105152, 0.001256, -0.006647, 0.0),
    position_m=(0.05, 0.0, 0.0),
)
BOTTOM: Final = replace(BOTTOM_CAMERA, width=320, height=240, fps=30.0)  #: its lens is an estimate


def with_tellos(options: SimOptions | None = None) -> SimOptions:
    """Return options of a world whose drones are Tellos. Cameras are the firmware's own, whatever the options say."""
    return replace(options or SimOptions(), parameters=TELLO, rate_hz=REPORTS_HZ, cameras=())


@dataclass(frozen=True, slots=True)
class Settings:
    """The arguments of :class:`skyloop.vehicles.tello.emulator.TelloFirmware`."""

    sdk: Sdk
    bind: str
    port: int
    faults: Faults
    delay_s: float
    pads: Mapping[int, tuple[float, float]]  #: by number: x, y in the world
