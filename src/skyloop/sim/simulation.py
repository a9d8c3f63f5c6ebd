"""A world with drones that its owner advances step by step.

It is deterministic: the same world, seed, drones and commands in the same steps give the same bits. Nothing here reads
a wall clock; :class:`~skyloop.sim.options.Pacer` paces it to run in real time.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import Action, AnyAction, FlightState
from skyloop.messages.geometry import quaternion_from_euler, wrap_angle
from skyloop.sim.autopilot import Batteries, SimAutopilot
from skyloop.sim.collisions import Collisions
from skyloop.sim.control_loops import ControlLoops, Sensors
from skyloop.sim.dynamics import STEP_S, Bodies, BodyTable, WindField
from skyloop.sim.instruments import Firmware, Instruments
from skyloop.sim.parameters import GRAVITY_M_S2, Limits, VehicleParameters
from skyloop.sim.reports import Occurrence, VehicleFeedback, VehicleTruth
from skyloop.sim.rotors import RotorBodies
from skyloop.sim.solids import Solids, place
from skyloop.sim.streams import Floats
from skyloop.sim.targets import TargetTrack
from skyloop.sim.world import TargetState, Vec3, Wind, World, vec3

LOOP_STEPS = 4  # steps per update of the autopilot's outer loops, altimeter and velocity (62.5 Hz)
SLOW_STEPS = 25  # steps per update of the batteries and of the wandering biases (10 Hz)

T = TypeVar("T")

_STANDARD_VEHICLE = VehicleParameters()
_STANDARD_LIMITS = Limits()


class Simulation:
    """A world with drones. Its methods may be called from any thread."""

    def __init__(
        self,
        world: World,
        drones: int = 1,
        *,
        seed: int | None = None,
        parameters: VehicleParameters | Sequence[VehicleParameters] = _STANDARD_VEHICLE,
        limits: Limits | Sequence[Limits] = _STANDARD_LIMITS,
        charge: float = 1.0,
        wind: Wind | None = None,
    ) -> None:
        """Place the drones on the ground.

        Args:
            world: The world.
            drones: Number of drones, 1 to 1000.
            seed: Seed for all noise and gusts. Together with the world's own seed, this seed determines the simulation.
                If None, the world's seed is used.
            parameters: Parameters for all drones, or for each drone.
            limits: Limits for all drones, or for each drone.
            charge: Initial charge of the batteries, greater than 0 and at most 1.
            wind: Wind that replaces the wind of the world.

        Raises:
            UsageError: An argument is out of its range, some vehicles have rotors and others don't, or the world has no
                room for that many drones.
        """
        if isinstance(drones, bool) or not isinstance(drones, int) or not 1 <= drones <= 1000:
            raise UsageError(f"drones must be a whole number from 1 to 1000, not {drones!r}")
        if not 0 < charge <= 1:
            raise UsageError(f"charge must be greater than 0 and at most 1, not {charge!r}")
        self.world = world
        self.parameters = _one_each(parameters, drones, "parameters")  #: the parameters of each drone
        self.seed = world.seed if seed is None else seed  #: seed for all noise and gusts
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise UsageError(f"seed must be a whole number of at least 0, not {seed!r}")
        self._lock = threading.RLock()
        self._step = 0
        self._tracks = tuple(TargetTrack(target, world.seed, n) for n, target in enumerate(world.targets))
        self._solids = solids = Solids(world, self._tracks)
        spawns = place(world, self.parameters, solids)
        starts = np.array([spawn.position_m for spawn in spawns]).T
        starts[2] += [p.half_height_m for p in self.parameters]
        yaws = np.array([spawn.yaw_rad for spawn in spawns])
        self._rotors = RotorBodies(self.parameters, starts, yaws) if _have_rotors(self.parameters) else None
        self._bodies: BodyTable = self._rotors or Bodies(self.parameters, starts, yaws)
        self._collisions = Collisions(self.parameters, self._bodies, solids)
        self._wind = WindField(world.wind if wind is None else wind, self.seed, drones, LOOP_STEPS * STEP_S)
        self._sensors = Sensors(self.parameters, self._bodies, self.seed, SLOW_STEPS * STEP_S)
        self._batteries = Batteries(self.parameters, np.full(drones, float(charge)))
        all_limits = _one_each(limits, drones, "limits")
        loops = ControlLoops(self.parameters, all_limits, self._bodies, LOOP_STEPS * STEP_S)
        self._loops = loops
        self._autopilot = SimAutopilot(self.parameters, all_limits, loops, self._sensors, self._batteries)
        self._supply()

    # Time ------------------------------------------------------------------------------------------------------

    @property
    def drones(self) -> int:
        """Number of drones, which are numbered from 0."""
        return len(self.parameters)

    @property
    def time_s(self) -> float:
        """Simulation time: finished steps times :data:`~skyloop.sim.dynamics.STEP_S`."""
        return self._step * STEP_S

    def step(self, n: int = 1) -> None:
        """Advance by ``n`` steps of :data:`~skyloop.sim.dynamics.STEP_S`."""
        for _ in range(n):
            with self._lock:
                self._step_once()

    def _step_once(self) -> None:
        if self._step % LOOP_STEPS == 0:
            self._wind.blow(self._bodies.air)
            self._sensors.estimate()
            self._autopilot.supervise(self.time_s)
            self._loops.update(self._sensors)
        if self._step % SLOW_STEPS == 0:
            self._sensors.wander()
            self._batteries.drain(self._bodies.power(), SLOW_STEPS * STEP_S)
            self._autopilot.watch_batteries(self.time_s)
            self._supply()
        self._bodies.step()
        contacts = self._collisions.resolve(self._step)
        self._step += 1
        if contacts is not None:
            self._autopilot.feel(contacts, self.time_s)
        if self._rotors is not None:
            self._autopilot.watch_firmware(self._rotors, self.time_s)

    def _supply(self) -> None:
        """Pass the batteries' current voltage to the rotors."""
        if self._rotors is not None:
            self._rotors.set_unloaded_voltage(self._batteries.open_voltage() * (self._batteries.charge > 0))

    # Flying ----------------------------------------------------------------------------------------------------

    def command(self, drone: int, action: AnyAction) -> AnyAction:
        """Command a drone. The command stays in force until the next one.

        Args:
            drone: The drone's number.
            action: A set-point or an action.

        Returns:
            The applied action: the action itself, a clamped set-point, or :class:`~skyloop.messages.Idle` if the drone
            ignores it in its current state, as firmware does: set-points before hovering, or a reset in the air.

        Raises:
            UsageError: There is no such drone, firmware flies it, or a number is not finite.
        """
        if not isinstance(action, Action):
            raise UsageError(f"expected an action from skyloop.messages, got {action!r}")
        if not action.finite:
            raise UsageError(f"a set-point must be finite: {action!r}")
        with self._lock:
            self._require_built_in(drone)
            return self._autopilot.command(drone, action, self.time_s)

    def limits(self, drone: int) -> Limits:
        """Return the limits in force for a drone."""
        return self._autopilot.limits[self._number(drone)]

    def set_limits(self, drone: int, limits: Limits) -> None:
        """Change a drone's limits. A set-point in force keeps its values; a new ceiling takes effect at once."""
        with self._lock:
            self._autopilot.set_limits(self._number(drone), limits)

    def fly_by(self, drone: int, firmware: Firmware) -> None:
        """Let firmware fly a drone from now on. Meanwhile the built-in autopilot refuses commands.

        The drone counts as landed while it is on the ground and no rotor command exceeds 15 % (the idle of armed
        firmware); otherwise it counts as flying. Collisions are reported as usual, but do not stop the rotors.

        Args:
            drone: The drone's number. The drone must be on the ground; an emergency state is reset.
            firmware: Called once per millisecond of simulation time on the stepping thread.

        Raises:
            UsageError: There is no such drone, the drone has no rotors, firmware already flies it, or it is in the air.
        """
        with self._lock:
            self._require_built_in(drone)
            if self._rotors is None:
                raise UsageError(
                    "firmware needs a drone modelled down to its rotors: "
                    "one of RACER, IRIS and CRAZYFLIE of skyloop.sim.vehicles, or parameters with rotors"
                )
            if not self._autopilot.grounded(drone, self.time_s):
                state = self._autopilot.states[drone]
                raise UsageError(f"drone {drone} is in the air ({state}): firmware can take over only on the ground")
            solids, rotors = self._solids, self._rotors

            def ranging(point: Vec3, direction: Vec3) -> float:
                return solids.distance_along(point, direction, rotors.time_s)

            instruments = Instruments(self.parameters[drone], drone, self.seed, ranging)
            self._autopilot.hand_over(drone)
            rotors.fly_by(drone, firmware, instruments)

    def release(self, drone: int) -> None:
        """Take a drone back from its firmware. Its rotors stop, and the built-in autopilot takes over.

        If it is in the air, the drone falls in an emergency.
        """
        with self._lock:
            if self._rotors is None or self._number(drone) not in self._autopilot.handed_over:
                raise UsageError(f"no firmware flies drone {drone}")
            self._rotors.release(drone)
            self._autopilot.take_back(drone, self.time_s)

    def flown_by_firmware(self, drone: int) -> bool:
        """Return whether firmware flies a drone; see :meth:`fly_by`."""
        return self._number(drone) in self._autopilot.handed_over

    def _require_built_in(self, drone: int) -> None:
        if self._number(drone) in self._autopilot.handed_over:
            raise UsageError(f"firmware flies drone {drone}: command the firmware, or release the drone first")

    # Conditions ------------------------------------------------------------------------------------------------

    def set_wind(self, wind: Wind) -> None:
        """Change the wind. Its gusts start a new stream of random numbers."""
        with self._lock:
            self._wind = WindField(wind, self.seed, self.drones, LOOP_STEPS * STEP_S)

    def set_charge(self, drone: int, charge: float) -> None:
        """Set a drone's battery charge."""
        if not 0 <= charge <= 1:
            raise UsageError(f"charge must be from 0 to 1, not {charge!r}")
        with self._lock:
            self._batteries.charge[self._number(drone)] = charge

    def put(self, drone: int, position_m: Vec3, yaw_rad: float = 0.0, *, charge: float = 1.0) -> None:
        """Move a flying drone, to start a new episode in the same simulation; it hovers there, level and at rest.

        ``position_m`` is the new position of its centre, in world axes. Raises UsageError unless the drone is flying.
        """
        place = np.array(position_m, dtype=float)
        if place.shape != (3,) or not np.isfinite(place).all() or not np.isfinite(yaw_rad):
            raise UsageError(f"expected three finite coordinates and a heading, got {position_m!r}, {yaw_rad!r}")
        self.set_charge(drone, charge)
        with self._lock:
            self._require_built_in(drone)
            if self._autopilot.states[drone] not in (FlightState.HOVERING, FlightState.FLYING):
                raise UsageError(f"drone {drone} is {self._autopilot.states[drone]}: only a flying drone can be moved")
            self._bodies.put(drone, place, wrap_angle(yaw_rad), GRAVITY_M_S2)
            self._collisions.moved(drone)
            self._sensors.put(drone)
            altitude = position_m[2] - self.parameters[drone].half_height_m
            self._autopilot.hover_here(drone, altitude, self.time_s)

    # State -----------------------------------------------------------------------------------------------------

    def state(self, drone: int) -> FlightState:
        """Return a drone's flight state."""
        return self._autopilot.states[self._number(drone)]

    def feedback(self, drone: int) -> VehicleFeedback:
        """Return a drone's estimates. Altitude and velocity are up to 16 ms older; their sensors run at 62.5 Hz."""
        with self._lock:
            i, sensors = self._number(drone), self._sensors
            inertial = sensors.inertial(self._step)[:, i].tolist()
            return VehicleFeedback(
                time_s=self.time_s,
                state=self._autopilot.states[i],
                emergency_reason=self._autopilot.reasons[i],
                battery=float(self._batteries.charge[i]),
                battery_v=float((self._batteries if self._rotors is None else self._rotors).voltage[i]),
                roll_rad=inertial[6],
                pitch_rad=inertial[7],
                yaw_rad=wrap_angle(inertial[8]),
                altitude_m=float(sensors.altitude[i]),
                velocity_m_s=vec3(sensors.velocity[:, i]),
                angular_velocity_rad_s=(inertial[0], inertial[1], inertial[2]),
                acceleration_m_s2=(inertial[3], inertial[4], inertial[5]),
            )

    def truth(self, drone: int) -> VehicleTruth:
        """Return a drone's true state."""
        with self._lock:
            i, bodies = self._number(drone), self._bodies
            roll, pitch, yaw = bodies.angles[:, i].tolist()
            return VehicleTruth(
                time_s=self.time_s,
                state=self._autopilot.states[i],
                position_m=vec3(bodies.position[:, i]),
                velocity_m_s=vec3(bodies.velocity[:, i]),
                roll_rad=roll,
                pitch_rad=pitch,
                yaw_rad=wrap_angle(yaw),
                quaternion=quaternion_from_euler(roll, pitch, yaw),
                angular_velocity_rad_s=bodies.body_rates_of(i),
                thrust=float(bodies.thrust[i]) / GRAVITY_M_S2,
                wind_m_s=vec3(bodies.air[:, i]),
                battery=float(self._batteries.charge[i]),
            )

    def poses(self) -> tuple[Floats, Floats]:
        """Return the true poses of all bodies as new arrays, for a renderer or a motion-capture system.

        These are positions in world axes, shape (n, 3) [m], and world-from-body rotations, shape (n, 3, 3).
        """
        with self._lock:
            return self._bodies.position.T.copy(), self._bodies.rotations()

    def motions(self) -> tuple[Floats, Floats, Floats]:
        """Return the motion of all drones as new arrays, for tasks with many drones.

        Positions are true values in world axes, shape (n, 3) [m]; velocities forward, left and up are the drones'
        estimates, up to 16 ms older, shape (n, 3) [m/s]; roll, pitch and yaw (within ±π) are true, shape (n, 3) [rad].
        """
        with self._lock:
            angles = self._bodies.angles.T.copy()
            angles[:, 2] = wrap_angle(angles[:, 2])
            return self._bodies.position.T.copy(), self._sensors.velocity.T.copy(), angles

    def airborne(self) -> NDArray[np.bool_]:
        """Return whether each drone is flying, shape (n,); see :attr:`FlightState.airborne`."""
        with self._lock:
            return np.array([state.airborne for state in self._autopilot.states])

    def distance_along(self, point: Vec3, direction: Vec3) -> float:
        """Return the distance [m] along a unit vector to the first solid, floor, or visible wall or ceiling."""
        with self._lock:
            return self._solids.distance_along(point, direction, self.time_s)

    def target_states(self, time_s: float | None = None) -> tuple[TargetState, ...]:
        """Return the states of the moving targets in the world's order, now or at a simulation time."""
        time = self.time_s if time_s is None else time_s
        return tuple(track.at(time) for track in self._tracks)

    def light(self, time_s: float | None = None) -> float:
        """Return the brightness of the world's :class:`~skyloop.sim.world.Light`, at most 1, now or at a time."""
        return self.world.light.at(self.time_s if time_s is None else time_s, self.world.seed)

    def take_occurrences(self) -> list[Occurrence]:
        """Return the occurrences since the previous call, oldest first. Only the newest 1000 occurrences are kept."""
        with self._lock:
            taken = list(self._autopilot.occurrences)
            self._autopilot.occurrences.clear()
            return taken

    def _number(self, drone: int) -> int:
        if not 0 <= drone < self.drones:
            raise UsageError(f"no drone {drone!r}: they are numbered from 0 to {self.drones - 1}")
        return drone


def _one_each(given: T | Sequence[T], drones: int, what: str) -> list[T]:
    if not isinstance(given, Sequence):
        return [given] * drones
    if len(given) != drones:
        raise UsageError(f"{what}: {len(given)} given for {drones} drones; give one for all or one for each")
    return list(given)


def _have_rotors(parameters: Sequence[VehicleParameters]) -> bool:
    """Return whether the vehicles are modelled at rotor level."""
    have = {vehicle.rotors is not None for vehicle in parameters}
    if len(have) > 1:
        raise UsageError("vehicles with and without rotors (VehicleParameters.rotors) need separate simulations")
    return have.pop()
