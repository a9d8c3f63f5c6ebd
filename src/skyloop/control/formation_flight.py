"""Formation flight of a swarm, based on the world positions reported by its drones."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import replace as replace_fields
from numpy.typing import ArrayLike, NDArray

from skyloop.control.airframe import STALE_S, Airframe, Part
from skyloop.control.formation import Places, assign, closest_approach, kept_apart, places
from skyloop.control.limiting import within
from skyloop.control.waypoint import Waypoint, WaypointSettings, lacking, reached, velocity_to
from skyloop.errors import NoAnswerError, SkyloopError, UnknownNameError, UsageError
from skyloop.estimation import assignment
from skyloop.messages import AnyAction, Feedback, FlightState, Vector, Velocity
from skyloop.messages.geometry import rotation_from_euler, turned

if TYPE_CHECKING:
    from skyloop.client import Swarm
    from skyloop.client.swarm import Tick

MAX_AGE_S: Final = 1.0  #: maximum age of feedback that is used for steering
SLACK_S: Final = 10.0  #: default allowance beyond the planned duration of a flight
_PEAK: Final = 1.875  # ratio of peak to mean speed of a minimum-jerk trajectory


@dataclass(frozen=True, slots=True)
class FormationReport:
    """The result of a formation flight."""

    seconds: float
    slots: dict[str, Vector]  #: planned final position of each drone, in world axes [m]
    errors_m: dict[str, float]  #: distance of each drone from its slot
    closest_m: float  #: smallest distance between any two drones; infinite for a single drone
    spread_s: float | None  #: maximum time between the first and last set-points of a tick


class Formation:
    """Flies the active drones of a swarm in formation, on the calling thread.

    Each drone must be airborne and report its position and yaw. Drones that fail during the flight, for example because
    their position is unknown for half a second, are handled by the swarm's ``on_error`` policy. The others keep clear
    of a failed drone's last known position, and of all drones in the swarm that are not part of this flight.

    Attributes:
        drones: The swarm.
        apart_m: Minimum distance to keep between two drones.
    """

    def __init__(
        self, drones: Swarm, *, rate_hz: float = 20.0, apart_m: float = 0.7, settings: WaypointSettings | None = None
    ) -> None:
        """Initialise the formation.

        Args:
            drones: The swarm to fly.
            rate_hz: Rate of the set-points.
            apart_m: Minimum distance between two drones. Flights that would bring drones closer together are refused,
                and drones that come closer are steered apart.
            settings: Gains, limits and acceptance radii; None for the defaults.

        Raises:
            UsageError: ``apart_m`` is negative or not finite.
            MissingExtraError: SciPy is not installed.
        """
        if not (math.isfinite(apart_m) and apart_m >= 0.0):
            raise UsageError(f"apart_m is {apart_m!r} and must be 0 m or more")
        assignment("a formation", "control")  # load SciPy now, so that it can't fail in flight
        self.drones = drones
        self.apart_m = apart_m
        self._rate_hz = rate_hz
        self._settings = settings or WaypointSettings()
        self._closest_m = math.inf
        self._airframes = {name: Airframe(Part.POSITION, Part.YAW) for name in drones.names}

    def middle(self) -> Vector:
        """Return the mean of the drones' positions in world axes [m].

        Raises:
            UsageError: A drone does not report its position or is on the ground, or none is active.
        """
        return _vector(_positions(self._ready()).mean(axis=0))

    def fly_to(
        self, slots: ArrayLike, *, speed_m_s: float = 0.6, yaw: float | None = None, timeout_s: float | None = None
    ) -> FormationReport:
        """Assign drones to slots, fly there in straight lines, leaving and arriving together, and then hover.

        Args:
            slots: Positions in world axes, (n, 3) [m]; at least one for each drone.
            speed_m_s: Maximum speed of the drone that has the longest path.
            yaw: Yaw of all drones [rad]; None to leave it free.
            timeout_s: Time after which drones not yet at their slots have failed; None for 10 s more than planned.

        Returns:
            A report with the drones' final positions and how close they came to each other.

        Raises:
            UsageError: A drone can't be flown by position, none is active, there are too few slots or too many, or two
                drones would come closer than ``apart_m``.
            SwarmError: A drone failed, and the swarm's ``on_error`` is not ``"continue"``.
        """
        if not (math.isfinite(speed_m_s) and speed_m_s > 0.0):
            raise UsageError(f"speed_m_s is {speed_m_s!r} and must be above 0 m/s")
        before = self._ready()
        starts = _positions(before)
        goals = places(slots)
        goals = goals[assign(starts, goals)]
        self._check_ways(list(before), starts, goals)
        longest_m = float(np.linalg.norm(goals - starts, axis=1).max())
        planned_s = max(_PEAK * longest_m / speed_m_s, 1e-3)
        ways = {name: (starts[k], goals[k]) for k, name in enumerate(before)}
        limit_s = planned_s + SLACK_S if timeout_s is None else timeout_s
        elapsed_s = 0.0
        for tick in self.drones.ticks(self._rate_hz, limit_s):
            elapsed_s = tick.elapsed_s
            now, others = self._states(ways)
            along, speed = _minimum_jerk(elapsed_s / planned_s)
            goal = {name: _waypoint(a + along * (b - a), yaw) for name, (a, b) in ways.items() if name in now}
            drift = {name: speed / planned_s * (ways[name][1] - ways[name][0]) for name in now}
            self._steer(now, goal, drift, others)
            if along >= 1.0 and all(reached(goal[name], now[name], self._settings) for name in now):
                break
        return self._arrived({name: way[1] for name, way in ways.items()}, yaw, elapsed_s)

    def hold(self, seconds: float) -> FormationReport:
        """Keep each drone at its current position, then hover.

        Args:
            seconds: Duration.

        Raises:
            UsageError: A drone can't be flown by position, or none is active.
            SwarmError: A drone failed, and the swarm's ``on_error`` is not ``"continue"``.
        """
        here = {name: np.array(sample.position_m) for name, sample in self._ready().items()}
        still = np.zeros(3)
        for _ in self.drones.ticks(self._rate_hz, seconds):
            now, others = self._states(here)
            self._steer(now, {name: _waypoint(here[name], None) for name in now}, dict.fromkeys(now, still), others)
        return self._report(here, seconds)

    def follow(
        self,
        leader: str,
        offsets: Mapping[str, ArrayLike],
        seconds: float,
        *,
        lead: Callable[[Tick], AnyAction] | None = None,
        turn: bool = True,
    ) -> FormationReport:
        """Keep followers at offsets from a leader, with its velocity fed forward, and then hover.

        Args:
            leader: The leader's name.
            offsets: Offsets of the followers by name, (3,) [m] each: forward, left and up in the leader's axes or, with
                ``turn=False``, east, north and up.
            seconds: Duration.
            lead: A function that returns the leader's action at each tick, which is sent with the followers'
                set-points; None if another client flies the leader.
            turn: Whether offsets and yaw follow the leader's yaw.

        Raises:
            UnknownNameError: The swarm has no drone with that name.
            UsageError: The leader is among the followers, a drone can't be flown by position, or none is active.
            SwarmError: A drone failed. If the leader failed and the swarm's ``on_error`` is ``"continue"``, the
                followers hover and this call returns.
        """
        wanted = {name: _offset(offset) for name, offset in offsets.items()}
        for name in (leader, *wanted):
            if name not in self.drones:
                raise UnknownNameError("drone in this swarm", name, self.drones.names)
        if leader in wanted:
            raise UsageError(f"{leader} is the leader and can't follow itself")
        self._ready()
        slots: dict[str, NDArray[np.float64]] = {}
        for tick in self.drones.ticks(self._rate_hz, seconds):
            now, others = self._states({leader, *wanted})
            if leader not in now:
                break
            first = now.pop(leader)
            slots = {name: station(first, wanted[name], turn=turn) for name in wanted if name in now}
            goals = {name: _waypoint(slot, first.yaw_rad if turn else None) for name, slot in slots.items()}
            drift = dict.fromkeys(goals, _world_velocity(first))
            self._steer(now, goals, drift, {leader: first, **others}, also={} if lead is None else {leader: lead(tick)})
        return self._report(slots, seconds)

    # Internals -------------------------------------------------------------------------------------------------

    def _states(self, flown: Container[str]) -> tuple[dict[str, Feedback], dict[str, Feedback]]:
        """Return the newest states of the ``flown`` drones and the last known states of all other airborne drones.

        A flown drone whose position becomes unknown fails, and is then treated like the other drones.
        """
        active, errors = self.drones.feedback(max_age_s=MAX_AGE_S), {}
        for name, sample in active.items():
            self._airframes[name].add(sample)
            problem = self._airframes[name].missing(sample.captured_ns)
            if problem and name in flown:
                errors[name] = NoAnswerError(problem)
        self.drones.fail("flying in formation", errors)
        now, others = {}, {}
        for name, drone in self.drones.items():
            airframe = self._airframes[name]
            if name in active and name in flown and name not in errors:
                now[name] = _carried_on(airframe)
                continue
            is_recent = False
            with suppress(SkyloopError):
                airframe.add(drone.feedback(max_age_s=MAX_AGE_S))
                is_recent = True
            if airframe.feedback is not None and airframe.feedback.state is not FlightState.LANDED:
                last = _carried_on(airframe)
                if last.position_m is not None:  # keep clear of the drone even if its feedback has stopped
                    others[name] = last if is_recent else replace_fields(last, velocity_m_s=None)
        return now, others

    def _ready(self) -> dict[str, Feedback]:
        """Return the active drones' newest feedback; raise UsageError if one can't be flown, or none is active."""
        self._closest_m = math.inf
        found = self.drones.feedback(max_age_s=MAX_AGE_S)
        if not found:
            aside = "; ".join(f"{name}: {error}" for name, error in self.drones.errors.items())
            raise UsageError(f"no drone of this swarm is active ({aside}): take them back with readmit()")
        problems = [f"{name}: {lacking(sample)}" for name, sample in found.items() if lacking(sample)]
        problems += [
            f"{name}: it is {sample.state.value}, take off first"
            for name, sample in found.items()
            if not lacking(sample) and not sample.state.airborne
        ]
        if problems:
            raise UsageError(f"these drones can't be flown in formation: {'; '.join(problems)}")
        return found

    def _check_ways(self, names: list[str], starts: Places, goals: Places) -> None:
        nearest = closest_approach(starts, goals)
        if nearest.distance_m < self.apart_m:
            raise UsageError(
                f"{names[nearest.first]} and {names[nearest.second]} would come within {nearest.distance_m:.2f} m of "
                f"each other, but must stay {self.apart_m:g} m apart: choose other positions, or fly there in two steps"
            )

    def _steer(
        self,
        now: Mapping[str, Feedback],
        goals: Mapping[str, Waypoint],
        drift: Mapping[str, NDArray[np.float64]],
        others: Mapping[str, Feedback],
        *,
        also: Mapping[str, AnyAction] | None = None,
    ) -> None:
        """Send each drone towards its goal, which moves at ``drift`` [m/s], and keep it clear of the others."""
        towards = {name: velocity_to(goals[name], now[name], self._settings) for name in now}
        positions = _positions({**now, **others})
        wanted = [_in_world(towards[name], now[name]) + drift[name] for name in now]
        wanted += [_world_velocity(sample) for sample in others.values()]
        if len(positions) > 1:
            self._closest_m = min(self._closest_m, closest_approach(positions, positions).distance_m)
        steered = kept_apart(np.array(wanted).reshape(-1, 3), positions, self.apart_m, fixed=len(others))
        actions: dict[str, AnyAction] = {
            name: _command(steered[k], now[name], towards[name].yaw_rate) for k, name in enumerate(now)
        }
        self.drones.send({**actions, **(also or {})})

    def _arrived(self, goals: Mapping[str, NDArray[np.float64]], yaw: float | None, seconds: float) -> FormationReport:
        report = self._report(goals, seconds)
        now, _ = self._states(goals)
        late = {
            name: NoAnswerError(f"it is {report.errors_m[name]:.2f} m from its place after {seconds:.1f} s")
            for name in report.errors_m
            if name in now and not reached(_waypoint(goals[name], yaw), now[name], self._loose)
        }
        self.drones.fail("flying in formation", late)
        return report

    @property
    def _loose(self) -> WaypointSettings:
        """The settings with larger acceptance radii, for drones that start to hover just after arriving."""
        return replace(self._settings, near_m=3 * self._settings.near_m, near_rad=math.pi, slow_m_s=math.inf)

    def _report(self, goals: Mapping[str, NDArray[np.float64]], seconds: float) -> FormationReport:
        now, _ = self._states(goals)
        slots = {name: _vector(goal) for name, goal in goals.items()}
        errors = {name: math.dist(slots[name], now[name].position_m or slots[name]) for name in slots if name in now}
        spread = self.drones.spread
        return FormationReport(seconds, slots, errors, self._closest_m, None if spread is None else spread.maximum)


def station(leader: Feedback, offset: ArrayLike, *, turn: bool = True) -> NDArray[np.float64]:
    """Return the position at an offset from a leader.

    Args:
        leader: The leader's newest feedback.
        offset: Offset, (3,) [m]: forward, left and up in the leader's axes or, with ``turn=False``, east, north and up.
        turn: Whether the offset rotates with the leader's yaw.

    Returns:
        The position in world axes [m], shape (3,).

    Raises:
        UsageError: The leader's position or yaw is unknown.
    """
    problem = lacking(leader)
    if problem or leader.position_m is None or leader.yaw_rad is None:
        raise UsageError(f"can't keep a position relative to the leader: {problem}")
    relative = _offset(offset)
    turned = rotation_from_euler(0.0, 0.0, leader.yaw_rad) @ relative if turn else relative
    return np.asarray(leader.position_m + turned, dtype=np.float64)


def _carried_on(airframe: Airframe) -> Feedback:
    """Return a drone's newest feedback, filling in a missing yaw or position from earlier samples if possible.

    The yaw may be up to 0.5 s old; the position is extrapolated over at most 0.5 s.
    """
    sample = airframe.feedback
    assert sample is not None, "called only after the first feedback"
    now_ns = sample.captured_ns
    sample = replace_fields(sample, yaw_rad=airframe.yaw_rad(now_ns))
    position = airframe.position_m(now_ns, longest_s=math.inf)
    if position is not None:
        blind_s = within(airframe.age_s(Part.POSITION, now_ns), 0.0, STALE_S)
        position = _vector(position + blind_s * _world_velocity(sample))
    return replace_fields(sample, position_m=position)


def _minimum_jerk(share: float) -> tuple[float, float]:
    """Return distance and speed for a path of length 1 flown from rest to rest in time 1 (Flash and Hogan 1985)."""
    t = within(share, 0.0, 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t), 30.0 * t * t * (1.0 - t) ** 2


def _offset(offset: ArrayLike) -> NDArray[np.float64]:
    place: NDArray[np.float64] = places(np.asarray(offset)[None])[0]
    return place


def _positions(samples: Mapping[str, Feedback]) -> Places:
    positions = [sample.position_m or (math.nan, math.nan, math.nan) for sample in samples.values()]
    return places(np.array(positions).reshape(-1, 3))


def _waypoint(place: NDArray[np.float64], yaw: float | None) -> Waypoint:
    return Waypoint(*_vector(place), yaw)


def _vector(place: NDArray[np.float64]) -> Vector:
    x, y, z = (float(value) for value in place)
    return x, y, z


def _world_velocity(sample: Feedback) -> NDArray[np.float64]:
    """Return the reported velocity in world axes; zero if either velocity or yaw is missing."""
    if sample.yaw_rad is None:
        return np.zeros(3)
    return _in_world(Velocity(*(sample.velocity_m_s or (0.0, 0.0, 0.0))), sample)


def _in_world(velocity: Velocity, sample: Feedback) -> NDArray[np.float64]:
    return np.array([*turned(velocity.forward, velocity.left, sample.yaw_rad or 0.0), velocity.up])


def _command(world: NDArray[np.float64], sample: Feedback, yaw_rate: float) -> Velocity:
    x, y, up = _vector(world)
    return Velocity(*turned(x, y, -(sample.yaw_rad or 0.0)), up, yaw_rate)
