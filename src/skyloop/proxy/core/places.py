"""What becomes of a command to fly to a place: refused, or within the limits. Pure: the time is an argument."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from skyloop.clock import NS_PER_S, seconds
from skyloop.messages import Feedback, Position, Refusal
from skyloop.messages.feedback import NO_POSITION, POSITION_SOURCES
from skyloop.proxy.core.limits import SLACK_M, Clamp, Limits
from skyloop.proxy.core.safety import STALE_NS
from skyloop.zones import Space, Vec3

LOST_NS: Final = 2 * NS_PER_S  #: a position that is older is not waited for
_NO_WAY_M: Final = 0.05  #: so near the place there is no direction that the limits could be applied to


class PlaceDecision(NamedTuple):
    """What becomes of a command to fly to a place."""

    action: Position | None = None  #: within the limits, with both speeds filled in; None: the vehicle must stop
    clamps: tuple[Clamp, ...] = ()  #: the limits that were in the way of it
    refusal: Refusal | None = None  #: None without an action: it goes on as soon as a young position comes
    why: str = ""  #: of the refusal, for a person


def decide_place(
    action: Position, limits: Limits, space: Space, feedback: Feedback | None, now_ns: int, *, new: bool
) -> PlaceDecision:
    """Decide what becomes of a command to fly to a place.

    Args:
        action: what is asked for; finite.
        limits: those in force.
        space: where it may fly.
        feedback: the newest sample; None: none came yet.
        now_ns: the time now, on the clock of ``feedback.captured_ns`` [ns].
        new: whether an application newly asked for it: a repeat is not refused for what is in the way, as the vehicle
            may have drifted, nor for its height, which is lowered instead.
    """
    if action.problem:
        return PlaceDecision(None, (), Refusal.OUT_OF_RANGE, action.problem)
    unknown = _why_unknown(feedback, now_ns)
    if unknown or feedback is None or feedback.position_m is None:
        return PlaceDecision(None, (), Refusal.WRONG_STATE, unknown)
    if now_ns - feedback.captured_ns > STALE_NS:
        return PlaceDecision()
    x, y, z = action.place
    at = feedback.position_m
    clamps: list[Clamp] = []
    if feedback.altitude_m is not None:
        above = feedback.altitude_m + z - at[2] - limits.altitude
        if above > SLACK_M:
            if new:
                why = f"z is {z:g} m, and at most {z - above:.2f} m is allowed: {limits.altitude:g} m above the ground"
                return PlaceDecision(None, (), Refusal.OUT_OF_RANGE, f"{why} (limits.altitude)")
            clamps.append(Clamp("limits.altitude", z, z - above))
            z -= above
    place = (x, y, z)
    problem = space.problem_at(place) or (space.problem_between(at, place) if new else "")
    if problem:
        return PlaceDecision(None, (), Refusal.OUT_OF_RANGE, problem)
    if new and feedback.altitude_m is not None and (below := at[2] - feedback.altitude_m - z) > SLACK_M:
        why = f"z is {z:g} m, which is {below:.2f} m below the ground under the vehicle"
        return PlaceDecision(None, (), Refusal.OUT_OF_RANGE, f"{why}: choose a place above it")
    speed, limit = _fastest(at, place, limits)
    if new and action.speed is not None and action.speed > speed:  # reported once: the direction turns near the place
        clamps.append(Clamp(limit, action.speed, speed))
    turn_rate = limits.yaw_rate
    if action.turn_rate is not None and action.turn_rate > turn_rate:
        clamps.append(Clamp("limits.yaw_rate", action.turn_rate, turn_rate))
    fitted = Position(
        x, y, z, action.yaw, min(speed, action.speed or math.inf), min(turn_rate, action.turn_rate or math.inf)
    )
    return PlaceDecision(fitted, tuple(clamps))


def _why_unknown(feedback: Feedback | None, now_ns: int) -> str:
    """Why the vehicle can't be flown to a place now, and what helps; empty if it can."""
    if feedback is None or feedback.position_m is None:
        return f"{NO_POSITION}: fly it by velocity, or {POSITION_SOURCES}"
    if feedback.yaw_rad is None:
        return "the vehicle does not report its yaw: fly it by velocity"
    age_ns = now_ns - feedback.captured_ns
    if age_ns > LOST_NS:
        return (
            f"the vehicle's newest position is {seconds(age_ns):.1f} s old, at most {seconds(LOST_NS):g} s are allowed"
        )
    return ""


def _fastest(at: Vec3, place: Vec3, limits: Limits) -> tuple[float, str]:
    """The greatest speed along the straight way that keeps to those across and upwards, and which of them it is."""
    across, up = math.dist(at[:2], place[:2]), abs(place[2] - at[2])
    away = math.hypot(across, up)
    if away < _NO_WAY_M:
        return (limits.speed, "limits.speed") if limits.speed <= limits.climb else (limits.climb, "limits.climb")
    by_speed = limits.speed * away / across if across > 0.0 else math.inf
    by_climb = limits.climb * away / up if up > 0.0 else math.inf
    return (by_speed, "limits.speed") if by_speed <= by_climb else (by_climb, "limits.climb")
