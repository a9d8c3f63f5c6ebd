"""The drone's configuration: keys written with their acknowledgement, and all of them read back. Pure.

A key is written by ``CONFIG`` once the acknowledge bit of navdata is clear; the drone sets the bit when it took the
command (which says nothing of the value), and ``CTRL 5`` clears it for the next. All keys are read by ``CTRL 4``, to
which the drone answers on a TCP connection: :attr:`Configurator.wants_dump` asks for one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Final, TypeAlias

from skyloop.clock import nanoseconds
from skyloop.drivers.ardrone.sender import Message
from skyloop.wire.ardrone.at import Ctrl
from skyloop.wire.ardrone.configuration import END_OF_DUMP, parse_dump

REPEAT_NS: Final = nanoseconds(0.15)  #: of a CONFIG without acknowledgement; two periods of the demo mode
REPEAT_DUMP_NS: Final = nanoseconds(0.3)
MAX_DUMP: Final = 1 << 18  #: bytes; real ones have about 5000
_CLEAR: Final[Message] = ("CTRL", (int(Ctrl.CLEAR_ACK), 0))
_SEND_ALL: Final[Message] = ("CTRL", (int(Ctrl.GET_CONFIGURATION), 0))


@dataclass(frozen=True, slots=True)
class Write:
    """A key and its value as text."""

    key: str
    text: str


@dataclass(frozen=True, slots=True)
class Read:
    """All keys, read back."""


Step: TypeAlias = Write | Read


@dataclass(eq=False)
class Exchange:
    """Steps in order, with a time by which all must be done; ``done`` is called at the end with the failure or None.

    The steps may be a generator: each is asked for when the one before is done.
    """

    steps: Iterator[Step]
    deadline_ns: int
    done: Callable[[str | None], None] = field(default=lambda _: None)


@dataclass(frozen=True, slots=True)
class Ids:
    """Whose settings are in force on a drone that keeps them apart (multi-configuration): eight hex digits each."""

    session: str
    profile: str
    application: str


class _Phase(Enum):
    IDLE = auto()
    CLEARING = auto()  # the acknowledgement of something before, so that a new one is seen
    ASKING = auto()
    SETTLING = auto()  # acknowledged: until the bit is clear again


class Configurator:
    """Does one exchange after the other."""

    def __init__(self) -> None:
        self.values: dict[str, str] = {}  #: as last read
        self.ids: Ids | None = None  #: to be named before each CONFIG
        self.wants_dump = 0  #: number of the dump for which a connection to the control port is needed; 0: none
        self.trouble = ""  #: why no dump came lately
        self._queue: deque[Exchange] = deque()
        self._exchange: Exchange | None = None
        self._step: Step | None = None
        self._phase = _Phase.IDLE
        self._acknowledged = False  # the bit as last heard
        self._asked_ns = 0
        self._dumps = 0
        self._dump: bytearray | None = None  # None: not connected

    @property
    def busy(self) -> bool:
        return self._exchange is not None or bool(self._queue)

    def submit(self, exchange: Exchange) -> None:
        """Do this after what is in line already."""
        self._queue.append(exchange)
        if self._exchange is None:
            self._next_exchange()

    def abandon(self, reason: str) -> None:
        """The drone is away: all exchanges fail, and nothing that was read counts any more."""
        self.values = {}
        exchanges = ([self._exchange] if self._exchange is not None else []) + list(self._queue)
        self._queue.clear()
        self._end_step()
        self._exchange = None
        for exchange in exchanges:
            exchange.done(reason)

    # What is heard ---------------------------------------------------------------------------------------------

    def heard(self, acknowledged: bool) -> bool:
        """The acknowledge bit of the newest navdata. Whether there is something to say at once."""
        self._acknowledged = acknowledged
        if self._phase is _Phase.CLEARING and not acknowledged:
            self._begin_asking()
        elif self._phase is _Phase.ASKING and acknowledged and isinstance(self._step, Write):
            self._phase = _Phase.SETTLING
        elif self._phase is _Phase.SETTLING and not acknowledged:
            self._next_step()
        else:
            return False
        return True

    def dump_opened(self) -> None:
        """The control port is connected."""
        self._dump, self._asked_ns = bytearray(), 0

    def dump_received(self, data: bytes) -> bool:
        """Some bytes came over the control port; whether that was all."""
        if self._dump is None or not isinstance(self._step, Read):
            return True
        self._dump += data
        if END_OF_DUMP not in self._dump:
            if len(self._dump) > MAX_DUMP:
                self.dump_failed(f"{len(self._dump)} bytes came over the control port, and no end")
                return True
            return False
        self.values = parse_dump(bytes(self._dump))
        self.trouble = ""
        self._next_step()
        return True

    def dump_failed(self, reason: str) -> None:
        """The control port refused, or closed before the end: it is tried again until the exchange's deadline."""
        self._dump = None
        self.trouble = reason

    # What is said ----------------------------------------------------------------------------------------------

    def messages(self, now_ns: int) -> list[Message]:
        """What is to be said now."""
        self._expire(now_ns)
        if self._phase is _Phase.CLEARING and not self._acknowledged:
            self._begin_asking()
        if self._phase is not _Phase.ASKING:
            return [_CLEAR] if self._acknowledged else []
        if isinstance(self._step, Write):
            return self._ask_write(self._step, now_ns)
        return self._ask_dump(now_ns)

    def _ask_write(self, step: Write, now_ns: int) -> list[Message]:
        if not self._due(now_ns, REPEAT_NS):
            return []
        config: Message = ("CONFIG", (step.key, step.text))
        if self.ids is None:
            return [config]
        return [("CONFIG_IDS", (self.ids.session, self.ids.profile, self.ids.application)), config]

    def _ask_dump(self, now_ns: int) -> list[Message]:
        if self._dump is None or self._dump or not self._due(now_ns, REPEAT_DUMP_NS):
            return []
        return [_SEND_ALL]

    def _due(self, now_ns: int, period_ns: int) -> bool:
        if self._asked_ns and now_ns - self._asked_ns < period_ns:
            return False
        self._asked_ns = now_ns
        return True

    # Exchanges and steps ---------------------------------------------------------------------------------------

    def _expire(self, now_ns: int) -> None:
        for exchange in [*self._queue]:
            if now_ns > exchange.deadline_ns:
                self._queue.remove(exchange)
                exchange.done("the drone was busy with other settings")
        if self._exchange is not None and now_ns > self._exchange.deadline_ns:
            self._finish(self._failure())

    def _failure(self) -> str:
        if isinstance(self._step, Write):
            return f"the drone did not acknowledge {self._step.key}"
        why = f": {self.trouble}" if self.trouble else ""
        return f"the drone's configuration could not be read{why}"

    def _next_exchange(self) -> None:
        if self._queue:
            self._exchange = self._queue.popleft()
            self._next_step()

    def _next_step(self) -> None:
        assert self._exchange is not None
        self._end_step()
        step = next(self._exchange.steps, None)
        if step is None:
            self._finish(None)
            return
        self._step, self._phase, self._asked_ns = step, _Phase.CLEARING, 0

    def _begin_asking(self) -> None:
        self._phase = _Phase.ASKING
        if isinstance(self._step, Read):
            self._dumps += 1
            self.wants_dump = self._dumps

    def _end_step(self) -> None:
        self._step, self._phase, self.wants_dump, self._dump = None, _Phase.IDLE, 0, None

    def _finish(self, failure: str | None) -> None:
        exchange = self._exchange
        assert exchange is not None
        self._end_step()
        self._exchange = None
        exchange.done(failure)
        if self._exchange is None:  # unless it submitted another one
            self._next_exchange()
