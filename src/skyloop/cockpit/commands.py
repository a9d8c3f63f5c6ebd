"""Decode a page's commands (one JSON object per message, with its kind in ``do``) and check that they are recent."""

from __future__ import annotations

from typing import Annotated, Any, Final

import msgspec

from skyloop.errors import DecodeError
from skyloop.messages import HIGHEST_PRIORITY, LOWEST_PRIORITY
from skyloop.messages.config import Reason

Priority = Annotated[int, msgspec.Meta(ge=HIGHEST_PRIORITY, le=LOWEST_PRIORITY)]
CameraName = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
Pixels = Annotated[float, msgspec.Meta(gt=0)]
Word = Annotated[str, msgspec.Meta(max_length=64)]

LATE_S: Final = 0.5  #: a command that may be older is refused; its sender no longer expects it to be obeyed
#: Maximum age of an emergency stop; the page shows the stop as pending for this long.
STOP_LATE_S: Final = 2.0
#: If deflected sticks have not moved for this long, the cockpit assumes that nobody is holding them. Bluetooth can take
#: up to 20 s to report a lost gamepad.
UNTOUCHED_S: Final = 10.0
AHEAD_S: Final = 0.05  #: clock difference tolerated beyond the page's own bound; the same as for commands from programs
SETTLED_NS: Final = 50_000_000  #: feedback captured this soon after a command may predate the command [ns]


class PageCommand(msgspec.Struct, frozen=True, tag_field="do", forbid_unknown_fields=True, kw_only=True):
    """The base of all commands from a page."""

    #: Time at which the person requested it, on the cockpit's clock as the page estimates it from pongs [s].
    at_s: float | None = None
    unsure_s: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0  #: uncertainty of ``at_s`` [s]
    n: int = 0  #: number chosen by the page and repeated in the responses

    @property
    def do(self) -> str:
        """The command's kind, as it appears in messages."""
        return str(self.__struct_config__.tag)


class Take(PageCommand, frozen=True, tag="take"):
    """Request control authority with a priority from 0 (highest) to 31."""

    priority: Priority
    ask: bool = False  #: whether to ask the holder first and wait in the queue


class Release(PageCommand, frozen=True, tag="release"):
    """Release authority, or leave the queue."""


class Answer(PageCommand, frozen=True, tag="answer"):
    """The holder's response to a request for its authority."""

    id: int  #: id of the question
    grant: bool
    reason: Reason = ""  #: reason for a refusal, shown to the person who made the request


class TakeOff(PageCommand, frozen=True, tag="takeoff"): ...


class HoverHere(PageCommand, frozen=True, tag="hover"):
    """Hover because a person requested it or, if ``automatic``, because no key or stick is held anymore."""

    automatic: bool = False


class LandHere(PageCommand, frozen=True, tag="land"): ...


class Stop(PageCommand, frozen=True, tag="stop"):
    """Cut the motors. This command needs no authority."""


class Reset(PageCommand, frozen=True, tag="reset"):
    """Leave the vehicle's emergency state."""


class Fly(PageCommand, frozen=True, tag="fly"):
    """Move the sticks: velocity in the levelled body axes [m/s], yaw rate counter-clockwise [rad/s]."""

    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    yaw_rate: float = 0.0
    #: Counter of signs of a hand: moving fingers, repeating keys, raw axis values. None if the page does not report it.
    touches: int | None = None


class GoTo(PageCommand, frozen=True, tag="goto"):
    """Fly to a place in world axes: east, north and up [m], yaw counter-clockwise from east [rad]."""

    x: float
    y: float
    z: float
    yaw: float | None = None


class FlyBack(PageCommand, frozen=True, tag="return"):
    """Fly back to the take-off position and then land or hover there, depending on the drone's parameters."""


class StartRoute(PageCommand, frozen=True, tag="route"):
    """Fly a checked route; ``id`` comes from the response to the check."""

    id: Annotated[str, msgspec.Meta(max_length=64)]


class PauseRoute(PageCommand, frozen=True, tag="route_pause"):
    """Hover until the route is resumed."""


class ResumeRoute(PageCommand, frozen=True, tag="route_resume"):
    """Continue to the next waypoint of a paused route."""


class SkipWaypoint(PageCommand, frozen=True, tag="route_skip"):
    """Skip the current waypoint."""


class StopRoute(PageCommand, frozen=True, tag="route_stop"):
    """End the route and hover."""


class SelectTarget(PageCommand, frozen=True, tag="follow_select"):
    """Keep a camera's frames while a person draws a box on one of them; if the camera is None, stop keeping them."""

    camera: CameraName | None


class TrackTarget(PageCommand, frozen=True, tag="follow"):
    """Track the object inside a box and, if a mode is given, follow it."""

    camera: CameraName
    captured_ns: Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,19}$")]  #: capture time of the frame under the box [ns]
    box: tuple[float, float, float, float]  #: x and y of its upper left corner, width and height [pixels]
    mode: Word | None = None  #: if None, only track the target until a mode is set
    class_name: Word | None = None  #: class of a selected detection
    distance_m: float | None = None  #: distance to keep; None for the follower's default
    size: tuple[Pixels, Pixels] | None = None  #: size of the image under the box; None for the frame's size


class SetFollowMode(PageCommand, frozen=True, tag="follow_mode"):
    """Follow the tracked target, or change the mode of following."""

    mode: Word
    distance_m: float | None = None  #: distance to keep from the target; None to leave it unchanged


class StopFollowing(PageCommand, frozen=True, tag="follow_stop"):
    """Forget the target; hover if the vehicle was following it."""


class Write(PageCommand, frozen=True, tag="set"):
    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
    value: bool | int | float | str | list[float]


class Alive(PageCommand, frozen=True, tag="ping"):
    """Report that the page is present and receives data: ``seen_s`` is the ``now_s`` of its newest pong."""

    seen_s: float | None = None


class LandAll(PageCommand, frozen=True, tag="land_all"):
    """Land every drone."""


class StopAll(PageCommand, frozen=True, tag="stop_all"):
    """Cut the motors of every drone. This needs no authority."""


AnyCommand = (
    Take
    | Release
    | Answer
    | TakeOff
    | HoverHere
    | LandHere
    | Stop
    | Reset
    | Fly
    | GoTo
    | FlyBack
    | Write
    | Alive
    | StartRoute
    | PauseRoute
    | ResumeRoute
    | SkipWaypoint
    | StopRoute
    | SelectTarget
    | TrackTarget
    | SetFollowMode
    | StopFollowing
)

AnyFleetCommand = LandAll | StopAll | Alive

_decoder = msgspec.json.Decoder(AnyCommand)
_fleet_decoder = msgspec.json.Decoder(AnyFleetCommand)


def decode_command(text: str | bytes) -> AnyCommand:
    """Decode a command for one drone. Raise ``DecodeError`` if the command is invalid; the message says why."""
    command: AnyCommand = _decoded(_decoder, text)
    return command


def decode_fleet_command(text: str | bytes) -> AnyFleetCommand:
    """Decode a command for all drones. Raise ``DecodeError`` if the command is invalid; the message says why."""
    command: AnyFleetCommand = _decoded(_fleet_decoder, text)
    return command


def late_s(command: PageCommand) -> float:
    """Return the age from which a command counts as late [s]."""
    return STOP_LATE_S if isinstance(command, Stop | StopAll) else LATE_S


class HandWatch:
    """Determines whether a person's hand is holding the deflected sticks.

    Hands are never still: fingers move by pixels, held keys repeat, and axes at their limits jitter. The values from a
    gamepad that has lost its radio link stay constant; so do those from a page that has lost track of held keys.
    """

    def __init__(self) -> None:
        self._last: Fly | None = None
        self._moved_s = 0.0

    def holds(self, sticks: Fly, now_s: float) -> bool:
        """Handle a stick command; return whether the sticks were touched within :data:`UNTOUCHED_S`."""
        last, self._last = self._last, sticks
        same = last is not None and all(
            getattr(last, name) == getattr(sticks, name) for name in ("forward", "left", "up", "yaw_rate", "touches")
        )
        if not same or sticks.touches is None:  # a pause is no sign of a hand; networks cause pauses, too
            self._moved_s = now_s
        return now_s - self._moved_s <= UNTOUCHED_S


def untimely(command: PageCommand, now_s: float) -> str:
    """Return the reason for refusing a command because of its age; empty if the command is recent enough.

    A command whose age is unknown is refused, and a command that might be too old is treated as too old.
    """
    if command.at_s is None:
        return "it has no time (at_s): send a ping first, its pong has the cockpit's clock"
    age_s, limit_s = now_s - command.at_s, late_s(command)
    if command.unsure_s > limit_s:
        return f"its age is not known: the page's clock is known to within {command.unsure_s:.1f} s only"
    if age_s + command.unsure_s > limit_s:
        return f"it arrived {age_s:.1f} s after it was requested, and at most {limit_s:g} s are allowed"
    if age_s < -command.unsure_s - AHEAD_S:
        return f"its time is {-age_s:.1f} s ahead of the cockpit's clock: ping again"
    return ""


def _decoded(decoder: msgspec.json.Decoder[Any], text: str | bytes) -> Any:
    try:
        return decoder.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise DecodeError(f"not understood: {error}") from None
