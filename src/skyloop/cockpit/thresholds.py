"""A drone's thresholds of alarms, which are parameters of its proxy: the same for every page, wherever it is served."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Final, Protocol

import msgspec

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.cockpit.alarms import USUAL, Thresholds
from skyloop.cockpit.broadcast import call_soon
from skyloop.errors import SkyloopError, UnknownNameError
from skyloop.messages import Event, EventKind, LinkState, Value

if TYPE_CHECKING:
    from skyloop.client import Drone

RETRY_S: Final = 2.0  #: between two attempts to read them
#: The parameters, by the field of :class:`Thresholds`.
PARAMETERS: Final = {
    "battery_low": "battery.warn",
    "battery_critical": "alarms.battery_critical",
    "feedback_age_s": "alarms.feedback_age_s",
    "video_age_s": "alarms.video_age_s",
    "link_degraded_s": "alarms.link_degraded_s",
}


class _Readable(Protocol):
    """``drone.config``, as far as it is used here."""

    def __getitem__(self, name: str, /) -> Value: ...


class ThresholdReader:
    """Reads the thresholds, and reads them anew when a parameter was written or a link came back.

    Made and used on the event loop.

    Args:
        drone: The drone.
        clock: The monotonic clock [ns].
    """

    def __init__(self, drone: Drone, clock: Clock = monotonic_ns) -> None:
        self._drone = drone
        self._clock = clock
        self._values = USUAL
        self._is_stale = True
        self._tried_ns: int | None = None
        self._task: asyncio.Task[None] | None = None
        loop = asyncio.get_running_loop()
        self._listener = drone.on_event(lambda event: call_soon(loop, self.on_event, event))

    def on_event(self, event: Event) -> None:
        """Note that the thresholds may be others now."""
        came_back = event.kind is EventKind.APPLICATION_LINK and event.data.get("state") == LinkState.UP
        if event.kind is EventKind.PARAMETER_CHANGED or came_back or event.kind is EventKind.VEHICLE_LINK:
            self._is_stale, self._tried_ns = True, None

    def newest(self) -> Thresholds:
        """Return them as last read, and start to read them if they may have changed. Does not wait."""
        now_ns = self._clock()
        rested = self._tried_ns is None or now_ns - self._tried_ns >= nanoseconds(RETRY_S)
        if self._is_stale and rested and self._task is None:
            self._is_stale, self._tried_ns = False, now_ns
            self._task = asyncio.create_task(self._read())
        return self._values

    def close(self) -> None:
        """Unregister from the drone."""
        self._listener.cancel()

    async def _read(self) -> None:
        try:
            self._values = await asyncio.to_thread(thresholds_of, self._drone.config)
        except SkyloopError:
            self._is_stale = True  # no answer: tried again after RETRY_S
        finally:
            self._task = None


def thresholds_of(config: _Readable) -> Thresholds:
    """Read the thresholds; those that a proxy does not have, or that are no finite numbers, are the usual ones.

    Raises:
        SkyloopError: The proxy does not answer.
    """
    return msgspec.structs.replace(USUAL, **{field: _number(config, name, field) for field, name in PARAMETERS.items()})


def _number(config: _Readable, name: str, field: str) -> float:
    usual: float = getattr(USUAL, field)
    try:
        value = config[name]
    except UnknownNameError:
        return usual
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else usual  # type: ignore[arg-type]  # a number, as just checked
