"""Commands of a page: one JSON object per message, its kind named by ``do``; and whether it is in time."""

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

LATE_S: Final = 0.5  #: a command that may be older is refused: the person no longer expects it to happen
#: An emergency stop may be this late: as long as the page shows it as pending.
STOP_LATE_S: Final = 2.0
#: Sticks that are pushed and that no hand has moved for so long are in nobody's hand. Bluetooth itself notices that a
#: gamepad is gone after up to 20 s only.
UNTOUCHED_S: Final = 10.0
AHEAD_S: Final = 0.05  #: what clocks may differ by beyond what the page stated; as for commands of programs
SETTLED_NS: Final = 50_000_000  #: feedback captured so soon after a command may still be from before it [ns]


class Command(msgspec.Struct, frozen=True, tag_field="do", forbid_unknown_fields=True, kw_only=True):
    """Base of all commands of a page."""

    #: When the person asked for it, on the cockpit's clock as the page knows it from pongs [s].
    at_s: float | None = None
    unsure_s: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0  #: and by how much that may be wrong
    n: int = 0  #: by which the page knows the answers

    @property
    def do(self) -> str:
        """The command's kind, by which messages name it."""
        return str(self.__struct_config__.tag)


class Take(Command, frozen=True, tag="take"):
    """Ask for the authority: 0 is the highest priority, 31 the lowest."""

    priority: Priority
    ask: bool = False  #: the holder is asked first, and the page waits in line


class Release(Command, frozen=True, tag="release"):
    """Give the authority back, or leave the queue."""


class Answer(Command, frozen=True, tag="answer"):
    """The holder's answer to who asks for the authority."""

    id: int  #: of the question
    grant: bool
    reason: Reason = ""  #: why not, for a person


class TakeOff(Command, frozen=True, tag="takeoff"): ...


class HoverHere(Command, frozen=True, tag="hover"):
    """Hover, as the person decided; or by itself, as nothing is held any more, which takes the vehicle from nobody."""

    automatic: bool = False


class LandHere(Command, frozen=True, tag="land"): ...


class Stop(Command, frozen=True, tag="stop"):
    """Cut the motors; needs no authority."""


class Reset(Command, frozen=True, tag="reset"):
    """Leave the emergency state."""


class Fly(Command, frozen=True, tag="fly"):
    """Sticks: velocity in the body's levelled axes [m/s], yaw rate counter-clockwise [rad/s]."""

    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    yaw_rate: float = 0.0
    #: Grows with each sign of a hand: fingers that move, keys that repeat, raw axes. None: it does not say.
    touches: int | None = None


class GoTo(Command, frozen=True, tag="goto"):
    """A place in world axes: east, north, up [m], yaw counter-clockwise from east [rad]."""

    x: float
    y: float
    z: float
    yaw: float | None = None


class FlyBack(Command, frozen=True, tag="return"):
    """Fly back to where it took off, and land or hover there, as its parameters say."""


class FlyRoute(Command, frozen=True, tag="route"):
    """Fly along a route that was checked: ``id`` is of the check's answer."""

    id: Annotated[str, msgspec.Meta(max_length=64)]


class PauseRoute(Command, frozen=True, tag="route_pause"):
    """Hover until the route is resumed."""


class ResumeRoute(Command, frozen=True, tag="route_resume"):
    """Fly on to the waypoint that comes next."""


class SkipWaypoint(Command, frozen=True, tag="route_skip"):
    """Leave the present waypoint out."""


class StopRoute(Command, frozen=True, tag="route_stop"):
    """Hover, and end the route."""


class SelectTarget(Command, frozen=True, tag="follow_select"):
    """Keep the frames of a camera, as a box is about to be drawn on one of them; None: no longer."""

    camera: CameraName | None


class FollowTarget(Command, frozen=True, tag="follow"):
    """Track what is in a box, and fly after it if there is a mode."""

    camera: CameraName
    captured_ns: Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,19}$")]  #: of the frame that it was drawn on [ns]
    box: tuple[float, float, float, float]  #: x, y of its upper left corner, width and height [pixels]
    mode: Word | None = None  #: None: track it, and fly nothing before there is one
    class_name: Word | None = None  #: of a detection that was chosen
    distance_m: float | None = None  #: to keep; None: the follower's own
    size: tuple[Pixels, Pixels] | None = None  #: of the picture that it was drawn on; None: the frame's


class SetFollowMode(Command, frozen=True, tag="follow_mode"):
    """Fly after the target that is tracked, or go on in another mode."""

    mode: Word
    distance_m: float | None = None  #: to keep; None: as it is


class StopFollowing(Command, frozen=True, tag="follow_stop"):
    """Forget the target; hover if it was flown after."""


class Write(Command, frozen=True, tag="set"):
    """Write a parameter."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
    value: bool | int | float | str | list[float]


class Alive(Command, frozen=True, tag="ping"):
    """The page is there and receives from us: ``seen_s`` is the ``now_s`` of the newest pong that it got."""

    seen_s: float | None = None


class LandAll(Command, frozen=True, tag="land_all"):
    """Land every drone."""


class StopAll(Command, frozen=True, tag="stop_all"):
    """Cut the motors of every drone; needs no authority."""


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
    | FlyRoute
    | PauseRoute
    | ResumeRoute
    | SkipWaypoint
    | StopRoute
    | SelectTarget
    | FollowTarget
    | SetFollowMode
    | StopFollowing
)

AnyFleetCommand = LandAll | StopAll | Alive

_decoder = msgspec.json.Decoder(AnyCommand)
_fleet_decoder = msgspec.json.Decoder(AnyFleetCommand)


def decode_command(text: str | bytes) -> AnyCommand:
    """Decode a command to one drone.

    Raises:
        DecodeError: It is not one; the message says what is wrong.
    """
    command: AnyCommand = _decoded(_decoder, text)
    return command


def decode_fleet_command(text: str | bytes) -> AnyFleetCommand:
    """Decode a command to all drones.

    Raises:
        DecodeError: It is not one; the message says what is wrong.
    """
    command: AnyFleetCommand = _decoded(_fleet_decoder, text)
    return command


def late_s(command: Command) -> float:
    """Return how old a command may be [s]."""
    return STOP_LATE_S if isinstance(command, Stop | StopAll) else LATE_S


class HandWatch:
    """Whether sticks that are pushed are in anybody's hand. Pure.

    Hands are never still: a finger moves by pixels, a held key repeats, an axis that is at its end trembles across it.
    A gamepad whose radio link broke is still, and so would be a page that lost track of what is held.
    """

    def __init__(self) -> None:
        """Begin with sticks that nobody has pushed."""
        self._last: Fly | None = None
        self._moved_s = 0.0

    def holds(self, sticks: Fly, now_s: float) -> bool:
        """Return whether a hand was seen on them within :data:`UNTOUCHED_S`; called with each command of the sticks."""
        last, self._last = self._last, sticks
        same = last is not None and all(
            getattr(last, name) == getattr(sticks, name) for name in ("forward", "left", "up", "yaw_rate", "touches")
        )
        if not same or sticks.touches is None:  # a pause is no sign of a hand: the network makes them, too
            self._moved_s = now_s
        return now_s - self._moved_s <= UNTOUCHED_S


def untimely(command: Command, now_s: float) -> str:
    """Return why a command is not carried out; empty if it is in time.

    It may be too old, or nobody knows how old it is. A command that may be too old counts as too old.

    Args:
        command: The command.
        now_s: The cockpit's clock [s].
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
