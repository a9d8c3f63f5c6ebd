"""Which request is sent when: who the flight controller is, then its state, as fast as it answers. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.vehicles.msp.wire.frames import Direction, Frame
from skyloop.vehicles.msp.wire.messages import Function, multiple

PATIENCE_NS: Final = nanoseconds(0.5)  #: an answer that has not come by then is lost
TRIES: Final = 3

#: Takes the answer's payload; None: it does not know the function, or did not answer.
Handler = Callable[[bytes | None], None]


@dataclass(slots=True)
class Asked:
    """A request whose answer is waited for."""

    function: int
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
    """States that are asked for again and again, in one frame."""

    functions: tuple[int, ...]
    period_ns: int
    due_ns: int = 0

    @property
    def frame(self) -> Frame:
        """The request."""
        if len(self.functions) > 1:
            return Frame(Function.MULTIPLE, bytes(self.functions))
        return Frame(self.functions[0])


class Telemetry:
    """Asks for states at their rates, few at a time.

    A flight controller answers some tens of requests a second, whatever the line could carry: more would wait in its
    buffers, and so would the sticks behind them. The answer to ``MULTIPLE`` does not say what it holds, so there is one
    bundle only: an answer that was lost makes no other one be mistaken.

    Args:
        streams: Rates in hertz, by function.
        bundle: Functions that are asked for together, for firmware that knows ``MULTIPLE``; at the rate of the first.
        most: Requests that may be without an answer.
    """

    def __init__(self, streams: dict[int, float], bundle: tuple[int, ...] = (), *, most: int = 2) -> None:
        rates: dict[tuple[int, ...], float] = {
            (function,): rate for function, rate in streams.items() if function not in bundle
        }
        if bundle:
            rates = {bundle: streams[bundle[0]], **rates}
        self._streams = [Stream(functions, nanoseconds(1 / rate)) for functions, rate in rates.items()]
        self._bundle = bundle
        self._most = most
        self._asked: deque[Asked] = deque()
        self.unanswered = 0

    def drop(self, function: int) -> None:
        """No longer ask for a state: the firmware does not know it."""
        self._streams = [stream for stream in self._streams if stream.functions != (function,)]

    def forget(self) -> None:
        """Wait for no answer any more: they were lost with the connection."""
        self._asked.clear()

    def due_ns(self) -> int | None:
        """Return when something is to be asked for next; None: never."""
        return min((stream.due_ns for stream in self._streams), default=None)

    def requests(self, now_ns: int) -> list[Frame]:
        """Return what is to be sent now: what waits longest first."""
        while self._asked and now_ns - self._asked[0].sent_ns >= PATIENCE_NS:
            self._asked.popleft()
            self.unanswered += 1
        made: list[Frame] = []
        for stream in sorted(self._streams, key=lambda each: each.due_ns):
            if stream.due_ns > now_ns or len(self._asked) >= self._most:
                break
            stream.due_ns = max(stream.due_ns + stream.period_ns, now_ns)
            frame = stream.frame
            self._asked.append(Asked(frame.function, now_ns))
            made.append(frame)
        return made

    def on_frame(self, frame: Frame) -> list[tuple[int, bytes | None]]:
        """Handle a frame; returns the states that it answers, None in the place of one that is not known."""
        for number, asked in enumerate(self._asked):
            if frame.function != asked.function:
                continue
            for _ in range(number + 1):
                self._asked.popleft()
            self.unanswered += number
            if frame.function == Function.MULTIPLE:
                return [] if frame.direction is Direction.ERROR else list(multiple(frame.payload, self._bundle))
            return [(frame.function, None if frame.direction is Direction.ERROR else frame.payload)]
        return []
