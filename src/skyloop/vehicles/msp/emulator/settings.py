"""Settings of an emulated flight controller."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

from skyloop.sim.options import SimOptions
from skyloop.sim.parameters import VehicleParameters
from skyloop.vehicles.msp.wire.curves import AxisRates, Rates
from skyloop.vehicles.msp.wire.messages import FailsafeConfig, ModeRange, OnLoss

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
#: Replies of Betaflight 4.6.0 to what the emulation has no state of, by number: how many bytes, and the first of them
#: as hexadecimal digits; the rest are zeros. Recorded from its own simulation, with its defaults, at rest.
RECORDED: Final[dict[int, tuple[int, str]]] = {
    5: (30, "4e6f76203236203230323631353a30343a323700484f52495a4f1f402b20"),
    10: (0, ""),
    38: (6, ""),
    40: (15, "02060a01900100000650"),
    42: (2, "03"),
    50: (1, ""),
    52: (180, ""),
    54: (
        56,
        "330100050400053400000504000535000005040005360000050400053700000504000538000005040005390000050400"
        "053a000005040005",
    ),
    56: (7, "01050a006e0a01"),
    58: (4, ""),
    70: (13, ""),
    79: (11, ""),
    80: (11, "01000104400002"),
    82: (1, ""),
    90: (20, "01010100e001260200000000307d000000020062"),
    92: (49, "fa4b006400000000000000000000000000000000fa00f4010000960000fa00f4014b0096000000000000000000000005"),
    96: (5, "000101"),
    104: (16, "e803e803e803e803"),
    112: (15, "2d501e2f54222d5000324b4b28"),
    117: (25, "524f4c4c3b50495443483b5941573b4c4556454c3b4d41473b"),
    124: (6, "7e05ea05b405"),
    125: (5, "00000032"),
    126: (19, "00000083"),
    128: (2, "0a"),
    129: (10, "0a0000000050"),
    131: (10, "0000d007e803040e"),
    133: (2, ""),
    139: (53, "04"),
    140: (53, "026464646464646464000000000000000001644b0096004b00960000000000000000000164fa00f401fa00f401"),
    142: (18, "2d501e2878002f54222e7d002d50000078"),
    143: (18, "008f"),
    144: (18, "0090"),
    145: (3, "010101"),
    160: (12, "000000000100000002"),
    187: (2, "04"),
    238: (61, "1400000001"),
    240: (4, "00ef"),
}
#: Writes that Betaflight 4.6.0 acknowledges also where they are empty, of the numbers up to 100; they change nothing
#: here. Not among them: 59, 61, 68 (which restarts it) and 69, to which it gives answers of their own or none.
EMPTY_WRITES: Final = frozenset(
    (11, 33, 35, 37, 39, 41, 43, 45, 51, 53, 55, 57, 60, 62, 65, 76, 78, 91, 93, 95, 97, 99)
)


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
