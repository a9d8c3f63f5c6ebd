"""Numbers of the Tello's commands: how many, which, and in which version. Ryze, SDK 1.3 and 2.0. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.vehicles.tello.wire.commands import Sdk

OUT_OF_RANGE: Final = "out of range"
Range = tuple[int, int]

_MOVE: Final[tuple[Range, ...]] = ((20, 500),)
_SPEED: Final[Range] = (10, 100)
_PLACE: Final[tuple[Range, ...]] = ((-500, 500),) * 3
_LEAST_CM: Final = 20  # one number of a position must be this far at least

MOVES: Final = {
    "up": (0, 0, 1),
    "down": (0, 0, -1),
    "left": (0, 1, 0),
    "right": (0, -1, 0),
    "forward": (1, 0, 0),
    "back": (-1, 0, 0),
}  #: forward, left, up
#: Command: the first SDK that has it, and the ranges of its whole numbers.
NUMBERS: Final[dict[str, tuple[Sdk, tuple[Range, ...]]]] = {
    **dict.fromkeys(MOVES, (Sdk.V1_3, _MOVE)),
    "cw": (Sdk.V1_3, ((1, 3600),)),
    "ccw": (Sdk.V1_3, ((1, 3600),)),
    "go": (Sdk.V1_3, (*_PLACE, _SPEED)),
    "curve": (Sdk.V1_3, (*_PLACE, *_PLACE, (10, 60))),
    "speed": (Sdk.V1_3, (_SPEED,)),
    "rc": (Sdk.V1_3, ((-100, 100),) * 4),
    "mdirection": (Sdk.V2_0, ((0, 2),)),
    "port": (Sdk.V3_0, ((1025, 65535), (1025, 65535))),
    "setbitrate": (Sdk.V3_0, ((0, 5),)),
    "downvision": (Sdk.V3_0, ((0, 1),)),
}
_FULL_TURN: Final = 360  # the most of a turn from 2.0 on


def numbers_of(name: str, words: list[str], sdk: Sdk) -> list[int] | str:
    """Return the numbers of a command, or what the Tello answers instead of executing it.

    Args:
        name: The command.
        words: What follows it.
        sdk: The version that is emulated.
    """
    _, ranges = NUMBERS[name]
    if len(words) != len(ranges):
        return "error"
    try:
        numbers = [int(word) for word in words]
    except ValueError:
        return "error"
    low_high = [(low, _FULL_TURN) for low, _ in ranges] if name in ("cw", "ccw") and sdk is not Sdk.V1_3 else ranges
    if not all(low <= number <= high for number, (low, high) in zip(numbers, low_high, strict=True)):
        return _refusal(sdk)
    if name in ("go", "curve") and not any(abs(number) >= _LEAST_CM for number in numbers[-4:-1]):
        return _refusal(sdk)
    return numbers


def _refusal(sdk: Sdk) -> str:
    return "error" if sdk is Sdk.V1_3 else OUT_OF_RANGE
