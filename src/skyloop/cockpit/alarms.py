"""What a person must know at once, in words. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from skyloop.messages import Failsafe, Feedback, FlightState, LinkState

if TYPE_CHECKING:
    from skyloop.client import LinkStatus

BATTERY_LOW: Final = 0.2  #: as ``battery.warn`` of a proxy, unless that was written
STALE_VIDEO_S: Final = 1.0
STALE_FEEDBACK_S: Final = 1.0

_BROKEN: Final = (LinkState.LOST, LinkState.CLOSED)


def alarms(
    link: LinkStatus,
    feedback: Feedback | None,
    feedback_age_s: float | None,
    video_age_s: Mapping[str, float],
    battery_low: float = BATTERY_LOW,
) -> list[str]:
    """The worst first. ``video_age_s``: age of what is shown, by camera that somebody watches."""
    if link.application in _BROKEN:
        # Nothing else is known any more: what came before is no news.
        return [_because("link to the proxy lost", link.reason)]
    found = []
    if feedback is not None and feedback.state is FlightState.EMERGENCY:
        found.append("emergency: the motors are off")
    if link.vehicle in _BROKEN:
        found.append(_because("link to the vehicle lost", link.reason))
    if feedback is not None and feedback.failsafe is not Failsafe.NONE:
        done = "landing" if feedback.failsafe is Failsafe.LAND else "hovering"
        found.append(f"failsafe: {done} by itself")
    if feedback is not None and feedback.battery is not None and feedback.battery < battery_low:
        found.append(f"battery low: {feedback.battery:.0%}")
    for hop, state in (("proxy", link.application), ("vehicle", link.vehicle)):
        if state is LinkState.DEGRADED:
            found.append(_because(f"link to the {hop} degraded", link.reason))
    if feedback_age_s is not None and feedback_age_s > STALE_FEEDBACK_S:
        found.append(f"feedback is {feedback_age_s:.1f} s old")
    for camera, age_s in video_age_s.items():
        if age_s > STALE_VIDEO_S:
            found.append(f"video of {camera} is {age_s:.1f} s old")
    return found


def _because(what: str, reason: str) -> str:
    return f"{what}: {reason}" if reason else what
