"""Read and write the drone's configuration, and set the drone up after each link loss. Pure.

``CONFIG`` writes a key, and is sent once the acknowledge bit in navdata is clear. The drone sets the bit on receiving
the command, even if it does not accept the value; ``CTRL 5`` clears the bit for the next command. ``CTRL 4`` makes the
drone send all keys over a TCP connection; :attr:`Configurator.wants_dump` requests that connection.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import Final, TypeAlias
from zlib import crc32

from skyloop.clock import nanoseconds
from skyloop.vehicles.ardrone.options import ArdroneOptions
from skyloop.vehicles.ardrone.wire.at import AtMessage, Ctrl
from skyloop.vehicles.ardrone.wire.configuration import END_OF_DUMP, format_value, parse_dump
from skyloop.vehicles.ardrone.wire.navdata import State

REPEAT_NS: Final = nanoseconds(0.15)  #: repeat interval of an unacknowledged CONFIG: over two periods of demo mode
REPEAT_DUMP_NS: Final = nanoseconds(0.3)  #: time between repeats of a request for the dump
MAX_DUMP: Final = 1 << 18  #: maximum accepted size of a dump in bytes; real dumps have about 5000
_CLEAR: Final[AtMessage] = ("CTRL", (int(Ctrl.CLEAR_ACK), 0))
_SEND_ALL: Final[AtMessage] = ("CTRL", (int(Ctrl.GET_CONFIGURATION), 0))


@dataclass(frozen=True, slots=True)
class Write:
    """A step that writes one key; the value is given as text."""

    key: str
    text: str


@dataclass(frozen=True, slots=True)
class Read:
    """A step that reads all keys back."""


Step: TypeAlias = Write | Read


@dataclass(eq=False)
class Exchange:
    """A sequence of steps, and a callback that is called at the end."""

    steps: Iterator[Step]  #: possibly a generator: each step is fetched after the previous one has finished
    deadline_ns: int  #: deadline for all steps together
    done: Callable[[str | None], None] = field(default=lambda _: None)  #: called at the end with the failure or None


@dataclass(frozen=True, slots=True)
class Ids:
    """The session, user and application ids on a drone with multi-configuration, eight hex digits each."""

    session: str
    profile: str
    application: str


class _Phase(Enum):
    IDLE = auto()
    CLEARING = auto()  # waiting for the previous acknowledgement to be cleared, so that a new one can be recognised
    ASKING = auto()
    SETTLING = auto()  # acknowledged; waiting for the bit to be cleared again


class Configurator:
    """Runs exchanges one at a time, in the order in which they are submitted."""

    def __init__(self) -> None:
        self.values: dict[str, str] = {}  #: the configuration as last read
        self.ids: Ids | None = None  #: ids to send before each CONFIG
        self.wants_dump = 0  #: number of the dump for which a connection to the control port is needed; 0 if none is
        self.trouble = ""  #: why the last dump failed
        self._queue: deque[Exchange] = deque()
        self._exchange: Exchange | None = None
        self._step: Step | None = None
        self._phase = _Phase.IDLE
        self._acknowledged = False  # the acknowledge bit as last received
        self._asked_ns = 0
        self._dumps = 0
        self._dump: bytearray | None = None  # bytes received so far; None if not connected

    @property
    def busy(self) -> bool:
        return self._exchange is not None or bool(self._queue)

    def submit(self, exchange: Exchange) -> None:
        self._queue.append(exchange)
        if self._exchange is None:
            self._next_exchange()

    def abandon(self, reason: str) -> None:
        """Fail every exchange with this reason and forget the configuration, as after a link loss."""
        self.values = {}
        exchanges = ([self._exchange] if self._exchange is not None else []) + list(self._queue)
        self._queue.clear()
        self._end_step()
        self._exchange = None
        for exchange in exchanges:
            exchange.done(reason)

    # Receiving ----------------------------------------------------------------------------------------------------

    def on_acknowledge(self, acknowledged: bool) -> bool:
        """Handle the acknowledge bit of the latest navdata; return whether a command must be sent at once."""
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
        """Begin a dump: the connection to the control port is open."""
        self._dump, self._asked_ns = bytearray(), 0

    def dump_received(self, data: bytes) -> bool:
        """Handle bytes from the control port; return whether the connection can be closed."""
        if self._dump is None or not isinstance(self._step, Read):
            return True
        self._dump += data
        if END_OF_DUMP not in self._dump:
            if len(self._dump) > MAX_DUMP:
                self.dump_failed(f"{len(self._dump)} bytes came over the control port without an end mark")
                return True
            return False
        self.values = parse_dump(bytes(self._dump))
        self.trouble = ""
        self._next_step()
        return True

    def dump_failed(self, reason: str) -> None:
        """Handle a connection that was refused or closed early; it is retried until the exchange's deadline."""
        self._dump = None
        self.trouble = reason

    # Sending ---------------------------------------------------------------------------------------------------

    def messages(self, now_ns: int) -> list[AtMessage]:
        """Return the commands to send now."""
        self._expire(now_ns)
        if self._phase is _Phase.CLEARING and not self._acknowledged:
            self._begin_asking()
        if self._phase is not _Phase.ASKING:
            return [_CLEAR] if self._acknowledged else []
        if isinstance(self._step, Write):
            return self._ask_write(self._step, now_ns)
        return self._ask_dump(now_ns)

    def _ask_write(self, step: Write, now_ns: int) -> list[AtMessage]:
        if not self._due(now_ns, REPEAT_NS):
            return []
        config: AtMessage = ("CONFIG", (step.key, step.text))
        if self.ids is None:
            return [config]
        return [("CONFIG_IDS", (self.ids.session, self.ids.profile, self.ids.application)), config]

    def _ask_dump(self, now_ns: int) -> list[AtMessage]:
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
        if self._exchange is None:  # unless the callback submitted another exchange
            self._next_exchange()


# Set-up --------------------------------------------------------------------------------------------------------------

_NEW_MOTHER_BOARD: Final = 32  #: lowest mother board version of an AR.Drone 2; those of an AR.Drone 1 go up to 17
_ID_KEYS: Final = {
    "session": "custom:session_id",
    "profile": "custom:profile_id",
    "application": "custom:application_id",
}


def version_of(configuration: Mapping[str, str]) -> int | None:
    """Return 1 or 2, based on the firmware version or, without it, the mother board; None if neither is known."""
    major = configuration.get("general:num_version_soft", "").partition(".")[0]
    if major.isdecimal() and int(major) >= 1:
        return 1 if int(major) == 1 else 2
    board = configuration.get("general:num_version_mb", "")
    if board.isdecimal():
        return 2 if int(board) >= _NEW_MOTHER_BOARD else 1
    return None


def own_ids(session: int) -> Ids:
    """Return Skyloop's ids. Application and user settings persist; session settings last as long as the session."""
    return Ids(
        session=f"{session & 0xFFFFFFFF:08x}",
        profile=f"{crc32(b'skyloop user'):08x}",
        application=f"{crc32(b'skyloop'):08x}",
    )


def ids_in_force(configuration: Mapping[str, str]) -> Ids | None:
    """Return the ids named in the drone's configuration; None for a drone without multi-configuration."""
    if not all(key in configuration for key in _ID_KEYS.values()):
        return None
    return Ids(**{name: configuration[key] for name, key in _ID_KEYS.items()})


class ArdroneSetup:
    """The steps that set up one drone, with our own ids and the keys ``remembered`` from before a link loss.

    Once the steps are done, ``version`` is known, unless the drone does not report it, and ``refused_ids`` is True if
    the drone did not accept our own settings. Remembered keys that the drone has since forgotten are written again.
    """

    def __init__(
        self, options: ArdroneOptions, configurator: Configurator, ids: Ids, remembered: Mapping[str, str]
    ) -> None:
        self.version = options.version
        self.refused_ids = False
        self._options = options
        self._configurator = configurator
        self._ids = ids
        self._remembered = remembered

    def steps(self, state: State) -> Iterator[Step]:
        """Yield the steps, given the drone's newest state bits; finish each step before fetching the next."""
        options, configurator = self._options, self._configurator
        in_demo = bool(state & State.DEMO)
        if state & State.BOOTSTRAP or in_demo is options.full:
            yield Write("general:navdata_demo", format_value(not options.full))
        yield Read()
        self.version = options.version or version_of(configurator.values)
        if options.ids and self.version == 2:
            yield from self._take_ids()
        if options.navdata_options is not None:
            yield from self._written({"general:navdata_options": str(options.navdata_options)})
        yield from self._written(self._remembered)

    def _take_ids(self) -> Iterator[Step]:
        configurator = self._configurator
        present = ids_in_force(configurator.values)
        if present is None:
            return
        configurator.ids = present
        for name, key in _ID_KEYS.items():
            wanted = getattr(self._ids, name)
            if getattr(configurator.ids, name) != wanted:
                yield Write(key, wanted)
                configurator.ids = replace(configurator.ids, **{name: wanted})
        if configurator.ids != present:
            yield Read()
            configurator.ids = ids_in_force(configurator.values)
            self.refused_ids = configurator.ids != self._ids

    def _written(self, wanted: Mapping[str, str]) -> Iterator[Step]:
        different = {key: text for key, text in wanted.items() if self._configurator.values.get(key, text) != text}
        for key, text in different.items():
            yield Write(key, text)
        if different:
            yield Read()
