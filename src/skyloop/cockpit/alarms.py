"""What a person must know of a drone at once: decided from links, feedback and ages, pure.

Its thresholds are parameters of the drone's proxy: the same for every page, wherever it is served.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Final, Protocol

import msgspec

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.cockpit.feeds import call_soon
from skyloop.errors import SkyloopError, UnknownNameError
from skyloop.messages import Event, EventKind, Failsafe, Feedback, FlightState, LinkState, ReturnPhase, Value

if TYPE_CHECKING:
    from skyloop.client import Drone, LinkStatus

_Make = Callable[[str, str], "Alarm"]
_BROKEN: Final = (LinkState.LOST, LinkState.CLOSED)


class AlarmSeverity(StrEnum):
    """How urgent an alarm is."""

    WARNING = "warning"
    CRITICAL = "critical"


class Alarm(msgspec.Struct, frozen=True):
    """One thing that is wrong now.

    Args:
        id: What it is about, the same while it lasts: a page remembers by it that a person has acknowledged it.
        severity: It may rise while it lasts, as from a degraded link to a lost one.
        text: In words, with the figure of now.
    """

    id: str
    severity: AlarmSeverity
    text: str


class Thresholds(msgspec.Struct, frozen=True):
    """From where on something is an alarm: charges from 0 to 1, ages in seconds; 0: never."""

    battery_low: float = 0.2
    battery_critical: float = 0.15
    feedback_age_s: float = 1.0
    video_age_s: float = 1.0
    link_degraded_s: float = 0.5


USUAL: Final = Thresholds()


class DegradedTimes:
    """How long the hops have been degraded without a break."""

    def __init__(self) -> None:
        self._since_ns: dict[str, int] = {}

    def update(self, link: LinkStatus, now_ns: int) -> dict[str, float]:
        """Take the state of now, and return the time of each hop that is degraded [s], by the ``id`` of its alarm."""
        degraded = [hop for hop, _, state in _hops(link) if state is LinkState.DEGRADED]
        self._since_ns = {hop: self._since_ns.get(hop, now_ns) for hop in degraded}
        return {hop: seconds(now_ns - since_ns) for hop, since_ns in self._since_ns.items()}


def alarms(
    link: LinkStatus,
    feedback: Feedback | None,
    feedback_age_s: float | None,
    video_age_s: Mapping[str, float],
    degraded_s: Mapping[str, float],
    thresholds: Thresholds = USUAL,
) -> list[Alarm]:
    """Return what a person must know at once, the most severe first.

    Args:
        link: The state of both hops.
        feedback: The newest, None for none.
        feedback_age_s: Its age [s].
        video_age_s: Age of what is shown [s], by camera that somebody watches.
        degraded_s: How long the links that are degraded have been so [s], from :class:`DegradedTimes`.
        thresholds: From where on a charge, an age or a degraded link is an alarm.
    """
    # On the ground there is time: only what is, or was when last heard of, in the air is urgent.
    urgent = _critical if feedback is not None and feedback.state.airborne else _warning
    if link.application in _BROKEN:
        # Nothing else is known any more: what came before is out of date.
        return [urgent("application_link", _because("link to the proxy lost", link.reason))]
    if link.vehicle is LinkState.CLOSED:
        return []  # a recording that is over, as every recording is some time: nothing is wrong
    found = [*_of_flight(feedback, thresholds, urgent), *_of_links(link, degraded_s, thresholds, urgent)]
    if feedback_age_s is not None and 0 < thresholds.feedback_age_s < feedback_age_s:
        found.append(urgent("feedback_age", f"feedback is {feedback_age_s:.1f} s old"))
    for camera, age_s in video_age_s.items():
        if 0 < thresholds.video_age_s < age_s:
            found.append(_warning(f"video_age.{camera}", f"video of {camera} is {age_s:.1f} s old"))
    return sorted(found, key=lambda alarm: alarm.severity is not AlarmSeverity.CRITICAL)


def _of_flight(feedback: Feedback | None, thresholds: Thresholds, urgent: _Make) -> Iterator[Alarm]:
    if feedback is None:
        return
    if feedback.state is FlightState.EMERGENCY:
        yield _critical("emergency", "emergency: the motors are off")
    if feedback.failsafe is Failsafe.LAND:
        returns = feedback.return_phase in (ReturnPhase.CLIMBING, ReturnPhase.FLYING)
        yield _critical("failsafe", f"failsafe: {'returning to its start' if returns else 'landing'} by itself")
    elif feedback.failsafe is not Failsafe.NONE:
        end = "" if feedback.lease else ", landing next unless somebody takes control"  # without a lease none commands
        yield _warning("failsafe", f"failsafe: hovering by itself{end}")
    charge = feedback.battery
    if charge is not None and charge < thresholds.battery_critical:
        yield urgent("battery", f"battery critical: {charge:.0%}")
    elif charge is not None and charge < thresholds.battery_low:
        yield _warning("battery", f"battery low: {charge:.0%}")


def _of_links(
    link: LinkStatus, degraded_s: Mapping[str, float], thresholds: Thresholds, urgent: _Make
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
