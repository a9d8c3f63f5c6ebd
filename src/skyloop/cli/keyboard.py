"""Convert a terminal's keys to a pilot's stick positions and commands; :class:`Hands` and :class:`Tokenizer` are pure.

A terminal reports presses and repeats, but never releases. A press therefore moves its stick for :data:`HOLD_S`, which
is longer than the delay after which terminals repeat a key; repeats hold the stick there.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple, Self

from skyloop.errors import UsageError
from skyloop.messages import FlightState
from skyloop.platform import single_keys

HOLD_S: Final = 0.6  #: how long a key press moves its stick
TWICE_S: Final = 1.0  #: pressing Esc twice within this time cuts the motors
REPEAT_S: Final = 0.12  #: a held key repeats faster than this, but no finger does
DELAY_S: Final = 0.2  #: all keyboards wait at least this long before a key repeats
SAME_S: Final = 0.04  #: a second Esc whose delay is this close to the keyboard's delay may be a repeat of the first
LANDING_S: Final = 3.0  #: sticks are blocked for this long after L; the vehicle may not have reported landing yet
STOPPING_S: Final = 2.0  #: after a stop, nothing else is requested for this long, unless the vehicle reports the stop
_ESC_ALONE_S: Final = 0.03  #: the remaining bytes of an arrow key arrive within this time after its Esc
_LONGEST: Final = 32  # maximum length of a sequence in bytes

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
    "centre",  #: the sticks have been released
    "held",  #: Esc is being held down, which does not count as a second press
    "grounded",  #: a stick was moved while the drone was on the ground
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
#: The keys and their meanings, as shown to users; they are the same as in the cockpit.
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
    ("Q", "land if flying, and quit"),
)
_NAMES: Final = {"up": "↑", "down": "↓", "left": "←", "right": "→", " ": "Space", "\n": "Enter", "\t": "Tab"}
#: Asks the terminal to report when its window gains and loses the keyboard focus, or to stop reporting.
REPORT_FOCUS: Final = "\x1b[?1004h"
IGNORE_FOCUS: Final = "\x1b[?1004l"
_FOCUS: Final = {
    b"\x1b[I": "this window receives keys again",
    b"\x1b[O": "another window receives the keys: they have no effect here",
}
_ARROWS: Final = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}
_ARROW: Final = re.compile(rb"\x1b[\[O]([ABCD])")
_SEQUENCE: Final = re.compile(rb"\x1b+(?:\[[0-?]*[ -/]*[@-~]|O[0-9;]*[@-~])")
_UNFINISHED: Final = re.compile(rb"\x1b+(?:\[[0-?]*[ -/]*|O[0-9;]*)?")


class Deflection(NamedTuple):
    """Positions of the sticks, each from -1 to 1: forward, left, up, counter-clockwise."""

    forward: int = 0
    left: int = 0
    up: int = 0
    yaw_rate: int = 0


class Hands:
    """Converts a pilot's keys to commands. Pure; takes the time [s] as an argument."""

    def __init__(self) -> None:
        self._stepped_s = -math.inf  # time of the last step
        self._pressed: dict[Axis, tuple[int, float]] = {}
        self._held_over: dict[str, float] = {}  # stick keys held during a landing, and the times of their last repeats
        self._moving = False  # whether the last step moved a stick
        self._landed_s = -math.inf  # time of the last press of L
        self._stopped_s = -math.inf  # time of the last stop
        self._escaped_s = -math.inf  # time of the last Esc, unless another key has followed
        self._second: tuple[float, float] | None = None  # the second Esc: its time, and the time since the first one
        self._repeats = False  # whether Esc is being held
        self._doubtful = False  # whether the last Esc may have been a press or the first repeat of a held key
        self._delay_s = math.inf  # the keyboard's delay before it repeats a held key; infinite while unknown
        self._newest = "", -math.inf, math.inf  # the last key, when it was pressed, and the time since the press before
        self.no_effect = ""  #: why a key had no effect in the last step, for users; empty if all had one

    def step(self, keys: Sequence[str], now_s: float, state: FlightState) -> list[Order | Deflection]:
        """Return the commands in order. If a stick is moved, the positions of the sticks are the last item."""
        wanted: list[Order | Deflection] = []
        self.no_effect = ""
        stalled = now_s - self._stepped_s > REPEAT_S  # several keys may have queued up, so their timing means nothing
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
        """Learn the keyboard's delay from a held key: one press, a pause, then many presses in succession."""
        before, at_s, gap_s = self._newest
        since_s = now_s - at_s if key == before else math.inf
        if since_s < REPEAT_S and DELAY_S <= gap_s <= TWICE_S and not stalled:
            self._delay_s = gap_s
        self._newest = key, now_s, since_s

    def _press(self, key: str, now_s: float, state: FlightState) -> Order | None:
        second, self._second, self._escaped_s = self._second, None, -math.inf
        if second is not None and second[1] < DELAY_S:
            return self._stop(now_s)  # this is too early for a repeat: the key was pressed twice
        key = key.lower()
        order = "hover" if key == "alt" else ORDERS.get(key)
        if order == "quit":
            return order
        if now_s - self._stopped_s < STOPPING_S and state is not FlightState.EMERGENCY:
            self.no_effect = f"{_shown(key)} has no effect while the motors are being stopped"
            return None  # a stop that the vehicle has not reported yet must not be replaced by any command
        if key not in STICKS:
            if order is None:
                self.no_effect = f"{_shown(key)} has no function here"
            return order
        axis, sign = STICKS[key]
        landing = state is FlightState.LANDING or now_s - self._landed_s < LANDING_S
        if landing or now_s - self._held_over.get(key, -math.inf) < HOLD_S:
            self.no_effect = (
                f"{_shown(key)} has no effect during a landing; release it, end the landing with H, and press it again"
            )
            self._held_over[key] = now_s  # only H ends a landing; sticks or keys held meanwhile do not
        else:
            self._pressed[axis] = (sign, now_s)
        return None

    def _escape(self, now_s: float, *, stalled: bool) -> Order | None:
        """Hover at the first press and cut the motors at the second; a held key does not make a second press."""
        if now_s - self._stopped_s < STOPPING_S:
            return self._stop(now_s)  # stop again, rather than hover
        gap_s, self._escaped_s = now_s - self._escaped_s, now_s
        if self._second is not None or (self._repeats and gap_s < REPEAT_S):
            first, self._second, self._repeats, self._doubtful = not self._repeats, None, True, False
            return "held" if first else None
        if self._doubtful and gap_s <= TWICE_S and not stalled:
            return self._stop(now_s)  # too late for a repeat: a new press, whatever the last Esc meant
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
    """Return a key's printed label, or the bytes that the key sends."""
    return _NAMES.get(key) or (key.upper() if key.isprintable() else repr(key))


class Tokenizer:
    """Converts a terminal's bytes to keys: letters, ``up`` … for arrows, ``esc``, and ``alt`` for Alt with any key.

    A terminal sends Alt plus a key as Esc followed by that key, exactly as if Esc had been pressed just before the key.
    Therefore, ``alt`` makes the drone hover but does not count as Esc.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._alone = False  # whether the last Esc was treated as a separate key
        self.other = ""  #: a notice for users about other input in the newest bytes; may be empty

    @property
    def waits(self) -> bool:
        """Whether a key sequence has begun but not ended."""
        return bool(self._rest)

    def feed(self, data: bytes) -> list[str]:
        """Return the keys whose sequences are complete."""
        late = self._alone and data[:1] in (b"[", b"O")  # the late remainder of an arrow key's sequence
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
                    keys += ["esc"] * (len(found[0]) - 3)  # presses of Esc just before this sequence
                elif arrow is not None and not late:
                    keys.append(_ARROWS[arrow[1]])
                elif data[:2] == b"\x1b\x1b":
                    keys.append("alt")
                elif arrow is None:
                    self.other = "this key has no function here"
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
        """Return the keys of an unfinished sequence after which no more bytes have arrived."""
        rest, self._rest, self.other = self._rest, b"", ""
        self._alone = rest == b"\x1b"
        return ["esc"] * len(rest) if not rest.strip(b"\x1b") else ["alt"]


class Keyboard:
    """Reads the terminal's keys one at a time, without Enter; a context manager that restores the terminal.

    Raise ``UsageError`` if standard input is not a terminal.
    """

    def __init__(self) -> None:
        if not sys.stdin.isatty():
            raise UsageError("standard input is not a terminal: flying by keys needs one")
        self._terminal = single_keys(sys.stdin.fileno())
        self._tokens = Tokenizer()

    def __enter__(self) -> Self:
        self._read = self._terminal.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._terminal.__exit__(None, None, None)

    @property
    def other(self) -> str:
        """A notice for users about other input that was just read; may be empty."""
        return self._tokens.other

    def keys(self, within_s: float) -> list[str]:
        """Wait for keys and return those that were pressed. Raise ``EOFError`` if the terminal has been closed."""
        data = self._read(_ESC_ALONE_S if self._tokens.waits else within_s)
        if data is None:
            return self._tokens.flush()
        if not data:
            raise EOFError
        return self._tokens.feed(data)
