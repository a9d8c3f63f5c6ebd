"""The view model: what a page is told of a drone, as plain JSON values. SI units and radians; the page converts."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.errors import NoAnswerError
from skyloop.messages import Event, Feedback

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.client.statistics import ChannelStats

Json = dict[str, Any]

_STATE_S = 0.02  # pages that ask within this time share one answer
_CHANNELS_S = 0.5  # statistics cost sorting, and nobody reads faster


class TelemetryView:
    """Looks at one drone for all pages, and remembers for a moment what it saw. Used on the event loop."""

    def __init__(self, drone: Drone, clock: Clock = monotonic_ns) -> None:
        self._drone = drone
        self._clock = clock
        self._state: tuple[int, Json] | None = None
        self._channels: tuple[int, Json] | None = None
        self._looking: asyncio.Task[None] | None = None

    def vehicle(self) -> Json:
        """What does not change: told once to each page."""
        capabilities = self._drone.capabilities
        return {
            "type": "vehicle",
            "name": self._drone.name,
            "uri": self._drone.uri,
            "vehicle": capabilities.vehicle,
            "description": capabilities.description,
            "can_fly": bool(capabilities.actions),
            "why_not": capabilities.why_not,
            "cameras": [{"name": c.name, "width": c.width, "height": c.height} for c in capabilities.cameras],
        }

    async def state(self) -> Json:
        """The newest of everything that moves."""
        await self._refresh_channels()
        now = self._clock()
        if self._state is None or seconds(now - self._state[0]) >= _STATE_S:
            self._state = now, self._look(now)
        return self._state[1]

    def events(self, events: Sequence[tuple[int, Event]]) -> list[Json]:
        """Events with their numbers, for a page."""
        now = self._clock()
        return [
            {
                "n": number,
                "kind": str(event.kind),
                "severity": str(event.severity),
                "text": event.text,
                "app": event.app,
                "age_s": seconds(now - event.at_ns),
            }
            for number, event in events
        ]

    def _look(self, now_ns: int) -> Json:
        link = self._drone.link
        try:
            feedback: Feedback | None = self._drone.feedback()
        except NoAnswerError:
            feedback = None
        return {
            "type": "state",
            "link": {"application": str(link.application), "vehicle": str(link.vehicle), "reason": link.reason},
            "feedback": None if feedback is None else feedback_values(feedback, now_ns),
            "channels": {} if self._channels is None else self._channels[1],
        }

    async def _refresh_channels(self) -> None:
        """Have the statistics looked up anew if they are old; waits for it only the first time."""
        fresh = self._channels is not None and seconds(self._clock() - self._channels[0]) < _CHANNELS_S
        if not fresh and self._looking is None:
            self._looking = asyncio.create_task(self._look_up_channels())
        if self._channels is None and self._looking is not None:
            await asyncio.shield(self._looking)

    async def _look_up_channels(self) -> None:
        # On another thread: for the command delay the drone asks the proxy, and waits for its answer.
        try:
            stats = await asyncio.to_thread(lambda: self._drone.stats)
            self._channels = self._clock(), {name: channel_values(one) for name, one in stats.items()}
        finally:
            self._looking = None


def feedback_values(feedback: Feedback, now_ns: int) -> Json:
    """A feedback as JSON values; what is not known, or not finite, is null."""
    velocity = feedback.velocity
    return {
        "age_s": seconds(now_ns - feedback.captured_ns),
        "state": str(feedback.state),
        "battery": _number(feedback.battery),
        "battery_v": _number(feedback.battery_v),
        "roll": _number(feedback.roll),
        "pitch": _number(feedback.pitch),
        "yaw": _number(feedback.yaw),
        "altitude": _number(feedback.altitude),
        "velocity": None if velocity is None else [_number(v) for v in velocity],
        "position": None if feedback.position is None else [_number(v) for v in feedback.position],
        "failsafe": str(feedback.failsafe),
        "owner": feedback.owner,
        "owner_priority": feedback.owner_priority,
        "lease": feedback.lease,
    }


def channel_values(stats: ChannelStats) -> Json:
    """One channel's figures; delays in seconds."""
    delay = stats.delay_s
    return {
        "count": stats.count,
        "rate_hz": stats.rate_hz,
        "lost": stats.lost,
        "dropped": stats.dropped,
        "malformed": stats.malformed,
        "age_s": stats.age_s,
        "delay_s": None if delay is None else {"median": delay.median, "p99": delay.p99},
    }


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
