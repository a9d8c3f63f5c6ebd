"""Compare the responses of the rotor-level vehicles with published ones of real vehicles.

``python -m benchmarks.rotors`` measures in the simulator and prints the figures of docs/rotors.md. The results do not
depend on the machine.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import typer

from benchmarks.measuring.command_line import as_rich
from benchmarks.measuring.tables import UNKNOWN, Table
from benchmarks.one_command import one_command
from skyloop.cli.app import run
from skyloop.cli.text import console
from skyloop.messages import Attitude, FlightState, Takeoff
from skyloop.sim import STEP_S, Limits, Simulation, VehicleParameters, parse_world
from skyloop.sim.dynamics import NUMBERS
from skyloop.sim.parameters import GRAVITY_M_S2, with_ideal_sensors
from skyloop.sim.rotor_dynamics import PLANT_STEP_S, advance, constants_of, rotors_of, spin
from skyloop.sim.vehicles import CRAZYFLIE, IRIS, RACER

VEHICLES: Final = {"racer": RACER, "Iris": IRIS, "Crazyflie": CRAZYFLIE}
STEP_RAD: Final = 0.3
_HALL: Final = parse_world("[room]\nsize = [400, 400, 90]\nenclosed = false\n", "hall")
_LIMITS: Final = Limits(tilt_rad=0.6, altitude_m=80.0, takeoff_altitude_m=2.0, speed_m_s=15.0)
_UP_S, _SETTLED_S, _SHOWN_S, _COAST_M_S = 5.0, 3.0, 1.2, 1.0


class Identified(NamedTuple):
    """A real Crazyflie, identified from flights in drone-models 0.1.0 (MIT); its name gives motors and propellers.

    Attitude: angle'' = stiffness · angle + damping · angle' + gain · command.
    """

    name: str
    mass_kg: float
    stiffness: float
    damping: float
    gain: float
    thrust_s: float  #: time constant of the thrust
    drag_n_s_m: float  #: lateral drag


IDENTIFIED: Final = (
    Identified("cf2x_L250", 0.0319, -245.67, -17.32, 196.18, 0.0858607, 0.01471782),
    Identified("cf2x_P250", 0.0318, -319.14, -20.85, 263.30, 0.0578952, 0.01351483),
    Identified("cf2x_T350", 0.0379, -267.14, -19.48, 200.90, 0.05062676, 0.01556697),
)


class Response(NamedTuple):
    """The times at which a response reaches fractions of its final value, and its overshoot."""

    tenth_s: float
    half_s: float
    nine_tenths_s: float
    overshoot: float

    def cells(self) -> list[str]:
        """Return the response as text."""
        times = [f"{seconds * 1e3:.0f} ms" for seconds in self[:3]]
        return [*times, f"{max(0.0, self.overshoot):.0%}"]


def response(values: Sequence[float], end: float, period_s: float) -> Response:
    """Return the figures of a response whose first value is one period after the command."""

    def reached(share: float) -> float:
        before = 0.0
        for number, value in enumerate(values):
            if value >= share * end:
                return (number + (share * end - before) / (value - before)) * period_s
            before = value
        return math.nan

    return Response(reached(0.1), reached(0.5), reached(0.9), max(values) / end - 1.0)


def attitude_step(vehicle: VehicleParameters) -> Response:
    """Command a roll from hover, and return the response."""
    simulation = hovering(vehicle)
    simulation.command(0, Attitude(roll=STEP_RAD))
    angles = []
    for _ in range(round(_SHOWN_S / STEP_S)):
        simulation.step()
        angles.append(simulation.truth(0).roll_rad)
    return response(angles, STEP_RAD, STEP_S)


def identified_step(one: Identified) -> Response:
    """Return the response of an identified vehicle as a fraction of its final value, because its gain is not 1."""
    angle = rate = 0.0
    angles = []
    fine_s = PLANT_STEP_S / 10
    for number in range(round(_SHOWN_S / fine_s)):
        rate += (one.stiffness * angle + one.damping * rate + one.gain) * fine_s
        angle += rate * fine_s
        if (number + 1) % 10 == 0:
            angles.append(angle)
    return response(angles, one.gain / -one.stiffness, PLANT_STEP_S)


def thrust_lag_s(vehicle: VehicleParameters) -> float:
    """Return the time for 63 % of a thrust step of a tenth, with the body fixed as on a test stand."""
    constants, rotors = constants_of(vehicle), rotors_of(vehicle)
    still, untouched = (0.0, 0.0, 0.0, 0.0, 0.0, 100.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    speed = math.sqrt(vehicle.mass_kg * GRAVITY_M_S2 / 4 / rotors.thrust_n_s2)
    target = speed * math.sqrt(1.1)
    speeds, thrusts = (speed,) * 4, []
    for _ in range(round(_SHOWN_S / PLANT_STEP_S)):
        speeds, twist = spin(NUMBERS, constants, speeds, (target,) * 4)
        level = (1.0, 0.0, 0.0, 0.0, *untouched)
        thrusts.append(advance(NUMBERS, constants, level, speeds, twist, still, untouched, False)[3])
    wanted = GRAVITY_M_S2 * (1.0 + 0.1 * (1.0 - math.exp(-1.0)))
    return next(number for number, thrust in enumerate(thrusts, 1) if thrust >= wanted) * PLANT_STEP_S


def drag_per_s(vehicle: VehicleParameters) -> float:
    """Return the fraction of its speed that a level vehicle loses per second, at 1 m/s."""
    simulation = hovering(vehicle)
    simulation.command(0, Attitude(pitch=0.1))
    while simulation.truth(0).velocity_m_s[0] < 1.2 * _COAST_M_S:
        simulation.step()
    simulation.command(0, Attitude())
    simulation.step(round(0.6 / STEP_S))  # until it is level
    before = simulation.truth(0).velocity_m_s[0]
    seconds = 0.4
    simulation.step(round(seconds / STEP_S))
    return -math.log(simulation.truth(0).velocity_m_s[0] / before) / seconds


def hovering(vehicle: VehicleParameters) -> Simulation:
    """Return a hovering vehicle with ideal sensors."""
    simulation = Simulation(_HALL, parameters=with_ideal_sensors(vehicle), limits=_LIMITS)
    simulation.command(0, Takeoff())
    simulation.step(round(_UP_S / STEP_S))
    if simulation.state(0) is not FlightState.HOVERING:
        raise RuntimeError(f"it should hover, but is {simulation.state(0)}")
    simulation.step(round(_SETTLED_S / STEP_S))
    return simulation


class Hover(NamedTuple):
    """The figures of hovering."""

    rotor_speed_rad_s: float
    power_w: float
    minutes: float


def hover(vehicle: VehicleParameters) -> Hover:
    """Measure a vehicle in hover; the endurance is its battery's charge divided by the current."""
    simulation = hovering(vehicle)
    bodies = simulation._rotors
    assert bodies is not None
    amps, volts = float(bodies.current[0]), float(bodies.voltage[0])
    return Hover(float(bodies.speeds[:, 0].mean()), amps * volts, vehicle.battery_charge_c / amps / 60)


def tables(progress: Callable[[str], None] = lambda _: None) -> list[Table]:
    """Measure, and return the tables of docs/rotors.md."""
    steps, others = [], []
    for name, vehicle in VEHICLES.items():
        progress(name)
        steps.append([f"{name}, simulated", *attitude_step(vehicle).cells()])
        found = hover(vehicle)
        full = rotors_of(vehicle).full_thrust_n / (vehicle.mass_kg * GRAVITY_M_S2)
        others.append(
            [
                f"{name}, simulated",
                f"{thrust_lag_s(vehicle) * 1e3:.0f} ms",
                f"{drag_per_s(vehicle):.2f} 1/s",
                f"{full:.2f}",
                f"{found.rotor_speed_rad_s:.0f} rad/s",
                f"{found.power_w:.3g} W",
                f"{found.minutes:.0f} min",
            ]
        )
    for one in IDENTIFIED:
        steps.append([f"{one.name}, real", *identified_step(one).cells()])
        drag = f"{one.drag_n_s_m / one.mass_kg:.2f} 1/s"
        others.append([f"{one.name}, real", f"{one.thrust_s * 1e3:.0f} ms", drag, *[UNKNOWN] * 4])
    columns = ["vehicle", "10 %", "50 %", "90 %", "beyond"]
    more = ["vehicle", "thrust", "slows down", "full thrust to weight", "rotors in hover", "power in hover", "lasts"]
    return [Table("A step of roll of 0.3 rad", columns, steps), Table("Thrust, drag, hover", more, others)]


def command() -> None:
    """Compare the rotor-level vehicles with published ones.

    Example: python -m benchmarks.rotors
    """
    for shown in as_rich(tables(), "in the simulator; real: drone-models 0.1.0"):
        console().print(shown)


def build() -> typer.Typer:
    """Return the command line."""
    return one_command(command)


if __name__ == "__main__":
    run(build(), sys.argv[1:], "benchmarks.rotors")
