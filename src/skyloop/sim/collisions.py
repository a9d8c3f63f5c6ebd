"""Collisions of drones with the floor, solids and each other: contact, bounce and friction.

Every few steps, a broad phase finds everything within each drone's reach until the next broad phase. The steps in
between check only those pairs: as arrays if there are many drones, and one at a time if there are few.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from skyloop.messages.geometry import clamped
from skyloop.sim.dynamics import ARRAYS, NUMBERS, STEP_S, BodyTable, N, Operations, column, few
from skyloop.sim.parameters import VehicleParameters
from skyloop.sim.solids import Indices, Overlap, Solids, overlapping
from skyloop.sim.streams import Floats
from skyloop.sim.world import Vec3

_STILL_M_S = 0.3  # speed along the normal below which contacts don't bounce; without it, nothing would come to rest
_PASSES = 6  # number of attempts per step to push a drone out of solids
_TOUCH_M = 1e-9  # maximum overlap that is treated as touching, because rounding leaves small overlaps
#: Number of steps between broad phases. With few drones, a broad phase costs as much but leaves fewer pairs to check.
BROAD_PHASE_STEPS, BROAD_PHASE_STEPS_OF_FEW = 15, 30
_SLACK_M = 0.03  # extra reach in a broad phase, because drones may be pushed
#: Maximum number of pairs for which checking them one at a time is faster.
FEW_PAIRS = 6


@dataclass(slots=True)
class Contacts:
    """The contacts during one step."""

    standing: set[int] = field(default_factory=set)  #: drones standing on an object that is not a drone
    #: pairs of drones that stand on one another, the upper drone first
    upon: list[tuple[int, int]] = field(default_factory=list)
    #: drone, speed along the normal [m/s], and name of the other object
    impacts: list[tuple[int, float, str]] = field(default_factory=list)


@dataclass(slots=True)
class _Near:
    """Everything that the drones can reach before the next broad phase."""

    one: Indices  #: index of the first drone (the lower index) in each pair of drones within reach
    other: Indices  #: the second drone of each pair
    across: Floats  #: the square of the sum of the pair's radii
    upright: Floats  #: the square of the sum of the pair's half heights
    #: the solids within reach, by drone; drones that are near only a wall or the ceiling have no entry
    solids: dict[int, list[int]]
    who: Indices  #: index of the drone in each pair of a drone and a solid
    what: Indices  #: index of the solid in each of these pairs
    sizes: Floats  #: sizes of the solids; see :meth:`Solids.sizes`
    moving: bool  #: whether one of these solids is moving
    walled: Indices  #: drones that can reach a wall or the ceiling
    room_low: Floats  #: minimum coordinates of the centres of those drones, (3, walled)
    room_high: Floats  #: maximum coordinates


class Collisions:
    """Keeps drones out of solids and apart from one another. Called once per step."""

    def __init__(self, parameters: Sequence[VehicleParameters], bodies: BodyTable, solids: Solids) -> None:
        self._bodies = bodies
        self._solids = solids
        radius = column(parameters, lambda p: p.radius_m)
        self._hull = np.array([radius, radius, column(parameters, lambda p: p.half_height_m)])
        self._widest = float(radius.max())
        self._radii, self._half_heights = radius.tolist(), self._hull[2].tolist()
        self._low, self._high = solids.room_low + self._hull, solids.room_high - self._hull  # limits for the centres
        self._bounce = [p.restitution for p in parameters]
        self._friction = [p.friction for p in parameters]
        self._floor_constants = np.array(self._bounce), np.array(self._friction)
        self._mass = [p.mass_kg for p in parameters]
        self._on_floor = np.zeros(len(parameters), dtype=np.bool_)
        self._feet = self._hull[2]
        # Views of the rows, because writing single numbers to rows is faster than writing them to columns.
        self._x, self._y, self._z = bodies.position
        self._vx, self._vy, self._vz = bodies.velocity
        self._free = bodies.position.copy()  # last position at which each drone was clear of all fixed objects
        self._broad_phase_steps = BROAD_PHASE_STEPS_OF_FEW if few(len(parameters)) else BROAD_PHASE_STEPS
        self._span_m = _span(bodies.most_acceleration_m_s2, self._broad_phase_steps)
        self._next = 0  # step of the next broad phase
        self._reach = np.zeros(len(parameters))  # distance that each drone can cover before the next broad phase
        self._extra_reach = [0.0 for _ in parameters]  # additional movement that pushes and impacts cause
        self._run_broad_phase(0)
        self._next = 0

    def resolve(self, step: int) -> Contacts | None:
        """Resolve the overlaps after the last step; return the contacts, or None if there were none."""
        contacts: Contacts | None = None
        np.less(self._z, self._feet, out=self._on_floor)
        if np.count_nonzero(self._on_floor):
            contacts = Contacts()
            self._meet_floor(self._on_floor.nonzero()[0], contacts)
        refreshed = step >= self._next
        if refreshed:
            self._run_broad_phase(step)
        elif self._near.moving:
            self._solids.move((step + 1) * STEP_S)
        if len(self._near.one) or self._near.solids:
            contacts = contacts or Contacts()
            self._narrow(step, contacts)
        if refreshed or self._near.solids:
            np.copyto(self._free, self._bodies.position)
        return contacts

    def _narrow(self, step: int, contacts: Contacts) -> None:
        if len(self._near.one) and self._meet_drones((self._next - step) * STEP_S, contacts):
            self._run_broad_phase(step)
        left_s = (self._next - step) * STEP_S
        for drone in self._within_solids():
            if self._meet_solids(drone, left_s, contacts):
                self._next = step + 1

    def moved(self, drone: int) -> None:
        """Record that a drone was moved to another position."""
        self._free[:, drone] = self._bodies.position[:, drone]
        self._next = 0

    # The broad phase -------------------------------------------------------------------------------------------

    def _run_broad_phase(self, step: int) -> None:
        """Find everything within each drone's reach until the next broad phase."""
        solids, position, velocity = self._solids, self._bodies.position, self._bodies.velocity
        if solids.moving:
            solids.move((step + 1) * STEP_S)
        self._next = step + self._broad_phase_steps
        seconds = self._broad_phase_steps * STEP_S
        self._extra_reach = [0.0] * len(self._extra_reach)
        np.sqrt((velocity * velocity).sum(axis=0), out=self._reach)
        np.multiply(self._reach, seconds, out=self._reach)
        np.add(self._reach, self._span_m + _SLACK_M, out=self._reach)
        low, high = position - self._reach, position + self._reach
        walled = ((low < self._low) | (high > self._high)).any(axis=0).nonzero()[0]
        bounds = solids.bounds(seconds, self._widest)
        low, high = (np.hstack(pair) for pair in zip((low - self._hull, high + self._hull), bounds, strict=True))
        drones = len(self._reach)
        first, second = overlapping(low, high, drones)
        between = second < drones
        one, other = first.compress(between), second.compress(between)
        radius, _, half_height = self._hull.take(one, axis=1) + self._hull.take(other, axis=1)
        np.logical_not(between, out=between)
        who, what = first.compress(between), second.compress(between) - drones
        near: dict[int, list[int]] = {drone: [] for drone in sorted({*walled.tolist(), *who.tolist()})}
        for drone, solid in zip(who.tolist(), what.tolist(), strict=True):
            near[drone].append(solid)
        self._near = _Near(
            one=one,
            other=other,
            across=radius * radius,
            upright=half_height * half_height,
            solids=near,
            who=who,
            what=what,
            sizes=solids.sizes(what, self._hull.take(who, axis=1)),
            moving=bool((what >= solids.fixed).any()),
            walled=walled,
            room_low=self._low.take(walled, axis=1),
            room_high=self._high.take(walled, axis=1),
        )

    def _extend_reach(self, drone: int, metres: float) -> bool:
        """Extend a drone's possible movement; return whether it exceeds the reach of the last broad phase."""
        self._extra_reach[drone] += metres
        return self._extra_reach[drone] > _SLACK_M

    # The floor -------------------------------------------------------------------------------------------------

    def _meet_floor(self, who: Indices, contacts: Contacts) -> None:
        velocity = self._bodies.velocity
        drones: list[int] = who.tolist()
        contacts.standing.update(drones)
        if few(len(drones)):
            for drone in drones:
                self._z[drone] = self._half_heights[drone]
                before = velocity[:, drone].tolist()
                vx, vy, vz, falling = _off_floor(NUMBERS, before, self._bounce[drone], self._friction[drone])
                self._vx[drone], self._vy[drone], self._vz[drone] = vx, vy, vz
                if falling > _STILL_M_S:
                    contacts.impacts.append((drone, falling, "the floor"))
        else:
            self._z[who] = self._feet[who]
            bounce, friction = (values.take(who) for values in self._floor_constants)
            vx, vy, vz, falling = _off_floor(ARRAYS, velocity.take(who, axis=1), bounce, friction)
            self._vx[who], self._vy[who], self._vz[who] = vx, vy, vz
            for hard in (falling > _STILL_M_S).nonzero()[0].tolist():
                contacts.impacts.append((drones[hard], float(falling[hard]), "the floor"))

    # Solids ----------------------------------------------------------------------------------------------------

    def _within_solids(self) -> list[int]:
        """Return the drones that may be inside a solid, a wall or the ceiling, in ascending order."""
        near, position = self._near, self._bodies.position
        if len(near.who) + len(near.walled) <= FEW_PAIRS:
            return list(near.solids)
        found = set()
        if len(near.who):
            within = self._solids.within(position.take(near.who, axis=1), near.what, near.sizes)
            found.update(near.who.take(within).tolist())
        if len(near.walled):
            at = position.take(near.walled, axis=1)
            beyond = ((at < near.room_low) | (at > near.room_high)).any(axis=0)
            found.update(near.walled[beyond].tolist())
        return sorted(found)

    def _meet_solids(self, drone: int, left_s: float, contacts: Contacts) -> bool:
        """Push a drone out of solids; return whether it might leave the broad phase's reach in the remaining time."""
        bodies, radius, half_height = self._bodies, self._radii[drone], self._half_heights[drone]
        x, y, z = start = bodies.position[:, drone].tolist()
        height, climb = z, float(self._vz[drone])
        among: list[int] | None = self._near.solids[drone]
        pushed, carried = 0.0, 0.0
        for _ in range(_PASSES):
            overlap = self._solids.overlap((x, y, z), radius, half_height, among)
            if overlap is None or overlap.depth_m <= _TOUCH_M:
                if not pushed:
                    return False
                break
            pushed += overlap.depth_m
            if pushed > _SLACK_M:
                among = None
            normal_x, normal_y, normal_z = overlap.normal
            x, y = x + normal_x * overlap.depth_m, y + normal_y * overlap.depth_m
            z = max(z + normal_z * overlap.depth_m, half_height)
            impact, more_x, more_y, faster = self._rebound(drone, overlap)
            carried += faster
            # Friction also affects the motion in this step; otherwise a drone standing in wind would creep.
            x, y = x + more_x * STEP_S, y + more_y * STEP_S
            if normal_z > 0.5:
                contacts.standing.add(drone)
            if impact > _STILL_M_S:
                contacts.impacts.append((drone, impact, "something solid"))
        else:
            # (A moving platform may overlap the drone afterwards: the drone can't be clear of both.)
            if self._within_fixed(drone, (x, y, z)):
                x, y, z = self._wedge(drone, height, climb, contacts)
        self._x[drone], self._y[drone], self._z[drone] = x, y, z
        return self._extend_reach(drone, math.dist(start, (x, y, z)) + carried * left_s)

    def _wedge(self, drone: int, height: float, climb: float, contacts: Contacts) -> Vec3:
        """Return the position of a wedged drone, which can't be pushed out of one object without entering another.

        In the horizontal plane, the drone returns to its last clear position. Its vertical motion remains free, because
        the objects that wedge it in do not support it. There is no friction: in a narrow enough corner the pressure
        would grow without limit and hold the drone in the air forever.
        """
        free_x, free_y, free_z = self._free[:, drone].tolist()
        self._vx[drone], self._vy[drone], self._vz[drone] = 0.0, 0.0, climb
        if not self._within_fixed(drone, (free_x, free_y, height)):
            return free_x, free_y, height
        # All faces are horizontal or vertical, so if this step is reached, the drone is blocked from above or below.
        self._vz[drone] = 0.0
        if height < free_z:
            contacts.standing.add(drone)
        return free_x, free_y, free_z

    def _within_fixed(self, drone: int, point: Vec3) -> bool:
        overlap = self._solids.overlap(point, self._radii[drone], self._half_heights[drone], range(self._solids.fixed))
        return overlap is not None and overlap.depth_m > _TOUCH_M

    def _rebound(self, drone: int, overlap: Overlap) -> tuple[float, float, float, float]:
        """Remove the velocity into the surface and apply friction.

        Return the velocity into the surface [m/s], the changes of velocity east and north, and the increase in speed.
        """
        vx, vy, vz = self._bodies.velocity[:, drone].tolist()
        nx, ny, nz = overlap.normal
        surface_x, surface_y, surface_z = overlap.surface_m_s
        along_x, along_y, along_z = vx - surface_x, vy - surface_y, vz - surface_z
        into = -(along_x * nx + along_y * ny + along_z * nz)
        if into <= 0:
            return 0.0, 0.0, 0.0, 0.0
        back = into * self._bounce[drone] if into > _STILL_M_S else 0.0
        along_x, along_y, along_z = along_x + into * nx, along_y + into * ny, along_z + into * nz
        sliding = math.sqrt(along_x * along_x + along_y * along_y + along_z * along_z)
        left = max(0.0, 1.0 - self._friction[drone] * (into + back) / sliding) if sliding > 0 else 0.0
        after_x, after_y = surface_x + along_x * left + back * nx, surface_y + along_y * left + back * ny
        after_z = surface_z + along_z * left + back * nz
        self._vx[drone], self._vy[drone], self._vz[drone] = after_x, after_y, after_z
        if nz > 0.5:
            self._turn_along(drone, overlap.spin_rad_s, into + back)
        before = math.sqrt(vx * vx + vy * vy + vz * vz)
        faster = math.sqrt(after_x * after_x + after_y * after_y + after_z * after_z) - before
        return into, after_x - vx, after_y - vy, max(faster, 0.0)

    def _turn_along(self, drone: int, spin_rad_s: float, impulse_m_s: float) -> None:
        """Rotate the drone with the turning surface below it, by friction over the whole contact disk.

        With pressure p = F / πR², the torque is 2/3 μ F R, against the disk's moment of inertia m R² / 2.
        """
        most = self._friction[drone] * impulse_m_s * (4 / 3) / self._radii[drone]
        self._bodies.turn(drone, clamped(spin_rad_s - float(self._bodies.rates[2, drone]), most))

    # Drones ----------------------------------------------------------------------------------------------------

    def _meet_drones(self, left_s: float, contacts: Contacts) -> bool:
        """Separate overlapping drones; return whether one might leave the broad phase's reach in the time remaining."""
        strayed = False
        for one, other in self._close_pairs():
            if self._separate(one, other, left_s, contacts):
                strayed = True
        return strayed

    def _close_pairs(self) -> list[tuple[int, int]]:
        near, position = self._near, self._bodies.position
        apart = position.take(near.one, axis=1) - position.take(near.other, axis=1)
        np.multiply(apart, apart, out=apart)
        east, north, up = apart
        np.add(east, north, out=east)
        close = (east < near.across) & (up < near.upright)
        if not np.count_nonzero(close):
            return []
        which = close.nonzero()[0]
        return list(zip(near.one.take(which).tolist(), near.other.take(which).tolist(), strict=True))

    def _separate(self, one: int, other: int, left_s: float, contacts: Contacts) -> bool:
        position, velocity = self._bodies.position, self._bodies.velocity
        one_x, one_y, one_z = position[:, one].tolist()
        other_x, other_y, other_z = position[:, other].tolist()
        away_x, away_y, away_z = one_x - other_x, one_y - other_y, one_z - other_z
        size = math.sqrt(away_x * away_x + away_y * away_y)
        across = size - (self._radii[one] + self._radii[other])
        upright = abs(away_z) - (self._half_heights[one] + self._half_heights[other])
        depth = -max(across, upright)
        if depth <= 0.0:
            return False  # a third drone pushed them apart
        if across > upright:
            nx, ny, nz = (away_x / size, away_y / size, 0.0) if size > 1e-6 else (1.0, 0.0, 0.0)
        else:
            nx, ny, nz = 0.0, 0.0, 1.0 if away_z >= 0 else -1.0
            contacts.upon.append((one, other) if away_z >= 0 else (other, one))
        mine = self._mass[other] / (self._mass[one] + self._mass[other])
        theirs = 1.0 - mine
        one_z, other_z = one_z + nz * depth * mine, other_z - nz * depth * theirs
        # Neither drone may be pushed into the floor, so both of them are lifted instead.
        up = max(self._half_heights[one] - one_z, self._half_heights[other] - other_z, 0.0)
        self._x[one], self._y[one], self._z[one] = one_x + nx * depth * mine, one_y + ny * depth * mine, one_z + up
        self._x[other], self._y[other] = other_x - nx * depth * theirs, other_y - ny * depth * theirs
        self._z[other] = other_z + up
        one_vx, one_vy, one_vz = velocity[:, one].tolist()
        other_vx, other_vy, other_vz = velocity[:, other].tolist()
        into = -((one_vx - other_vx) * nx + (one_vy - other_vy) * ny + (one_vz - other_vz) * nz)
        change = 0.0
        if into > 0:
            change = into * (1.0 + (min(self._bounce[one], self._bounce[other]) if into > _STILL_M_S else 0.0))
            more, less = change * mine, change * theirs
            self._vx[one], self._vy[one], self._vz[one] = one_vx + nx * more, one_vy + ny * more, one_vz + nz * more
            self._vx[other], self._vy[other] = other_vx - nx * less, other_vy - ny * less
            self._vz[other] = other_vz - nz * less
            if into > _STILL_M_S:
                contacts.impacts += [(one, into, "another drone"), (other, into, "another drone")]
        further = depth + change * left_s
        return self._extend_reach(one, further * mine + up) | self._extend_reach(other, further * theirs + up)


def _off_floor(do: Operations, velocity: N, bounce: N, friction: N) -> tuple[N, N, N, N]:
    """Return the velocity after a contact with the floor, and the impact speed along the normal [m/s]."""
    vx, vy, vz = velocity
    falling = do.most(-vz, 0.0)
    back = do.choose(falling > _STILL_M_S, falling * bounce, 0.0)
    left = do.most(1.0 - friction * (falling + back) / do.most(do.root(vx * vx + vy * vy), 1e-9), 0.0)
    return vx * left, vy * left, do.most(vz, back), falling


def _span(acceleration_m_s2: float, steps: int) -> float:
    """Return the maximum distance [m] that a drone can cover from rest in this many steps."""
    return acceleration_m_s2 * STEP_S * STEP_S * steps * (steps + 1) / 2
