"""The keys of a terminal as a pilot's sticks and orders: :class:`Hands` and :class:`Tokenizer` are pure.

A terminal sends presses and repeats, never that a key was released. So a press moves its stick for :data:`HOLD_S`,
longer than terminals wait before they repeat a key, and repeats keep it there.
"""

from __future__ import annotations

import math
import os
import re
import signal
import sys
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Final, Literal, NamedTuple, Self

from skyloop.errors import UnsupportedError, UsageError
from skyloop.files import wait_readable
from skyloop.messages import FlightState

HOLD_S: Final = 0.6  #: how long a press moves its stick
TWICE_S: Final = 1.0  #: two presses of Esc within this cut the motors
REPEAT_S: Final = 0.12  #: a key that is held repeats sooner than this, and no finger does
DELAY_S: Final = 0.2  #: before that no keyboard begins to repeat
SAME_S: Final = 0.04  #: a second Esc that is so near to the keyboard's own delay may be a repeat of the first
LANDING_S: Final = 3.0  #: so long after L no stick is moved, as the vehicle may not show yet that it lands
STOPPING_S: Final = 2.0  #: so long after a stop nothing else is asked for, unless it shows
_ESC_ALONE_S: Final = 0.03  #: an arrow's other bytes come within this after its Esc
_LONGEST: Final = 32  # bytes of a sequence; what is longer is none

Order = Literal[
    "takeoff",
    "hover",
    "land",
    "stop",
    "take",
    "release",
    "faster",
    "slower",
    "quit",
    "centre",  #: the sticks were let go
    "held",  #: Esc is held, which is no second press
    "grounded",  #: a stick was moved on the ground
]
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
_NAMES: Final = {"up": "↑", "down": "↓", "left": "←", "right": "→", " ": "Space", "\n": "Enter", "\t": "Tab"}
#: Ask the terminal to report when its window gains and loses the keyboard, and to stop that.
TELL_FOCUS: Final = "\x1b[?1004h"
TELL_NO_FOCUS: Final = "\x1b[?1004l"
_FOCUS: Final = {
    b"\x1b[I": "this window gets the keys again",
    b"\x1b[O": "another window gets the keys: none is heard here",
}
_ARROWS: Final = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}
_ARROW: Final = re.compile(rb"\x1b[\[O]([ABCD])")
_SEQUENCE: Final = re.compile(rb"\x1b+(?:\[[0-?]*[ -/]*[@-~]|O[0-9;]*[@-~])")
_UNFINISHED: Final = re.compile(rb"\x1b+(?:\[[0-?]*[ -/]*|O[0-9;]*)?")


class Deflection(NamedTuple):
    """Where the sticks are, each from -1 to 1: forward, left, up, counter-clockwise."""

    forward: int = 0
    left: int = 0
    up: int = 0
    yaw_rate: int = 0


class Hands:
    """What a pilot's hands at a keyboard ask for. Pure: the time [s] is an argument."""

    def __init__(self) -> None:
        self._stepped_s = -math.inf  # the last step
        self._pressed: dict[Axis, tuple[int, float]] = {}
        self._held_over: dict[str, float] = {}  # stick keys that were held while it landed, and their last repeat
        self._moving = False  # whether a stick was moved at the last step
        self._landed_s = -math.inf  # when L was pressed
        self._stopped_s = -math.inf  # when the motors were cut
        self._escaped_s = -math.inf  # the last press of Esc, with no other key since
        self._second: tuple[float, float] | None = None  # a second one: when, and how long after the first
        self._repeats = False  # Esc is held
        self._doubtful = False  # the last Esc may have been a press, or the first repeat of one that was held
        self._delay_s = math.inf  # the keyboard's, before it repeats a key that is held; not known yet
        self._newest = "", -math.inf, math.inf  # the last key, when, and how long after the same one before it
        self.no_effect = ""  #: why a key of the last step did nothing, for people; empty where each did something

    def step(self, keys: Sequence[str], now_s: float, state: FlightState) -> list[Order | Deflection]:
        """Return what is to be done, in this order; last where the sticks are, if one is moved."""
        wanted: list[Order | Deflection] = []
        self.no_effect = ""
        stalled = now_s - self._stepped_s > REPEAT_S  # keys may have waited, and tell no time
        self._stepped_s = now_s
        repeats = stalled and bool(keys) and keys[0] == "esc"
        if self._second is not None and now_s - self._second[0] >= REPEAT_S and not repeats:
            wanted.append(self._stop(now_s))
        for key in keys:
            self._learn(key, now_s, stalled=stalled)
            order = self._escape(now_s, stalled=stalled) if key == "esc" else self._press(key, now_s, state)
            if order in ("hover", "land", "takeoff", "stop"):
                self._pressed.clear()
                self._moving = False
                self._landed_s = now_s if order == "land" else -math.inf
            if order is not None:
                wanted.append(order)
        sticks = Deflection(**{axis: sign for axis, (sign, at_s) in self._pressed.items() if now_s - at_s < HOLD_S})
        if any(sticks):
            self._moving = state.airborne
            wanted.append(sticks if state.airborne else "grounded")
        elif self._moving:
            self._moving = False
            wanted.append("centre")
        return wanted

    def _learn(self, key: str, now_s: float, *, stalled: bool) -> None:
        """Learn the keyboard's delay from a key that is held: one press, a pause, and then many in a row."""
        before, at_s, gap_s = self._newest
        since_s = now_s - at_s if key == before else math.inf
        if since_s < REPEAT_S and DELAY_S <= gap_s <= TWICE_S and not stalled:
            self._delay_s = gap_s
        self._newest = key, now_s, since_s

    def _press(self, key: str, now_s: float, state: FlightState) -> Order | None:
        second, self._second, self._escaped_s = self._second, None, -math.inf
        if second is not None and second[1] < DELAY_S:
            return self._stop(now_s)  # no key that is held repeats so soon: it was pressed twice
        key = key.lower()
        order = "hover" if key == "alt" else ORDERS.get(key)
        if order == "quit":
            return order
        if now_s - self._stopped_s < STOPPING_S and state is not FlightState.EMERGENCY:
            self.no_effect = f"{_shown(key)} has no effect while the motors are being stopped"
            return None  # nothing takes the place of a stop that is not shown yet
        if key not in STICKS:
            if order is None:
                self.no_effect = f"{_shown(key)} is no key here"
            return order
        axis, sign = STICKS[key]
        landing = state is FlightState.LANDING or now_s - self._landed_s < LANDING_S
        if landing or now_s - self._held_over.get(key, -math.inf) < HOLD_S:
            self.no_effect = (
                f"{_shown(key)} has no effect on a landing, which H ends; let it go, and press it again then"
            )
            self._held_over[key] = now_s  # a landing is ended by H, by no stick and no key that was held meanwhile
        else:
            self._pressed[axis] = (sign, now_s)
        return None

    def _escape(self, now_s: float, *, stalled: bool) -> Order | None:
        """Hover at the first press, and cut the motors at the second, which a key that is held does not make."""
        if now_s - self._stopped_s < STOPPING_S:
            return self._stop(now_s)  # once more, and no hover in its place
        gap_s, self._escaped_s = now_s - self._escaped_s, now_s
        if self._second is not None or (self._repeats and gap_s < REPEAT_S):
            first, self._second, self._repeats, self._doubtful = not self._repeats, None, True, False
            return "held" if first else None
        if self._doubtful and gap_s <= TWICE_S and not stalled:
            return self._stop(now_s)  # no repeat comes so late: pressed anew, whatever the one before was
        if gap_s > TWICE_S or self._repeats:
            self._repeats = self._doubtful = False
            return "hover"
        if REPEAT_S <= gap_s < DELAY_S:
            return self._stop(now_s)
        if abs(gap_s - self._delay_s) < SAME_S:
            self._repeats = self._doubtful = True
            return "held"
        self._second = now_s, gap_s
        return None

    def _stop(self, now_s: float) -> Order:
        self._second, self._escaped_s, self._stopped_s = None, -math.inf, now_s
        self._doubtful = False
        self._pressed.clear()
        self._moving = False
        return "stop"


def _shown(key: str) -> str:
    """Return a key as it is written on a keyboard, or as what it sends."""
    return _NAMES.get(key) or (key.upper() if key.isprintable() else repr(key))


class Tokenizer:
    """Makes keys of what a terminal sends: letters, ``up`` … for arrows, ``esc``, and ``alt`` for Alt with any key.

    Alt sends an Esc before its key, as do two keys pressed at almost the same time: ``alt`` hovers, and is no Esc.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._alone = False  # an Esc was taken for one that stands alone
        self.other = ""  #: a notice about other input in the last bytes, for people; may be empty

    @property
    def waits(self) -> bool:
        """Whether there is the beginning of a sequence."""
        return bool(self._rest)

    def feed(self, data: bytes) -> list[str]:
        """Return the keys that are complete."""
        late = self._alone and data[:1] in (b"[", b"O")  # the rest of an arrow that came slowly
        data, self._alone = self._rest + (b"\x1b" if late else b"") + data, False
        self.other = ""
        keys: list[str] = []
        while data:
            if data[:1] != b"\x1b":
                keys.append(data[:1].decode("ascii", "replace"))
                data = data[1:]
            elif found := _SEQUENCE.match(data):
                arrow = _ARROW.fullmatch(found[0])
                if (focus := _FOCUS.get(found[0][-3:])) is not None:
                    self.other = focus
                    keys += ["esc"] * (len(found[0]) - 3)  # pressed just before, and no part of this
                elif arrow is not None and not late:
                    keys.append(_ARROWS[arrow[1]])
                elif data[:2] == b"\x1b\x1b":
                    keys.append("alt")
                elif arrow is None:
                    self.other = "this key is none here"
                data = data[found.end() :]
            elif len(data) <= _LONGEST and _UNFINISHED.fullmatch(data):
                break
            elif data[1:2] == b"\x1b":
                keys.append("esc")
                data = data[1:]
            else:
                keys.append("alt")
                data = data[2:]
        self._rest = data
        return keys

    def flush(self) -> list[str]:
        """Return what the beginning of a sequence was, as nothing more came."""
        rest, self._rest, self.other = self._rest, b"", ""
        self._alone = rest == b"\x1b"
        return ["esc"] * len(rest) if not rest.strip(b"\x1b") else ["alt"]


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
        self._tokens = Tokenizer()
        self._continued: Any = None  # who else handles SIGCONT

    def __enter__(self) -> Self:
        self._set_mode()
        self._continued = signal.signal(
            signal.SIGCONT, lambda *_: self._set_mode()
        )  # a shell has set its own meanwhile
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        signal.signal(signal.SIGCONT, self._continued)
        self._termios.tcsetattr(self._fd, self._termios.TCSANOW, self._before)

    def _set_mode(self) -> None:
        """Read single keys; Ctrl-C still interrupts, Ctrl-Z does not suspend a flight and Ctrl-S holds nothing up."""
        termios = self._termios
        self._tty.setcbreak(self._fd, termios.TCSANOW)
        mode = termios.tcgetattr(self._fd)
        mode[0] &= ~termios.IXON
        for name in ("VSUSP", "VDSUSP"):
            if hasattr(termios, name):
                mode[6][getattr(termios, name)] = bytes((os.fpathconf(self._fd, "PC_VDISABLE"),))
        termios.tcsetattr(self._fd, termios.TCSANOW, mode)

    @property
    def other(self) -> str:
        """A notice about other input than keys that was just read, for people; may be empty."""
        return self._tokens.other

    def keys(self, within_s: float) -> list[str]:
        """Return the keys that were pressed, as soon as there are any.

        Raises:
            EOFError: The terminal is gone.
        """
        if not self._ready(_ESC_ALONE_S if self._tokens.waits else within_s):
            return self._tokens.flush()
        data = os.read(self._fd, 1024)
        if not data:
            raise EOFError
        return self._tokens.feed(data)

    def _ready(self, within_s: float) -> bool:
        return wait_readable(self._fd, within_s)
