"""The autopilot's parameters over MAVLink: the whole list, what of it was lost, and writing. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.errors import DecodeError
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.parameter_values import from_field, is_integer, to_field

QUIET_NS: Final = nanoseconds(0.7)  #: nothing came for so long: what is missing is asked for
AT_ONCE: Final = 20  #: missing ones that are asked for together
LIST_NS: Final = nanoseconds(3.0)  #: pace of asking for the list while nothing of it comes
GIVE_UP_NS: Final = nanoseconds(20.0)  #: without a single new one
WRITE_NS: Final = nanoseconds(0.25)  #: pace of saying a new value
NO_INDEX: Final = 0xFFFF
MOST: Final = 8192  #: parameters of a list; one that announces more is not believed


@dataclass(frozen=True, slots=True)
class Held:
    """A parameter as the vehicle tells it."""

    name: str
    value: float
    kind: int  #: MAV_PARAM_TYPE


@dataclass(slots=True)
class _Write:
    name: str
    value: float
    deadline_ns: int
    done: Callable[[str | None], None]
    said_ns: int | None = None


class ParameterExchange:
    """One vehicle's. ``bytewise``: how its integers are written."""

    def __init__(self) -> None:
        self.target = (1, 1)
        self.bytewise = False
        self.held: dict[str, Held] = {}
        self.count: int | None = None
        self.complete = False
        self.given_up = False
        self._wanted = False
        self._indices: set[int] = set()
        self._news_ns = 0  # when something new came
        self._asked_ns: int | None = None
        self._writes: list[_Write] = []

    def begin(self, now_ns: int) -> None:
        """Read all of them, anew."""
        self._wanted, self.complete, self.given_up = True, False, False
        self._indices.clear()
        self.count, self._asked_ns, self._news_ns = None, None, now_ns

    def abandon(self, reason: str) -> None:
        """The vehicle was lost: writes fail."""
        writes, self._writes = self._writes, []
        for write in writes:
            write.done(reason)

    def write(self, name: str, value: float, deadline_ns: int, done: Callable[[str | None], None]) -> None:
        """Write one that is held; ``done`` gets why that failed, or None."""
        self._writes.append(_Write(name, value, deadline_ns, done))

    @property
    def values(self) -> dict[str, float]:
        """By the autopilot's own names."""
        return {name: held.value for name, held in self.held.items()}

    def heard(self, message: Message, now_ns: int) -> None:
        """A ``PARAM_VALUE``."""
        name, kind = message.param_id, message.param_type
        try:
            value = from_field(message.param_value, kind, bytewise=self.bytewise)
        except DecodeError:
            value = math.nan
        index, count = message.param_index, message.param_count
        if index != NO_INDEX and 0 < count <= MOST and index < count:
            self.count = count
            if index not in self._indices:
                self._indices.add(index)
                self._news_ns = now_ns
            self.complete = self._wanted and len(self._indices) >= count
        if name and not math.isnan(value):
            self.held[name] = Held(name, value, kind)
            self._end_writes(name, value)

    def step(self, now_ns: int) -> list[Message]:
        """What is to be said now."""
        return self._say_writes(now_ns) + self._ask(now_ns)

    def _ask(self, now_ns: int) -> list[Message]:
        if not self._wanted or self.complete or self.given_up:
            return []
        if self.count is None:
            if now_ns - self._news_ns > GIVE_UP_NS:
                self.given_up = True
            elif self._asked_ns is None or now_ns - self._asked_ns > LIST_NS:
                self._asked_ns = now_ns
                return [m.MAVLink_param_request_list_message(*self.target)]
            return []
        if now_ns - self._news_ns > GIVE_UP_NS:
            self.given_up = True
            return []
        if now_ns - max(self._news_ns, self._asked_ns or 0) < QUIET_NS:
            return []
        self._asked_ns = now_ns
        missing = [index for index in range(self.count) if index not in self._indices][:AT_ONCE]
        return [m.MAVLink_param_request_read_message(*self.target, b"", index) for index in missing]

    def _say_writes(self, now_ns: int) -> list[Message]:
        messages = []
        for write in list(self._writes):
            if now_ns >= write.deadline_ns:
                self._writes.remove(write)
                told = self.held[write.name].value
                write.done(f"the vehicle does not confirm it, and keeps {told:g} as far as is known")
            elif write.said_ns is None or now_ns - write.said_ns >= WRITE_NS:
                write.said_ns = now_ns
                kind = self.held[write.name].kind
                field = to_field(write.value, kind, bytewise=self.bytewise)
                messages.append(m.MAVLink_param_set_message(*self.target, write.name.encode(), field, kind))
        return messages

    def _end_writes(self, name: str, value: float) -> None:
        for write in list(self._writes):
            exact = self.bytewise and is_integer(self.held[name].kind)
            if write.name == name and write.said_ns is not None and taken(write.value, value, exact=exact):
                self._writes.remove(write)
                write.done(None)


def taken(wanted: float, told: float, *, exact: bool) -> bool:
    """Whether this is the value that was written; in single precision unless it is ``exact``."""
    return wanted == told if exact else math.isclose(wanted, told, rel_tol=1e-6, abs_tol=1e-9)
