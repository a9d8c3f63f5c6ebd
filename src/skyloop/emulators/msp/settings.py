"""Settings of an emulated flight controller."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

from skyloop.sim.options import SimOptions
from skyloop.sim.parameters import VehicleParameters
from skyloop.wire.msp.curves import AxisRates, Rates
from skyloop.wire.msp.messages import FailsafeConfig, ModeRange, OnLoss

PORT: Final = 5761  #: of the first serial port of Betaflight's own simulation
CHANNELS: Final = 18
HOVER_THROTTLE: Final = 0.32  #: that carries it, of a full stick; estimate
THRUST_POWER: Final = 1.6  #: of the throttle; estimate
CELLS: Final = 4

#: A 5-inch quadrotor with a battery of four cells. Estimates of the usual size.
RACER: Final = VehicleParameters(
    mass_kg=0.6,
    radius_m=0.18,
    half_height_m=0.04,
    rotor_radius_m=0.064,
    rotor_height_m=0.05,
    most_thrust=3.0,
    least_thrust=0.1,
    motor_time_constant_s=0.03,
    battery_full_v=16.8,
    battery_empty_v=13.2,
    battery_charge_c=5400.0,  # 1500 mAh
    hover_power_w=120.0,
)
REPORTS_HZ: Final = 100.0
_ACTUAL: Final = AxisRates(7, 0, 67)
#: Betaflight's own: 70 degrees/s about the middle of a stick, 670 at its end.
USUAL_RATES: Final = Rates("actual", _ACTUAL, _ACTUAL, _ACTUAL)
#: (permanent number, name) in the order of the status' bits, as Betaflight 4.6 lists them without more features.
BOXES: Final = ((0, "ARM"), (1, "ANGLE"), (2, "HORIZON"), (27, "FAILSAFE"), (28, "AIR MODE"), (36, "PREARM"))


@dataclass(frozen=True, slots=True)
class BoardSettings:
    """How the flight controller is set up: by default, as ``docs/msp.md`` asks for."""

    ranges: tuple[ModeRange, ...] = (ModeRange(0, 0, 1700, 2100), ModeRange(1, 1, 900, 2100))
    failsafe: FailsafeConfig = field(default_factory=lambda: FailsafeConfig(1.5, 60.0, 1000, 10.0, 1))
    on_loss: tuple[tuple[int, int], ...] = (
        ((OnLoss.AUTO, 1500),) * 3 + ((OnLoss.AUTO, 875),) + ((OnLoss.HOLD, 1500),) * (CHANNELS - 4)
    )
    rates: Rates = USUAL_RATES
    angle_limit_deg: int = 60
    rx_msp: bool = True
    gps: bool = True
    barometer: bool = True
    boot_s: float = 0.5  #: until it lets itself be armed [s]; real ones take 5
    flags: int = 0  #: that keep it from arming besides, a bit each


def with_racers(options: SimOptions | None = None) -> SimOptions:
    """Return options of a world whose drones are racers. They have no camera: MSP carries no video."""
    return replace(options or SimOptions(), parameters=RACER, rate_hz=REPORTS_HZ, cameras=())
