"""Bodies modelled at rotor level in steps of 1 ms, at any attitude, flown by firmware or by the built-in loops.

As in :mod:`skyloop.sim.dynamics`, many drones are computed as arrays and few one at a time, with bit-identical results.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from skyloop.errors import UsageError
from skyloop.sim.dynamics import ARRAYS, NUMBERS, STEP_S, BodyTable, Fields, body_rates, column, columns
from skyloop.sim.instruments import Firmware, Instruments
from skyloop.sim.parameters import GRAVITY_M_S2, VehicleParameters
from skyloop.sim.rotor_dynamics import (
    PLANT_STEP_S,
    Constants,
    advance,
    all_constants,
    constants_of,
    electric_power,
    load,
    mix,
    rotation,
    rotors_of,
    spin,
)
from skyloop.sim.streams import Floats
from skyloop.sim.world import vec3

PLANT_STEPS = round(STEP_S / PLANT_STEP_S)  #: number of plant steps per simulation step

# First rows of the entries that this table adds to those of BodyTable, and its total number of rows.
_TURNING, _SPEEDS, _TARGETS, _ROWS = 0, 7, 16, 29
_AIR, _LEAST_COS = 19, 1e-6  # BodyTable's first row of air, thrust, position and velocity; minimum cosine
_IDLE_COMMAND = 0.15  # armed firmware idles at 5 to 15 %
_ROTOR_MARGIN_M_S2 = 60.0  # margin for gravity, ground effect, and drag in a fast dive


class RotorBodies(BodyTable):
    """Bodies with four rotors each.

    Their state is a quaternion, body rates and rotor speeds. Angles with their sines, cosines and derivatives are
    computed at the end of each step. An attitude loop (250 Hz), a rate loop and a mixer (1 kHz) follow the inputs
    ``attitude_command`` and ``thrust_command``, except for drones flown by firmware.
    """

    def __init__(self, parameters: Sequence[VehicleParameters], positions: Floats, yaws: Floats) -> None:
        super().__init__(positions, yaws)
        n = len(parameters)
        self.count = 0  #: number of plant steps
        rows = columns(_ROWS, n)
        #: Rotation from body to world axes, w, x, y, z, (4, n); body rates, (3, n), and rotor speeds, (4, n) [rad/s].
        self.quaternion, self.turning, self.speeds = rows[0:4], rows[4:7], rows[7:11]
        #: Voltage under load, (n,) [V], and current, (n,) [A], of the batteries.
        self._force, self.voltage, self.current = rows[11:14], rows[14], rows[15]
        self._targets, self._wanted, self._thrust_wanted = rows[16:20], rows[20:23], rows[23]
        self._knock, self._sag, self._open_voltage = rows[24:27], rows[27], rows[28]
        self._force[2] = GRAVITY_M_S2
        full = column(parameters, lambda p: p.battery_full_v)
        self.voltage[:] = self._open_voltage[:] = full
        self._full_voltage = full
        self._sag[:] = 1.0
        self.quaternion[0], self.quaternion[3] = np.cos(yaws / 2), np.sin(yaws / 2)
        each = [constants_of(vehicle) for vehicle in parameters]
        self._constants = each
        self._all = all_constants(each)
        self._attitude_gain = column(parameters, lambda p: p.attitude_frequency_rad_s / (2 * p.attitude_damping))
        self._after = self.velocity.copy()  # velocity at the end of the last step, before collisions
        self._flown = np.zeros(n, dtype=np.bool_)
        self._pilots: dict[int, _Pilot] = {}
        thrusts = (rotors_of(p).full_thrust_n / p.mass_kg for p in parameters)
        self.most_acceleration_m_s2 = max(thrusts) + _ROTOR_MARGIN_M_S2
        if self._few:
            self._turning_of, self._speeds_of = Fields(rows, _TURNING, 7), Fields(rows, _SPEEDS, 4)
            self._inputs_of = Fields(rows, _TARGETS, 12)
            self._motion_of, self._moved_of = Fields(self._table, _AIR, 10), Fields(self._table, _AIR + 3, 7)
            self._forced = Fields(rows, _SPEEDS, 7)
        self._derive()

    # Inputs ----------------------------------------------------------------------------------------------------

    def cut(self, drone: int) -> None:
        self.attitude_command[:, drone] = 0.0
        self.thrust_command[drone] = 0.0

    def steady(self, drone: int) -> None:
        """Do nothing: running rotors hold the attitude, and so does the ground under a landed drone."""

    def fly_by(self, drone: int, firmware: Firmware, instruments: Instruments) -> None:
        """Let firmware fly a drone, starting with the next step."""
        self._pilots = {**self._pilots, drone: _Pilot(self, drone, firmware, instruments)}
        self._flown[drone] = True
        self._targets[:, drone] = 0.0

    def release(self, drone: int) -> None:
        """Stop the rotors of a drone flown by firmware and hand the drone to the built-in loops."""
        self._pilots = {number: pilot for number, pilot in self._pilots.items() if number != drone}
        self._flown[drone] = False
        self._targets[:, drone] = 0.0
        self.cut(drone)

    def command(self, drone: int, commands: Sequence[float]) -> None:
        """Set the rotor commands of a drone flown by firmware, 0 to 1, in the order of the rotors."""
        if len(commands) != 4 or not all(map(math.isfinite, commands)):
            raise UsageError(f"firmware must return 4 finite rotor commands, front left first, got {commands!r}")
        constants = self._constants[drone]
        idle, span = constants.idle_speed, constants.full_speed - constants.idle_speed
        self._targets[:, drone] = [idle + span * min(one, 1.0) if one > 0.0 else 0.0 for one in commands]

    def idles(self, drone: int) -> bool:
        """Return whether a drone's firmware commands all rotors at or below the idle speed of armed firmware."""
        constants = self._constants[drone]
        idle = constants.idle_speed + _IDLE_COMMAND * (constants.full_speed - constants.idle_speed)
        return bool((self._targets[:, drone] <= idle + 1e-9).all())

    def set_unloaded_voltage(self, voltage: Floats) -> None:
        """Set the batteries' open-circuit voltage, (n,) [V], which is zero for empty ones."""
        self._open_voltage[:] = voltage

    def turn(self, drone: int, change_rad_s: float) -> None:
        up = self.rotations()[drone, 2]
        self.turning[:, drone] += up * change_rad_s
        self.rates[2, drone] += change_rad_s

    def put(self, drone: int, position_m: Floats, yaw_rad: float, thrust: float) -> None:
        super().put(drone, position_m, yaw_rad, thrust)
        constants = self._constants[drone]
        self._after[:, drone] = 0.0
        self.quaternion[:, drone] = math.cos(yaw_rad / 2), 0.0, 0.0, math.sin(yaw_rad / 2)
        self.turning[:, drone] = 0.0
        self.speeds[:, drone] = math.sqrt(thrust * constants.collective / constants.thrust)
        self._derive()

    # State -----------------------------------------------------------------------------------------------------

    def power(self) -> Floats:
        power: Floats = electric_power(self._all, tuple(self.speeds))
        return power

    def body_rates(self) -> Floats:
        return self.turning.copy()

    def body_rates_of(self, drone: int) -> tuple[float, float, float]:
        return vec3(self.turning[:, drone])

    @property
    def time_s(self) -> float:
        """Simulation time, including the plant steps finished so far."""
        return self.count * PLANT_STEP_S

    def rotations(self) -> Floats:
        return np.moveaxis(np.array(rotation(*self.quaternion)), 2, 0)

    # Steps -----------------------------------------------------------------------------------------------------

    def step(self) -> None:
        self._begin()
        for _ in range(PLANT_STEPS):
            for pilot in self._pilots.values():
                pilot.exchange()
            if self._few:
                for drone, constants in enumerate(self._constants):
                    self._advance_one(drone, constants)
            else:
                self._advance_all()
            self.count += 1
        np.copyto(self._after, self.velocity)
        self._derive()

    def _begin(self) -> None:
        """Prepare the inputs of a step: the effects of collisions, the attitude loop and the batteries."""
        np.subtract(self.velocity, self._after, out=self._knock)
        np.divide(self._knock, STEP_S, out=self._knock)
        np.copyto(self.velocity_before, self.velocity)
        roll_rate, pitch_rate = (self.attitude_command[:2] - self.angles[:2]) * self._attitude_gain
        wanted = body_rates((roll_rate, pitch_rate, self.attitude_command[2]), self.sin, self.cos)
        self._wanted[0], self._wanted[1], self._wanted[2] = wanted
        self._thrust_wanted[:] = self.thrust_command
        self.voltage[:], self.current[:] = load(ARRAYS, self._all, self.power(), self._open_voltage, self.voltage)
        np.divide(self.voltage, self._full_voltage, out=self._sag)

    def _advance_one(self, drone: int, constants: Constants) -> None:
        turning = self._turning_of.read[drone]()
        s1, s2, s3, s4 = self._speeds_of.read[drone]()
        t1, t2, t3, t4, p, q, r, thrust, knock_x, knock_y, knock_z, sag = self._inputs_of.read[drone]()
        air_x, air_y, air_z, _, *moving = self._motion_of.read[drone]()
        speeds = (s1, s2, s3, s4)
        if drone in self._pilots:
            targets = (t1 * sag, t2 * sag, t3 * sag, t4 * sag)
        else:
            rates = turning[4], turning[5], turning[6]
            targets = mix(NUMBERS, constants, rates, speeds, (p, q, r), thrust, sag)
        speeds, twist = spin(NUMBERS, constants, speeds, targets)
        knock = knock_x, knock_y, knock_z
        motion = (air_x, air_y, air_z, *moving)
        turned, moved, force, lift = advance(NUMBERS, constants, turning, speeds, twist, motion, knock, knock_z > 0.0)
        self._turning_of.write[drone](*turned)
        self._forced.write[drone](*speeds, *force)
        self._moved_of.write[drone](lift, *moved)

    def _advance_all(self) -> None:
        do, constants = ARRAYS, self._all
        s1, s2, s3, s4 = self.speeds
        p, q, r = self.turning
        want_p, want_q, want_r = self._wanted
        knock_x, knock_y, knock_z = self._knock
        speeds, wanted = (s1, s2, s3, s4), (want_p, want_q, want_r)
        targets = mix(do, constants, (p, q, r), speeds, wanted, self._thrust_wanted, self._sag)
        if self._pilots:
            t1, t2, t3, t4 = np.where(self._flown, self._targets * self._sag, targets)
            targets = (t1, t2, t3, t4)
        speeds, twist = spin(do, constants, speeds, targets)
        motion = (*self.air, *self.position, *self.velocity)
        legs = bool((knock_z > 0.0).any())
        turned, moved, force, lift = advance(
            do, constants, (*self.quaternion, p, q, r), speeds, twist, motion, (knock_x, knock_y, knock_z), legs
        )
        for rows, values in (
            (self.quaternion, turned[:4]),
            (self.turning, turned[4:]),
            (self.speeds, speeds),
            (self._force, force),
            (self.position, moved[:3]),
            (self.velocity, moved[3:]),
        ):
            for row, value in zip(rows, values, strict=True):
                row[:] = value
        self.thrust[:] = lift

    def _derive(self) -> None:
        """Compute angles, with their sines, cosines and derivatives, from the quaternions."""
        # Kept in separate arrays, because NumPy's functions may give different results for different strides.
        quaternion = np.ascontiguousarray(self.quaternion)
        (r00, r01, _), (r10, r11, _), (r20, r21, r22) = rotation(*quaternion)
        level = np.sqrt(r21 * r21 + r22 * r22)
        sin, cos = np.empty((3, len(level))), np.empty((3, len(level)))
        some = np.maximum(level, _LEAST_COS)
        sin[0], sin[1], sin[2] = r21 / some, -r20, r10 / some
        cos[0], cos[1], cos[2] = r22 / some, level, r00 / some
        steep = level < _LEAST_COS
        if steep.any():  # roll and yaw turn about the same axis, so the entire rotation counts as yaw
            sin[0, steep], sin[2, steep] = 0.0, -r01[steep]
            cos[0, steep], cos[1, steep], cos[2, steep] = 1.0, _LEAST_COS, r11[steep]
        cos[0, cos[0] == 0.0] = _LEAST_COS  # avoids a division by zero
        self.angles[:] = np.arctan2(sin, cos)
        self.sin[:], self.cos[:] = sin, cos
        p, q, r = self.turning
        about = (q * sin[0] + r * cos[0]) / cos[1]
        self.rates[0], self.rates[1], self.rates[2] = p + about * sin[1], q * cos[0] - r * sin[0], about


class _Pilot:
    """Exchanges readings and commands with the firmware of a drone."""

    def __init__(self, bodies: RotorBodies, drone: int, firmware: Firmware, instruments: Instruments) -> None:
        self._bodies = bodies
        self._drone = drone
        self._firmware = firmware
        self._instruments = instruments

    def exchange(self) -> None:
        bodies, drone = self._bodies, self._drone
        w, x, y, z = bodies.quaternion[:, drone].tolist()
        # The ground supports a drone only at the end of each simulation step; during the step, the drone falls.
        velocity = bodies.velocity_before if bodies._knock[2, drone] > 0.0 else bodies.velocity
        readings = self._instruments.read(
            bodies.count,
            vec3(bodies.position[:, drone]),
            vec3(velocity[:, drone]),
            (w, x, y, z),
            vec3(bodies.turning[:, drone]),
            vec3(bodies._force[:, drone]),
            float(bodies.voltage[drone]),
            float(bodies.current[drone]),
        )
        commands = self._firmware.exchange(readings)
        if commands is not None:
            bodies.command(drone, commands)
