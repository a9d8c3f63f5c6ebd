"""Determine a drone's alarms from its links, feedback and the age of its data, without side effects.

The thresholds are parameters of the drone's proxy, so they are the same on every page.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import msgspec

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.cockpit.feeds import call_soon
from skyloop.errors import SkyloopError, UnknownNameError
from skyloop.messages import Event, EventKind, Failsafe, Feedback, FlightState, LinkState, ReturnPhase, Value

if TYPE_CHECKING:
    from skyloop.client import Config, Drone, LinkStatus

_Make = Callable[[str, str], "Alarm"]
_BROKEN: Final = (LinkState.LOST, LinkState.CLOSED)


class AlarmSeverity(StrEnum):
    WARNING = "warning"
    CRITICAL = "critical"


class Alarm(msgspec.Struct, frozen=True):
    """A problem that currently exists."""

    id: str  #: the alarm's subject; constant while the alarm lasts, so that a page can remember its acknowledgement
    severity: AlarmSeverity  #: may rise while the alarm lasts, for example when the battery becomes critical
    text: str  #: a description that includes the current value


class AlarmThresholds(msgspec.Struct, frozen=True):
    """The values at which alarms start: charges from 0 to 1, ages in seconds; 0 means never."""

    battery_low: float = 0.2
    battery_critical: float = 0.15
    feedback_age_s: float = 1.0
    video_age_s: float = 1.0
    link_degraded_s: float = 0.5


USUAL: Final = AlarmThresholds()


class DegradedTimes:
    """Tracks for how long each hop has been degraded without interruption."""

    def __init__(self) -> None:
        self._since_ns: dict[str, int] = {}

    def update(self, link: LinkStatus, now_ns: int) -> dict[str, float]:
        """Record the current state; return how long each degraded hop has been degraded [s], by its alarm's ``id``."""
        degraded = [hop for hop, _, state in _hops(link) if state is LinkState.DEGRADED]
        self._since_ns = {hop: self._since_ns.get(hop, now_ns) for hop in degraded}
        return {hop: seconds(now_ns - since_ns) for hop, since_ns in self._since_ns.items()}


def alarms(
    link: LinkStatus,
    feedback: Feedback | None,
    feedback_age_s: float | None,
    video_age_s: Mapping[str, float],
    degraded_s: Mapping[str, float],
    thresholds: AlarmThresholds = USUAL,
) -> list[Alarm]:
    """Return the current alarms, the most severe first.

    ``video_age_s``: age of the frame shown [s], for each camera that someone is watching. ``degraded_s``: how long each
    degraded hop has been degraded [s], from :class:`DegradedTimes`.
    """
    # On the ground there is time: an alarm is urgent only if the vehicle is, or was last reported, in the air.
    urgent = _critical if feedback is not None and feedback.state.airborne else _warning
    if link.application in _BROKEN:
        # All other information is outdated.
        return [urgent("application_link", _because("link to the proxy lost", link.reason))]
    if link.vehicle is LinkState.CLOSED:
        return []  # nothing is wrong: a replay has reached its end
    found = [*_of_flight(feedback, thresholds, urgent), *_of_links(link, degraded_s, thresholds, urgent)]
    if feedback_age_s is not None and 0 < thresholds.feedback_age_s < feedback_age_s:
        found.append(urgent("feedback_age", f"feedback is {feedback_age_s:.1f} s old"))
    for camera, age_s in video_age_s.items():
        if 0 < thresholds.video_age_s < age_s:
            found.append(_warning(f"video_age.{camera}", f"video of {camera} is {age_s:.1f} s old"))
    return sorted(found, key=lambda alarm: alarm.severity is not AlarmSeverity.CRITICAL)


def _of_flight(feedback: Feedback | None, thresholds: AlarmThresholds, urgent: _Make) -> Iterator[Alarm]:
    if feedback is None:
        return
    if feedback.state is FlightState.EMERGENCY:
        yield _critical("emergency", "emergency: the motors are off")
    if feedback.failsafe is Failsafe.LAND:
        returns = feedback.return_phase in (ReturnPhase.CLIMBING, ReturnPhase.FLYING)
        yield _critical("failsafe", f"failsafe: {'returning to its start' if returns else 'landing'}")
    elif feedback.failsafe is not Failsafe.NONE:
        end = "" if feedback.lease else ", returning or landing next unless someone takes control"  # no lease, no pilot
        yield _warning("failsafe", f"failsafe: hovering{end}")
    charge = feedback.battery
    if charge is not None and charge < thresholds.battery_critical:
        yield urgent("battery", f"battery critical: {charge:.0%}")
    elif charge is not None and charge < thresholds.battery_low:
        yield _warning("battery", f"battery low: {charge:.0%}")


def _of_links(
    link: LinkStatus, degraded_s: Mapping[str, float], thresholds: AlarmThresholds, urgent: _Make
) -> Iterator[Alarm]:
    if link.vehicle is LinkState.LOST:
        yield urgent("vehicle_link", _because("link to the vehicle lost", link.reason, link.remedy))
    elif link.vehicle is LinkState.CONNECTING:
        yield _warning("vehicle_link", _because("no vehicle yet", link.reason, link.remedy))
    for hop, name, _ in _hops(link):
        if 0 < thresholds.link_degraded_s <= degraded_s.get(hop, 0.0):
            yield _warning(hop, _because(f"link to the {name} degraded", link.reason))


def _hops(link: LinkStatus) -> tuple[tuple[str, str, LinkState], ...]:
    return ("application_link", "proxy", link.application), ("vehicle_link", "vehicle", link.vehicle)


def _critical(what: str, text: str) -> Alarm:
    return Alarm(what, AlarmSeverity.CRITICAL, text)


def _warning(what: str, text: str) -> Alarm:
    return Alarm(what, AlarmSeverity.WARNING, text)


def _because(what: str, *more: str) -> str:
    return ": ".join((what, *filter(None, more)))


RETRY_S: Final = 2.0  #: pause between attempts to read the parameters
#: The proxy's parameters, keyed by field of :class:`AlarmThresholds`.
PARAMETERS: Final = {
    "battery_low": "battery.warn",
    "battery_critical": "alarms.battery_critical",
    "feedback_age_s": "alarms.feedback_age_s",
    "video_age_s": "alarms.video_age_s",
    "link_degraded_s": "alarms.link_degraded_s",
}


class ThresholdReader:
    """Reads the thresholds, and rereads them when they may have changed. Created and used on the event loop."""

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
        """Reread the thresholds after a parameter was written, the proxy came back, or the vehicle link changed."""
        came_back = event.kind is EventKind.APPLICATION_LINK and event.data.get("state") == LinkState.UP
        if event.kind is EventKind.PARAMETER_CHANGED or came_back or event.kind is EventKind.VEHICLE_LINK:
            self._is_stale, self._tried_ns = True, None

    def newest(self) -> AlarmThresholds:
        """Return the thresholds read last; start reading them again if they may have changed. Does not block."""
        now_ns = self._clock()
        rested = self._tried_ns is None or now_ns - self._tried_ns >= nanoseconds(RETRY_S)
        if self._is_stale and rested and self._task is None:
            self._is_stale, self._tried_ns = False, now_ns
            self._task = asyncio.create_task(self._read())
        return self._values

    def close(self) -> None:
        self._listener.cancel()

    async def _read(self) -> None:
        try:
            self._values = await asyncio.to_thread(thresholds_of, self._drone.config)
        except SkyloopError:
            self._is_stale = True  # try again after RETRY_S
        finally:
            self._task = None


def thresholds_of(config: Config | Mapping[str, Value]) -> AlarmThresholds:
    """Read the thresholds; use the default for each threshold that the proxy lacks or that is not finite."""
    return msgspec.structs.replace(USUAL, **{field: _number(config, name, field) for field, name in PARAMETERS.items()})


def _number(config: Config | Mapping[str, Value], name: str, field: str) -> float:
    usual: float = getattr(USUAL, field)
    try:
        value = config[name]
    except UnknownNameError:
        return usual
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else usual  # type: ignore[arg-type] # a number, as was just checked
