"""The keys of a terminal as a pilot's sticks and orders. :class:`Sticks` is pure; :class:`Keyboard` reads the terminal.

A terminal sends presses and repeats, never that a key was released. So a press moves its stick for :data:`HOLD_S`,
longer than terminals wait before they repeat a key, and repeats keep it there.
"""

from __future__ import annotations

import os
import select
import sys
from types import TracebackType
from typing import Any, Final, Literal, NamedTuple, Self

from skyloop.errors import UnsupportedError, UsageError

HOLD_S: Final = 0.6  #: how long a press moves its stick
TWICE_S: Final = 1.0  #: two presses of Esc within this cut the motors
_ESC_ALONE_S: Final = 0.03  #: an arrow's other bytes come within this after its Esc

Order = Literal["takeoff", "hover", "land", "stop", "take", "release", "faster", "slower", "quit"]
Axis = Literal["forward", "left", "up", "yaw_rate"]

STICKS: Final[dict[str, tuple[Axis, int]]] = {
    "w": ("forward", 1),
    "s": ("forward", -1),
    "a": ("left", 1),
    "d": ("left", -1),
    "up": ("up", 1),
    "down": ("up", -1),
    "left": ("yaw_rate", 1),
    "right": ("yaw_rate", -1),
}
ORDERS: Final[dict[str, Order]] = {
    "t": "takeoff",
    "h": "hover",
    " ": "hover",
    "l": "land",
    "c": "take",
    "r": "release",
    "+": "faster",
    "-": "slower",
    "q": "quit",
}
#: For people: the same keys as the cockpit's.
KEY_MAP: Final = (
    ("Esc Esc", "motors off, at once; the first Esc hovers"),
    ("T", "take off"),
    ("H, Space", "hover"),
    ("L", "land"),
    ("W S", "forward, back"),
    ("A D", "left, right"),
    ("↑ ↓", "up, down"),
    ("← →", "turn left, right"),
    ("+ −", "faster, slower"),
    ("C R", "take control, release"),
    ("Q", "land if flying, and end"),
)
_ARROWS: Final = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}


class Deflection(NamedTuple):
    """Where the sticks are, each from -1 to 1: forward, left, up, counter-clockwise."""

    forward: int = 0
    left: int = 0
    up: int = 0
    yaw_rate: int = 0


class Sticks:
    """The meaning of key presses over time; the time [s] is an argument."""

    def __init__(self) -> None:
        self._pressed: dict[Axis, tuple[int, float]] = {}
        self._escaped_s = -TWICE_S * 2

    def press(self, key: str, now_s: float) -> Order | None:
        """Handle a press; return what it orders, None for a key that moves a stick or means nothing."""
        if key == "esc":
            twice = now_s - self._escaped_s <= TWICE_S
            self._escaped_s = now_s
            self._pressed.clear()
            return "stop" if twice else "hover"
        stick = STICKS.get(key.lower())
        if stick is not None:
            self._pressed[stick[0]] = (stick[1], now_s)
            return None
        order = ORDERS.get(key.lower())
        if order in ("hover", "land", "takeoff"):
            self._pressed.clear()
        return order

    def deflection(self, now_s: float) -> Deflection:
        """Return where the sticks are now."""
        return Deflection(**{axis: sign for axis, (sign, at_s) in self._pressed.items() if now_s - at_s < HOLD_S})


def split_keys(data: bytes) -> tuple[list[str], bytes]:
    """Split what a terminal sent into keys, and what is left of a sequence that is not complete yet."""
    keys: list[str] = []
    while data:
        if data[:1] != b"\x1b":
            keys.append(data[:1].decode("ascii", "replace"))
            data = data[1:]
        elif len(data) == 1 or (len(data) == 2 and data[1:2] in b"[O"):
            break
        elif data[1:2] in (b"[", b"O"):
            keys.append(_ARROWS.get(data[2:3], ""))
            data = data[3:]
        else:
            keys.append("esc")
            data = data[1:]
    return [key for key in keys if key], data


class Keyboard:
    """The terminal's keys, one by one, without waiting for Enter; a context manager that restores the terminal.

    Raises:
        UsageError: Standard input is no terminal.
        UnsupportedError: This platform's terminals give no single keys.
    """

    def __init__(self) -> None:
        try:
            import termios
            import tty
        except ImportError:
            raise UnsupportedError(
                f"flying by keys of the terminal needs Linux or macOS, and this is {sys.platform}; fly on the page: "
                "skyloop cockpit"
            ) from None
        self._termios, self._tty = termios, tty
        if not sys.stdin.isatty():
            raise UsageError("standard input is no terminal: flying by keys needs one")
        self._fd = sys.stdin.fileno()
        self._before: list[Any] = termios.tcgetattr(self._fd)
        self._rest = b""

    def __enter__(self) -> Self:
        self._tty.setcbreak(self._fd)  # Ctrl-C still interrupts
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._termios.tcsetattr(self._fd, self._termios.TCSADRAIN, self._before)

    def keys(self, within_s: float) -> list[str]:
        """Return the keys that were pressed, as soon as there are any.

        Args:
            within_s: How long to wait for one [s].

        Raises:
            EOFError: The terminal is gone.
        """
        if not self._ready(_ESC_ALONE_S if self._rest else within_s):
            alone, self._rest = self._rest, b""
            return ["esc"] if alone else []
        data = os.read(self._fd, 1024)
        if not data:
            raise EOFError
        keys, self._rest = split_keys(self._rest + data)
        return keys

    def _ready(self, within_s: float) -> bool:
        return bool(select.select([self._fd], [], [], within_s)[0])
