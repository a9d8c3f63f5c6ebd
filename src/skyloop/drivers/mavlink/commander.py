"""Commands that are said again until they show their effect, and what the vehicle answered to them. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m

ACCEPTED: Final = 0
IN_PROGRESS: Final = 5
_RESULTS: Final = {
    0: "accepted",
    1: "temporarily rejected",
    2: "denied",
    3: "unsupported",
    4: "failed",
    5: "in progress",
    6: "cancelled",
}


@dataclass(frozen=True, slots=True)
class Order:
    """A command's number and its seven arguments."""

    command: int
    arguments: tuple[float, ...] = ()


def result_name(result: int) -> str:
    """``MAV_RESULT`` in words."""
    return _RESULTS.get(result, f"result {result}")


class Commander:
    """Level-triggered: who wants an effect calls :meth:`say` again and again until it is there."""

    def __init__(self) -> None:
        self.target = (1, 1)  #: system and component
        self._out: list[Message] = []
        self._said: dict[Order, tuple[int, int]] = {}  # when last, and how often
        self._answers: dict[int, tuple[int, int]] = {}  # command: result, when

    def say(self, order: Order, now_ns: int, pace_s: float = 0.5) -> None:
        """Send it, unless it was sent a moment ago."""
        last_ns, times = self._said.get(order, (None, 0))
        if last_ns is not None and now_ns - last_ns < nanoseconds(pace_s):
            return
        if last_ns is None or now_ns - last_ns > 4 * nanoseconds(pace_s):
            times = 0  # not a repeat of the same asking
        self._said[order] = now_ns, times + 1
        arguments = (*order.arguments, *[0.0] * (7 - len(order.arguments)))
        self._out.append(m.MAVLink_command_long_message(*self.target, order.command, min(times, 255), *arguments))

    def heard(self, message: Message, now_ns: int) -> None:
        """A ``COMMAND_ACK`` for us."""
        if message.result != IN_PROGRESS:
            self._answers[message.command] = message.result, now_ns

    def answer(self, command: int, since_ns: int) -> int | None:
        """The newest result of a command, if it came since then."""
        found = self._answers.get(command)
        return found[0] if found is not None and found[1] >= since_ns else None

    def forget(self) -> None:
        """The vehicle was lost: nothing of before counts."""
        self._out.clear()
        self._said.clear()
        self._answers.clear()

    def take(self) -> list[Message]:
        """What is to be sent now."""
        out, self._out = self._out, []
        return out
