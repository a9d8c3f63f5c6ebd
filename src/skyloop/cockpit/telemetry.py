"""The view model: what pages are sent of a drone, made once for all of them. SI units and radians; pages convert."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.cockpit.alarms import Alarm, DegradedTimes, alarms
from skyloop.cockpit.values import (
    Json,
    channel_values,
    event_values,
    feedback_values,
    flat_values,
    mocap_values,
    motion_values,
    number,
    set_point_values,
    target_values,
    truth_values,
    vector,
)
from skyloop.errors import LinkError
from skyloop.messages import HIGHEST_PRIORITY, LOWEST_PRIORITY, Event, Feedback, LinkState

if TYPE_CHECKING:
    from skyloop.cockpit.station import Station

_BROKEN = (str(LinkState.LOST), str(LinkState.CLOSED))
_CHANNELS_S = 0.5  # statistics cost sorting, and nobody reads faster

encode_json = msgspec.json.Encoder().encode


class TelemetryView:
    """One drone as pages see it. Used on the event loop.

    Args:
        station: The drone.
        clock: The monotonic clock [ns].
    """

    def __init__(self, station: Station, clock: Clock = monotonic_ns) -> None:
        self._station = station
        self._clock = clock
        self._degraded = DegradedTimes()
        self._channels: dict[str, Json] = {}
        self._channels_ns: int | None = None
        self._channels_task: asyncio.Task[None] | None = None

    def vehicle(self) -> Json:
        """Return what changes only when the vehicle is another one."""
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
        """Return the newest of everything that moves, as a JSON object without its last brace."""
        self._refresh_channels()
        return encode_json(self._values(self._clock()))[:-1]

    def overview(self) -> Json:
        """Return the drone in one row."""
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
        """Return events with their numbers, for a page."""
        now_ns = self._clock() + self._station.drone.clock_offset_ns
        return [event_values(number_, event, now_ns) for number_, event in events]

    def alarms(self, feedback: Feedback | None) -> list[Alarm]:
        """Return what a person must know at once, the most severe first."""
        drone = self._station.drone
        # An age that comes from being sent less is nothing to worry about.
        age_s = None if feedback is None else self._age_s(feedback.captured_ns) - self._station.feedback_period_s
        ages: dict[str, float] = {}  # by camera, the youngest of what is shown of it
        for feed in self._station.feeds:
            if (feed_s := feed.age_s) is not None:
                ages[feed.camera] = min(feed_s, ages.get(feed.camera, feed_s))
        link = drone.link
        degraded_s = self._degraded.update(link, self._clock())
        found = alarms(link, feedback, age_s, ages, degraded_s, self._station.thresholds.newest())
        # The proxy of a recording has a failsafe too, and nothing that it could land.
        return found if self._station.flies else [alarm for alarm in found if alarm.id != "failsafe"]

    def holder(self, feedback: Feedback | None) -> str | None:
        """Return who has the authority.

        That is nobody if the lease ended by silence, though feedback keeps the name, and if there is no proxy that
        could give one.
        """
        broken = self._links()["application"] in _BROKEN
        return None if feedback is None or broken or not feedback.lease else feedback.owner

    def is_mine(self, feedback: Feedback | None) -> bool:
        """Return whether a page of this cockpit holds the authority."""
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
            log_feed.applied = None  # nobody knows what is applied now, and after its return it is not what was
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
            return None  # none yet, or closed

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
        """Return where pages fly it to, then what controllers have logged."""
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
        """Return the age of what is stamped on the proxy's clock [s]."""
        return seconds(self._clock() + self._station.drone.clock_offset_ns - captured_ns)

    def _refresh_channels(self) -> None:
        """Start to read the statistics again if they are old, without waiting."""
        now_ns = self._clock()
        old = self._channels_ns is None or seconds(now_ns - self._channels_ns) >= _CHANNELS_S
        if self._channels_task is None and old:
            self._channels_ns = now_ns
            self._channels_task = asyncio.create_task(self._read_channels())

    async def _read_channels(self) -> None:
        # On another thread: for the command delay the drone asks the proxy, and waits for its answer.
        try:
            stats = await asyncio.to_thread(lambda: self._station.drone.stats)
            for feed in self._station.streams.values():  # what a page shows as H.264 does not come as frames
                name, youngest_s = f"video/{feed.camera}", feed.age_s
                known = stats.get(name)
                if youngest_s is not None and (known is None or known.age_s is None or youngest_s < known.age_s):
                    stats = {**stats, name: feed.stats()}
            shown = {feed.camera for feed in self._station.feeds if feed.wanted}
            # Of video that no page shows there is nothing to tell: what did not come was not asked for.
            stats = {
                name: one
                for name, one in stats.items()
                if not name.startswith("video/") or name.removeprefix("video/") in shown
            }
            self._channels = {name: channel_values(one) for name, one in stats.items()}
        except LinkError:
            pass  # closed meanwhile
        finally:
            self._channels_task = None
