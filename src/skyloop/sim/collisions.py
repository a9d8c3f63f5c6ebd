"""Collisions of drones with the floor, solid things and one another: contact, bounce and friction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from skyloop.sim.dynamics import STEP_S, Bodies, column
from skyloop.sim.parameters import VehicleParameters
from skyloop.sim.solids import Indices, Overlap, Solids
from skyloop.sim.streams import Floats

_MOST_ACCELERATION_M_S2 = 60.0  # above what thrust, gravity and drag at 10 m/s of headwind give together
_STILL_M_S = 0.3  # along the normal: slower contacts don't bounce, or things would never come to rest
_PASSES = 6
_TOUCH_M = 1e-9  # overlaps up to this are touching: rounding alone leaves some that no push ends
_FAR_STEPS = 250


@dataclass(slots=True)
class Contacts:
    """What was touched in a step.

    Attributes:
        standing: Drones with something under their feet that is no drone.
        upon: Drones on drones, the upper one first.
        impacts: Drone, speed along the normal [m/s], and what it met.
    """

    standing: set[int] = field(default_factory=set)
    upon: list[tuple[int, int]] = field(default_factory=list)
    impacts: list[tuple[int, float, str]] = field(default_factory=list)


class Collisions:
    """Keeps drones out of solids and of one another; called once per step."""

    def __init__(self, parameters: Sequence[VehicleParameters], bodies: Bodies, solids: Solids) -> None:
        self._bodies = bodies
        self._solids = solids
        radius = column(parameters, lambda p: p.radius_m)
        self._hull = np.array([radius, radius, column(parameters, lambda p: p.half_height_m)])
        self._bounce = column(parameters, lambda p: p.restitution)
        self._friction = column(parameters, lambda p: p.friction)
        self._mass = column(parameters, lambda p: p.mass_kg)
        self._due = np.zeros(len(parameters), dtype=np.int64)
        self._next = 0
        self._free = bodies.position.copy()  # where each drone last was clear of all that doesn't move

    def resolve(self, step: int) -> Contacts | None:
        """Resolve the overlaps of the last step; return the contacts, or None without any."""
        contacts: Contacts | None = None
        low = self._bodies.position[2] < self._hull[2]
        if low.any():
            contacts = Contacts()
            self._meet_floor(np.flatnonzero(low), contacts)
        if step >= self._next:
            contacts = self._look_around(step, contacts or Contacts())
        return contacts

    def _meet_floor(self, who: Indices, contacts: Contacts) -> None:
        position, velocity = self._bodies.position, self._bodies.velocity
        position[2, who] = self._hull[2, who]
        falling = np.maximum(-velocity[2, who], 0.0)
        bounce = np.where(falling > _STILL_M_S, falling * self._bounce[who], 0.0)
        velocity[2, who] = np.maximum(velocity[2, who], bounce)
        sliding = np.hypot(velocity[0, who], velocity[1, who])
        lost = self._friction[who] * (falling + bounce)
        velocity[:2, who] *= np.maximum(1.0 - lost / np.maximum(sliding, 1e-9), 0.0)
        contacts.standing.update(who.tolist())
        if falling.max() > _STILL_M_S:
            hard = falling > _STILL_M_S
            contacts.impacts += [(int(i), float(v), "the floor") for i, v in zip(who[hard], falling[hard], strict=True)]

    def _look_around(self, step: int, contacts: Contacts) -> Contacts:
        who = np.flatnonzero(self._due <= step)
        if self._solids.moving:
            self._solids.move((step + 1) * STEP_S)
        if len(self._due) > 1:
            pushed = self._meet_drones(who, contacts)
            if pushed:
                who = np.union1d(who, pushed)
        clearance = self._solids.clearance(self._bodies.position[:, who], self._hull[:, who])
        for drone in who[clearance < 0].tolist():
            self._meet_solids(drone, contacts)
        self._free[:, who] = self._bodies.position[:, who]
        self._plan(step, who, clearance)
        return contacts

    def _meet_solids(self, drone: int, contacts: Contacts) -> None:
        position, hull = self._bodies.position[:, drone].copy(), self._hull[:, drone]
        height, climb = float(position[2]), float(self._bodies.velocity[2, drone])
        for _ in range(_PASSES):
            overlap = self._solids.overlap(position, hull)
            if overlap is None or overlap.depth_m <= _TOUCH_M:
                break
            position += np.array(overlap.normal) * overlap.depth_m
            position[2] = max(position[2], hull[2])
            before = self._bodies.velocity[:2, drone].copy()
            impact = self._rebound(drone, overlap)
            # Friction acts on this step's motion too, or a drone that stands in wind would creep.
            position[:2] += (self._bodies.velocity[:2, drone] - before) * STEP_S
            if overlap.normal[2] > 0.5:
                contacts.standing.add(drone)
            if impact > _STILL_M_S:
                contacts.impacts.append((drone, impact, "something solid"))
        else:
            # (A moving platform may overlap it afterwards: it can't be clear of both.)
            if self._within_fixed(position, hull):
                position = self._wedge(drone, height, climb, contacts)
        self._bodies.position[:, drone] = position

    def _wedge(self, drone: int, height: float, climb: float, contacts: Contacts) -> Floats:
        """Return the position of a drone that is wedged, so that pushing it out of one thing leads into another.

        It is across where it was clear, and free vertically, for nothing that it is wedged between holds it there. It
        has no friction: what presses it would grow without end in a narrow enough corner, and hold it in the air for
        ever.
        """
        velocity, free = self._bodies.velocity[:, drone], self._free[:, drone]
        position = np.array([free[0], free[1], height])
        velocity[:] = 0.0, 0.0, climb
        if self._within_fixed(position, self._hull[:, drone]):  # all faces are level or upright: one above or below
            position[2] = free[2]
            velocity[2] = 0.0
            if height < free[2]:
                contacts.standing.add(drone)
        return position

    def _within_fixed(self, position: Floats, hull: Floats) -> bool:
        overlap = self._solids.overlap(position, hull, moving=False)
        return overlap is not None and overlap.depth_m > _TOUCH_M

    def _rebound(self, drone: int, overlap: Overlap) -> float:
        """Take the velocity into the surface back, and rub; returns that velocity [m/s]."""
        direction, surface = np.array(overlap.normal), np.array(overlap.surface_m_s)
        relative = self._bodies.velocity[:, drone] - surface
        into = -float(relative @ direction)
        if into <= 0:
            return 0.0
        back = into * self._bounce[drone] if into > _STILL_M_S else 0.0
        along = relative + into * direction
        sliding = float(np.linalg.norm(along))
        if sliding > 0:
            along *= max(0.0, 1.0 - self._friction[drone] * (into + back) / sliding)
        self._bodies.velocity[:, drone] = surface + along + back * direction
        if overlap.normal[2] > 0.5:
            self._turn_along(drone, overlap.spin_rad_s, into + back)
        return into

    def _turn_along(self, drone: int, spin_rad_s: float, impulse_m_s: float) -> None:
        """Let a surface that turns take a drone on it along: friction all over the foot print of a disk.

        With pressure p = F / πR² its torque is 2/3 μ F R, against the disk's moment of inertia m R² / 2.
        """
        most = self._friction[drone] * impulse_m_s * (4 / 3) / self._hull[0, drone]
        change = max(-most, min(most, spin_rad_s - float(self._bodies.rates[2, drone])))
        self._bodies.rates[2, drone] += change
        self._bodies.angles[2, drone] += change * STEP_S

    def _meet_drones(self, who: Indices, contacts: Contacts) -> list[int]:
        """Part the drones that overlap; returns those that were pushed."""
        across, upright = self._gaps(who)
        close = (across < 0) & (upright < 0)
        close[np.arange(len(who)), who] = False
        pushed: list[int] = []
        if close.any():
            for row, other in zip(*np.nonzero(close), strict=True):
                drone = int(who[row])
                if other > drone or other not in who:
                    self._part(drone, int(other), float(across[row, other]), float(upright[row, other]), contacts)
                    pushed += [drone, int(other)]
        return pushed

    def _gaps(self, who: Indices) -> tuple[Floats, Floats]:
        """Gaps between hulls, across and upright, each (m, n), to all others (and, without sense, to itself)."""
        position, radius, half = self._bodies.position, self._hull[0], self._hull[2]
        east = position[0] - position[0, who, None]
        north = position[1] - position[1, who, None]
        across = np.sqrt(east * east + north * north) - (radius + radius[who, None])
        upright = np.abs(position[2] - position[2, who, None]) - (half + half[who, None])
        return across, upright

    def _part(self, one: int, other: int, across: float, upright: float, contacts: Contacts) -> None:
        position, velocity = self._bodies.position, self._bodies.velocity
        away = position[:, one] - position[:, other]
        if across > upright:
            away[2] = 0.0
            size = math.hypot(away[0], away[1])
            normal = away / size if size > 1e-6 else np.array([1.0, 0.0, 0.0])
            depth = -across
        else:
            normal, depth = np.array([0.0, 0.0, 1.0 if away[2] >= 0 else -1.0]), -upright
            contacts.upon.append((one, other) if away[2] >= 0 else (other, one))
        share = float(self._mass[other] / (self._mass[one] + self._mass[other]))
        position[:, one] += normal * depth * share
        position[:, other] -= normal * depth * (1.0 - share)
        self._keep_above_floor(one, other)
        into = -float((velocity[:, one] - velocity[:, other]) @ normal)
        if into > 0:
            change = into * (1.0 + (min(self._bounce[one], self._bounce[other]) if into > _STILL_M_S else 0.0))
            velocity[:, one] += normal * change * share
            velocity[:, other] -= normal * change * (1.0 - share)
            if into > _STILL_M_S:
                contacts.impacts += [(one, into, "another drone"), (other, into, "another drone")]

    def _keep_above_floor(self, *drones: int) -> None:
        """Lift a drone that another one has just pushed into the floor, and the other by as much."""
        heights = self._bodies.position[2]
        below = max(float(self._hull[2, drone] - heights[drone]) for drone in drones)
        if below > 0.0:
            heights[list(drones)] += below

    def _plan(self, step: int, who: Indices, clearance: Floats) -> None:
        """Set when each drone has to be looked at again. Two drones each may use up half of the gap between them."""
        speed = np.sqrt((self._bodies.velocity**2).sum(axis=0))
        self._due[who] = step + _steps_to(clearance, speed[who] + self._solids.top_speed_m_s)
        if len(self._due) > 1:
            across, upright = self._gaps(who)
            gap = np.maximum(across, upright)
            gap[np.arange(len(who)), who] = np.inf
            nearest = gap.min(axis=0) / 2  # to any of those looked at
            np.minimum(self._due, step + _steps_to(nearest, speed), out=self._due)
            self._due[who] = np.minimum(self._due[who], step + _steps_to(gap.min(axis=1) / 2, speed[who]))
        self._next = int(self._due.min())


def _steps_to(distance: Floats, speed: Floats) -> Floats:
    """Whole steps in which ``distance`` can't be used up, at least 1: from s = v t + a t² / 2."""
    a = _MOST_ACCELERATION_M_S2
    reach = np.minimum(np.maximum(distance, 0.0), 1e3)
    time = (np.sqrt(speed * speed + 2 * a * reach) - speed) / a
    steps: Floats = np.minimum(np.maximum(np.floor(time / STEP_S), 1), _FAR_STEPS).astype(np.int64)
    return steps
