"""What a page may say to fly: one JSON object a message, its kind named by ``do``. Pure."""

from __future__ import annotations

from typing import Annotated

import msgspec

from skyloop.errors import DecodeError
from skyloop.messages import HIGHEST_PRIORITY, LOWEST_PRIORITY
from skyloop.messages.config import Reason

Priority = Annotated[int, msgspec.Meta(ge=HIGHEST_PRIORITY, le=LOWEST_PRIORITY)]


class Order(msgspec.Struct, frozen=True, tag_field="do", forbid_unknown_fields=True):
    """Base of all of them."""

    @property
    def do(self) -> str:
        return str(self.__struct_config__.tag)


class Take(Order, frozen=True, tag="take"):
    """Ask for the authority: 0 is the highest priority, 31 the lowest."""

    priority: Priority
    ask: bool = False  #: the holder is asked first, and the page waits in line


class Release(Order, frozen=True, tag="release"):
    """Give it back, or leave the line."""


class Answer(Order, frozen=True, tag="answer"):
    """The holder's answer to who asks for the authority."""

    id: int  #: of the question
    grant: bool
    reason: Reason = ""  #: why not, for a person


class TakeOff(Order, frozen=True, tag="takeoff"): ...


class HoverHere(Order, frozen=True, tag="hover"): ...


class LandHere(Order, frozen=True, tag="land"): ...


class Stop(Order, frozen=True, tag="stop"):
    """Cut the motors; needs no authority."""


class Reset(Order, frozen=True, tag="reset"):
    """Leave the emergency state."""


class Fly(Order, frozen=True, tag="fly"):
    """Sticks: velocity in the body's levelled axes [m/s], yaw rate counter-clockwise [rad/s]."""

    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    yaw_rate: float = 0.0


class GoTo(Order, frozen=True, tag="goto"):
    """A place in world axes: east, north, up [m], yaw counter-clockwise from east [rad]."""

    x: float
    y: float
    z: float
    yaw: float | None = None


class Write(Order, frozen=True, tag="set"):
    """Write a parameter."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
    value: bool | int | float | str | list[float]


class Alive(Order, frozen=True, tag="ping"):
    """The page is there, and answers."""

    n: int = 0


AnyOrder = Take | Release | Answer | TakeOff | HoverHere | LandHere | Stop | Reset | Fly | GoTo | Write | Alive

_decoder = msgspec.json.Decoder(AnyOrder)


def decode_order(text: str | bytes) -> AnyOrder:
    """Raises :class:`DecodeError` that says what is wrong."""
    try:
        order: AnyOrder = _decoder.decode(text)
    except (msgspec.DecodeError, UnicodeEncodeError, RecursionError) as error:
        raise DecodeError(f"not understood: {error}") from None
    return order
