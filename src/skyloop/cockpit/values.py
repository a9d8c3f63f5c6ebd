"""Feedback, commands and statistics as plain JSON values, in SI units and radians.

What is not known is null.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from skyloop.clock import seconds
from skyloop.messages import ACTION_NAMES, AnyAction, Event, Feedback, Value

if TYPE_CHECKING:
    from skyloop.client.monitoring import ChannelStats

Json = dict[str, Any]

_TARGET = re.compile(r"truth\.target\d*\.\w+")
MAX_TEXT = 1000  #: characters of an event that pages get: there may be hundreds for a new one

#: The page's names of feedback's numbers.
_NUMBERS = {
    "battery": "battery",
    "battery_v": "battery_v",
    "roll": "roll_rad",
    "pitch": "pitch_rad",
    "yaw": "yaw_rad",
    "altitude": "altitude_m",
}
#: The page's names of feedback's vectors and of their parts: body axes (x forward, y left, z up), or world axes.
_VECTORS = {
    "velocity": ("velocity_m_s", ("forward", "left", "up")),
    "angular_velocity": ("angular_velocity_rad_s", ("x", "y", "z")),
    "acceleration": ("acceleration_m_s2", ("x", "y", "z")),
    "position": ("position_m", ("x", "y", "z")),
}


def number(value: float | None) -> float | None:
    """Return a number for JSON, to seven digits; None for what is not known or not finite."""
    return None if value is None or not math.isfinite(value) else float(f"{value:.7g}")


def vector(values: tuple[float, ...] | None) -> list[float | None] | None:
    """Return a vector for JSON; None if it is not known."""
    return None if values is None else [number(value) for value in values]


def feedback_values(feedback: Feedback, now_ns: int) -> Json:
    """Return feedback as JSON values; ``now_ns`` is the proxy's clock."""
    return {
        "age_s": number(seconds(now_ns - feedback.captured_ns)),
        "captured_ns": str(feedback.captured_ns),  # too large for JavaScript's numbers
        "state": str(feedback.state),
        **_scalars(feedback),
        "velocity": vector(feedback.velocity_m_s),
        "position": vector(feedback.position_m),
        "failsafe": str(feedback.failsafe),
        "return_phase": str(feedback.return_phase),
        "owner": feedback.owner,
        "owner_priority": feedback.owner_priority,
        "lease": feedback.lease,
    }


def _scalars(feedback: Feedback) -> dict[str, float | None]:
    return {name: number(getattr(feedback, field)) for name, field in _NUMBERS.items()}


def motion_values(feedback: Feedback | None) -> Json:
    """Return what instruments show, each value known by itself."""
    if feedback is None:
        names = ("attitude", "angular_velocity", "altitude", "velocity", "speed", "position", "start", "battery")
        return {**dict.fromkeys(names), "flight": "unknown", "airborne": False}
    velocity = feedback.velocity_m_s
    return {
        "attitude": {name: number(getattr(feedback, _NUMBERS[name])) for name in ("roll", "pitch", "yaw")},
        "angular_velocity": vector(feedback.angular_velocity_rad_s),
        "altitude": number(feedback.altitude_m),
        "velocity": vector(velocity),
        "speed": None if velocity is None else number(math.hypot(*velocity)),
        "position": vector(feedback.position_m),
        "start": vector(feedback.start_position_m),
        "battery": number(feedback.battery),
        "flight": str(feedback.state),
        "airborne": feedback.state.airborne,
    }


def flat_values(
    feedback: Feedback | None, logged: Mapping[str, float], set_point: AnyAction | None
) -> dict[str, float | None]:
    """Return everything that is a number under a name of its own, for plots.

    Names are ``yaw``, ``velocity.forward``, ``native.…``, ``log.…`` and ``set_point.…``. What is not known is left out.

    Args:
        feedback: The newest, None for none.
        logged: The newest number of each series.
        set_point: The command that is applied, None for none.
    """
    found: dict[str, float | None] = {}
    if feedback is not None:
        found |= {name: value for name, value in _scalars(feedback).items() if value is not None}
        for name, (field, parts) in _VECTORS.items():
            values = getattr(feedback, field)
            if values is not None:
                found |= {f"{name}.{part}": number(value) for part, value in zip(parts, values, strict=True)}
        for name, value in (feedback.native or {}).items():
            found |= _numbers(f"native.{name}", value)
    found |= {f"log.{name}": number(value) for name, value in logged.items()}
    if set_point is not None:
        found |= {f"set_point.{name}": number(value) for name, value in _fields(set_point)}
    return found


def set_point_values(action: AnyAction, age_s: float) -> Json:
    """Return a command as it was applied, as JSON values."""
    return {
        "action": ACTION_NAMES[type(action)],
        "values": {name: number(value) for name, value in _fields(action)},
        "age_s": number(age_s),
    }


def mocap_values(pose: tuple[float, ...] | None) -> Json | None:
    """Return the pose that motion capture gives, as JSON values.

    Args:
        pose: Position [m] and quaternion x, y, z, w; None if it is not known.
    """
    if pose is None:
        return None
    x, y, z, w = pose[3:7]
    return {"position": vector(pose[:3]), "yaw": number(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))}


def truth_values(native: Mapping[str, Value] | None) -> Json | None:
    """Return where a simulated vehicle really is: ``native``'s ``truth.x``, ``.y``, ``.z`` [m] and ``.yaw`` [rad]."""
    return None if native is None else _place(native, "truth")


def target_values(native: Mapping[str, Value] | None) -> list[Json]:
    """Return the moving targets of a simulated world: ``truth.target``, ``truth.target2``, …, as JSON values."""
    if native is None:
        return []
    names = sorted({key.rpartition(".")[0] for key in native if _TARGET.fullmatch(key)})
    places = ((name.removeprefix("truth."), _place(native, name)) for name in names)
    return [{"name": name, **place} for name, place in places if place is not None]


def event_values(number_: int, event: Event, now_ns: int) -> Json:
    """Return an event as JSON values.

    Args:
        number_: The number that the cockpit gave it.
        event: The event.
        now_ns: The proxy's clock.
    """
    return {
        "n": number_,
        "kind": str(event.kind),
        "severity": str(event.severity),
        "text": event.text[:MAX_TEXT],
        "app": event.app,
        "age_s": number(seconds(now_ns - event.at_ns)),
        "at_ns": str(event.at_ns),
    }


def channel_values(stats: ChannelStats) -> Json:
    """Return one channel's figures as JSON values; delays in seconds."""
    delay = stats.delay_s
    return {
        "count": stats.count,
        "rate_hz": number(stats.rate_hz),
        "lost": stats.lost,
        "dropped": stats.dropped,
        "malformed": stats.malformed,
        "age_s": number(stats.age_s),
        "delay_s": None if delay is None else {"median": number(delay.median), "p99": number(delay.p99)},
    }


def _place(native: Mapping[str, Value], name: str) -> Json | None:
    values = [native.get(f"{name}.{part}") for part in ("x", "y", "z")]
    if not all(isinstance(value, int | float) for value in values):
        return None
    yaw = native.get(f"{name}.yaw")
    known = yaw if isinstance(yaw, int | float) else None
    return {"position": [number(value) for value in values], "yaw": number(known)}  # type: ignore[arg-type]


def _numbers(name: str, value: Value) -> dict[str, float | None]:
    if isinstance(value, int | float):
        return {name: number(value)}
    if isinstance(value, tuple):
        return {f"{name}.{place}": number(one) for place, one in enumerate(value)}
    return {}


def _fields(action: AnyAction) -> Iterator[tuple[str, float]]:
    for name in action.__struct_fields__:
        yield name, getattr(action, name)
