"""Which request is sent when: who the flight controller is, then its state, as fast as it answers. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.wire.msp.frames import Direction, Frame
from skyloop.wire.msp.messages import Function, multiple

PATIENCE_NS: Final = nanoseconds(0.5)  #: an answer that has not come by then is lost
TRIES: Final = 3

#: Takes the answer's payload; None: it does not know the function, or did not answer.
Handler = Callable[[bytes | None], None]


@dataclass(slots=True)
class Asked:
    """A request whose answer is waited for."""

    functions: tuple[int, ...]
    sent_ns: int


class Questions:
    """Asks one thing after the other, each until it is answered, at most :data:`TRIES` times."""

    def __init__(self) -> None:
        self._queue: deque[tuple[Frame, Handler]] = deque()
        self._sent_ns: int | None = None
        self._tries = 0

    @property
    def idle(self) -> bool:
        """Whether nothing is left to ask."""
        return not self._queue

    def ask(self, function: int, handler: Handler, payload: bytes = b"") -> None:
        """Ask something after what waits already."""
        self._queue.append((Frame(function, payload), handler))

    def clear(self) -> None:
        """Give up everything, without a word to the handlers."""
        self._queue.clear()
        self._sent_ns = None

    def due(self, now_ns: int) -> Frame | None:
        """Return the request to send now."""
        if not self._queue or (self._sent_ns is not None and now_ns - self._sent_ns < PATIENCE_NS):
            return None
        if self._sent_ns is not None and self._tries >= TRIES:
            self._answer(None)
            return self.due(now_ns)
        self._sent_ns = now_ns
        self._tries += 1
        return self._queue[0][0]

    def on_frame(self, frame: Frame) -> bool:
        """Handle a frame; returns whether it is the answer that is waited for."""
        if not self._queue or self._sent_ns is None or frame.function != self._queue[0][0].function:
            return False
        self._answer(None if frame.direction is Direction.ERROR else frame.payload)
        return True

    def _answer(self, payload: bytes | None) -> None:
        _, handler = self._queue.popleft()
        self._sent_ns, self._tries = None, 0
        handler(payload)


@dataclass(slots=True)
class Stream:
    """A state that is asked for again and again."""

    function: int
    period_ns: int
    due_ns: int = 0


class Telemetry:
    """Asks for states at their rates, several in one frame where the firmware can, few at a time.

    A flight controller answers some tens of requests a second, whatever the line could carry: more would wait in its
    buffers, and so would the sticks behind them.

    Args:
        streams: Rates in hertz, by function.
        bundled: Whether the firmware knows ``MULTIPLE``.
        most: Requests that may be without an answer.
    """

    def __init__(self, streams: dict[int, float], *, bundled: bool, most: int = 2) -> None:
        self._streams = {function: Stream(function, nanoseconds(1 / rate)) for function, rate in streams.items()}
        self._bundled = bundled
        self._most = most
        self._asked: deque[Asked] = deque()
        self.unanswered = 0

    def drop(self, function: int) -> None:
        """No longer ask for a state: the firmware does not know it."""
        self._streams.pop(function, None)

    def due_ns(self) -> int | None:
        """Return when something is to be asked for next; None: never."""
        return min((stream.due_ns for stream in self._streams.values()), default=None)

    def requests(self, now_ns: int) -> list[Frame]:
        """Return what is to be sent now."""
        while self._asked and now_ns - self._asked[0].sent_ns >= PATIENCE_NS:
            self._asked.popleft()
            self.unanswered += 1
        due = [stream for stream in self._streams.values() if stream.due_ns <= now_ns]
        made: list[Frame] = []
        while due and len(self._asked) < self._most:
            taken = due if self._bundled else due[:1]
            due = due[len(taken) :]
            for stream in taken:
                stream.due_ns = max(stream.due_ns + stream.period_ns, now_ns)
            functions = tuple(stream.function for stream in taken)
            self._asked.append(Asked(functions, now_ns))
            bundle = self._bundled and len(functions) > 1
            made.append(Frame(Function.MULTIPLE, bytes(functions)) if bundle else Frame(functions[0]))
        return made

    def on_frame(self, frame: Frame) -> list[tuple[int, bytes | None]]:
        """Handle a frame; returns the states that it answers, None in the place of one that is not known."""
        for number, asked in enumerate(self._asked):
            bundle = len(asked.functions) > 1
            if frame.function != (Function.MULTIPLE if bundle else asked.functions[0]):
                continue
            for _ in range(number + 1):
                self._asked.popleft()
            self.unanswered += number
            if frame.direction is Direction.ERROR:
                return [] if bundle else [(frame.function, None)]
            return list(multiple(frame.payload, asked.functions)) if bundle else [(frame.function, frame.payload)]
        return []
