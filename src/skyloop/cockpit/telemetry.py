"""The view model: a drone's data for pages, created once for all pages, as plain JSON values.

All values are in SI units and radians; pages convert them. Unknown values are null.
"""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.cockpit.alarms import Alarm, DegradedTimes, alarms
from skyloop.errors import LinkError
from skyloop.messages import (
    ACTION_NAMES,
    HIGHEST_PRIORITY,
    LOWEST_PRIORITY,
    AnyAction,
    Event,
    Feedback,
    LinkState,
    Value,
)

if TYPE_CHECKING:
    from skyloop.client.monitoring import ChannelStats
    from skyloop.cockpit.station import Station

Json = dict[str, Any]

_TARGET = re.compile(r"truth\.target\d*\.\w+")
MAX_TEXT = 1000  #: maximum length of an event's text; a new page may receive hundreds of events

#: The names that the page uses for the numbers in feedback.
_NUMBERS = {
    "battery": "battery",
    "battery_v": "battery_v",
    "roll": "roll_rad",
    "pitch": "pitch_rad",
    "yaw": "yaw_rad",
    "altitude": "altitude_m",
}
#: The page's names for the vectors in feedback and their components: body axes (x forward, y left, z up) or world axes.
_VECTORS = {
    "velocity": ("velocity_m_s", ("forward", "left", "up")),
    "angular_velocity": ("angular_velocity_rad_s", ("x", "y", "z")),
    "acceleration": ("acceleration_m_s2", ("x", "y", "z")),
    "position": ("position_m", ("x", "y", "z")),
}
_BROKEN = (str(LinkState.LOST), str(LinkState.CLOSED))
_CHANNELS_S = 0.5  # interval between updates; statistics require sorting, and people read no faster

encode_json = msgspec.json.Encoder().encode


def number(value: float | None) -> float | None:
    """Round a number to seven digits for JSON; return None if it is unknown or not finite."""
    return None if value is None or not math.isfinite(value) else float(f"{value:.7g}")


def vector(values: tuple[float, ...] | None) -> list[float | None] | None:
    """Convert a vector for JSON, or return None if it is unknown."""
    return None if values is None else [number(value) for value in values]


def feedback_values(feedback: Feedback, now_ns: int) -> Json:
    """Convert feedback to JSON values; ``now_ns`` is on the proxy's clock."""
    return {
        "age_s": number(seconds(now_ns - feedback.captured_ns)),
        "captured_ns": str(feedback.captured_ns),  # too large for a JavaScript number
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
    """Return the values for the instruments; unknown values are null."""
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
    """Return all numeric values under unique names, for use in plots.

    Names are ``yaw``, ``velocity.forward``, ``native.…``, ``log.…`` and ``set_point.…``. Unknown numbers are omitted.
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
    """Convert a command, in the form that was applied, to JSON values."""
    return {
        "action": ACTION_NAMES[type(action)],
        "values": {name: number(value) for name, value in _fields(action)},
        "age_s": number(age_s),
    }


def mocap_values(pose: tuple[float, ...] | None) -> Json | None:
    """Convert a motion-capture pose, position [m] and quaternion x, y, z, w, to JSON values."""
    if pose is None:
        return None
    x, y, z, w = pose[3:7]
    return {"position": vector(pose[:3]), "yaw": number(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))}


def truth_values(native: Mapping[str, Value] | None) -> Json | None:
    """Return a simulated vehicle's true pose: ``truth.x``, ``.y``, ``.z`` [m] and ``.yaw`` [rad] from ``native``."""
    return None if native is None else _place(native, "truth")


def target_values(native: Mapping[str, Value] | None) -> list[Json]:
    """Return a simulated world's moving targets (``truth.target``, ``truth.target2``, …) as JSON values."""
    if native is None:
        return []
    names = sorted({key.rpartition(".")[0] for key in native if _TARGET.fullmatch(key)})
    places = ((name.removeprefix("truth."), _place(native, name)) for name in names)
    return [{"name": name, **place} for name, place in places if place is not None]


def event_values(number_: int, event: Event, now_ns: int) -> Json:
    """Convert an event to JSON values. ``now_ns``: the current time on the proxy's clock."""
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
    """Convert one channel's statistics to JSON values, with delays in seconds."""
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


class TelemetryView:
    """One drone as seen by pages. Used on the event loop."""

    def __init__(self, station: Station, clock: Clock = monotonic_ns) -> None:
        self._station = station
        self._clock = clock
        self._degraded = DegradedTimes()
        self._channels: dict[str, Json] = {}
        self._channels_ns: int | None = None
        self._channels_task: asyncio.Task[None] | None = None

    def vehicle(self) -> Json:
        """Return the values that change only if the vehicle changes."""
        station, capabilities = self._station, self._station.drone.capabilities
        return {
            "type": "vehicle",
            "name": station.found.name,
            "uri": station.drone.uri,
            "transport": station.found.transport,
            "vehicle": capabilities.vehicle,
            "description": capabilities.description,
            "can_fly": bool(capabilities.actions),
            "why_not": capabilities.why_not,
            "cameras": [{"name": c.name, "width": c.width, "height": c.height} for c in capabilities.cameras],
            "priorities": [HIGHEST_PRIORITY, LOWEST_PRIORITY],
        }

    def state(self) -> bytes:
        """Return all values that change, as a JSON object without its final brace: each page's events are appended."""
        self._refresh_channels()
        return encode_json(self._values(self._clock()))[:-1]

    def overview(self) -> Json:
        feedback = self._feedback()
        vehicle = self.vehicle()
        motion = motion_values(feedback)
        return {
            **{key: vehicle[key] for key in ("name", "uri", "vehicle", "transport", "can_fly", "why_not", "cameras")},
            **{key: motion[key] for key in ("airborne", "battery", "position", "altitude")},
            "state": motion["flight"],
            "yaw": None if feedback is None else number(feedback.yaw_rad),
            "owner": self.holder(feedback),
            "me": self.is_mine(feedback),
            "links": self._links(),
            "alarms": self.alarms(feedback),
        }

    def events(self, events: Sequence[tuple[int, Event]]) -> list[Json]:
        """Return numbered events for a page."""
        now_ns = self._clock() + self._station.drone.clock_offset_ns
        return [event_values(number_, event, now_ns) for number_, event in events]

    def alarms(self, feedback: Feedback | None) -> list[Alarm]:
        drone = self._station.drone
        # Feedback that is old only because it is sent less often is no cause for an alarm.
        age_s = None if feedback is None else self._age_s(feedback.captured_ns) - self._station.feedback_period_s
        ages: dict[str, float] = {}  # age of the newest stream that is shown, by camera
        for feed in self._station.feeds:
            if (feed_s := feed.age_s) is not None:
                ages[feed.camera] = min(feed_s, ages.get(feed.camera, feed_s))
        link = drone.link
        degraded_s = self._degraded.update(link, self._clock())
        found = alarms(link, feedback, age_s, ages, degraded_s, self._station.thresholds.newest())
        # A replay's proxy also has a failsafe, but there is no vehicle to land.
        return found if self._station.flies else [alarm for alarm in found if alarm.id != "failsafe"]

    def holder(self, feedback: Feedback | None) -> str | None:
        """Return the application that holds authority; None without a lease (feedback may still name one) or a link."""
        broken = self._links()["application"] in _BROKEN
        return None if feedback is None or broken or not feedback.lease else feedback.owner

    def is_mine(self, feedback: Feedback | None) -> bool:
        """Return whether one of this cockpit's pages holds authority."""
        return (
            feedback is not None
            and feedback.lease > 0
            and any(pilot.app_id == feedback.owner_id for pilot in self._station.pilots)
        )

    # Inside ----------------------------------------------------------------------------------------------------

    def _values(self, now_ns: int) -> Json:
        station, log_feed, feedback = self._station, self._station.log_feed, self._feedback()
        links = self._links()
        if links["application"] in _BROKEN:
            log_feed.applied = None  # unknown while the link is down, and outdated afterwards
        applied = log_feed.applied
        native = None if feedback is None else feedback.native
        proxy_ns = now_ns + station.drone.clock_offset_ns
        return {
            "type": "state",
            "now_s": seconds(now_ns),
            "link": links,
            "links": links,
            "feedback": None if feedback is None else feedback_values(feedback, proxy_ns),
            **motion_values(feedback),
            "owner": self.holder(feedback),
            "authority": self._authority(feedback),
            "channels": self._channels,
            "alarms": self.alarms(feedback),
            "values": flat_values(feedback, log_feed.numbers(), None if applied is None else applied.applied),
            "set_points": None
            if applied is None
            else set_point_values(applied.applied, self._age_s(applied.applied_ns)),
            "truth": mocap_values(log_feed.mocap()) or truth_values(native),
            "targets": target_values(native),
            "waypoints": self._waypoints(),
        }

    def _feedback(self) -> Feedback | None:
        try:
            return self._station.feedback()
        except LinkError:
            return None  # there is no feedback yet, or the subscription was closed

    def _links(self) -> Json:
        link = self._station.drone.link
        return {
            "application": str(link.application),
            "vehicle": str(link.vehicle),
            "reason": link.reason,
            "remedy": link.remedy,
        }

    def _authority(self, feedback: Feedback | None) -> Json:
        if feedback is None or self.holder(feedback) is None:
            return {"holder": None, "priority": None, "lease": 0, "me": False}
        return {
            "holder": self.holder(feedback),
            "priority": feedback.owner_priority,
            "lease": feedback.lease,
            "me": self.is_mine(feedback),
        }

    def _waypoints(self) -> list[Json]:
        """Return the goals set on pages, followed by the goals that controllers have logged."""
        goals = [
            {"position": vector(goal.position), "yaw": number(goal.yaw), "app": app}
            for app, goal in self._station.goals.items()
        ]
        logged = [
            {"position": vector(row[:3]), "yaw": number(row[3]) if len(row) > 3 else None, "app": None}
            for row in self._station.log_feed.waypoints()
        ]
        return goals + logged

    def _age_s(self, captured_ns: int) -> float:
        """Return the age of a timestamp on the proxy's clock [s]."""
        return seconds(self._clock() + self._station.drone.clock_offset_ns - captured_ns)

    def _refresh_channels(self) -> None:
        """Start reading the statistics again if they are old; do not wait for the result."""
        now_ns = self._clock()
        old = self._channels_ns is None or seconds(now_ns - self._channels_ns) >= _CHANNELS_S
        if self._channels_task is None and old:
            self._channels_ns = now_ns
            self._channels_task = asyncio.create_task(self._read_channels())

    async def _read_channels(self) -> None:
        # Use a thread, because the drone asks the proxy for the command delay and waits for the answer.
        try:
            stats = await asyncio.to_thread(lambda: self._station.drone.stats)
            for feed in self._station.streams.values():  # H.264 that pages show does not arrive as frames
                name, youngest_s = f"video/{feed.camera}", feed.age_s
                known = stats.get(name)
                if youngest_s is not None and (known is None or known.age_s is None or youngest_s < known.age_s):
                    stats = {**stats, name: feed.stats()}
            shown = {feed.camera for feed in self._station.feeds if feed.wanted}
            # Video that no page shows has no statistics: it was not requested, so none arrived.
            stats = {
                name: one
                for name, one in stats.items()
                if not name.startswith("video/") or name.removeprefix("video/") in shown
            }
            self._channels = {name: channel_values(one) for name, one in stats.items()}
        except LinkError:
            pass  # the drone has just been closed
        finally:
            self._channels_task = None
