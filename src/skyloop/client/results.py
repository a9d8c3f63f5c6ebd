"""Receive the results of processors: one channel per processor, and newest-wins mailboxes."""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import Any, Final, TypeVar

import msgspec

from skyloop.client.channels import Channel, Listener, Mailbox, Notifier, checked_name
from skyloop.client.connection import ProxyConnection, Scheduler
from skyloop.client.frame import FeedbackHistory
from skyloop.client.monitoring import ChannelCounter, ChannelStats
from skyloop.clock import Clock
from skyloop.errors import DecodeError
from skyloop.messages import Feedback, ProcessorResult
from skyloop.messages.relayed import unpack
from skyloop.transport.base import RESULTS, results

T = TypeVar("T")
_UNREAD: Final = object()
MAX_CHANNELS: Final = 256  #: maximum number of processors to remember without a subscription
MAX_WORKERS: Final = 1024  #: maximum number of workers per processor whose last number is remembered


class Result:
    """A processor's result for one frame. Times are on the proxy's clock [ns], like those of frames."""

    __slots__ = ("_clock", "_history", "_offset_ns", "_value", "header", "overtaken", "received_ns")

    def __init__(
        self, header: ProcessorResult, received_ns: int, offset_ns: int, history: FeedbackHistory, clock: Clock
    ) -> None:
        """Store a result received at ``received_ns`` on ``clock``; adding ``offset_ns`` gives the proxy's time.

        ``history`` provides the vehicle's state at the time of capture. The value is decoded on first access.
        """
        self.header = header  #: packet as received
        self.received_ns = received_ns  #: on this host's clock
        self.overtaken = False  #: whether a result for a later frame of the same camera arrived earlier
        self._offset_ns = offset_ns
        self._history = history
        self._clock = clock
        self._value: Any = _UNREAD

    @property
    def processor(self) -> str:
        """Name of the processor."""
        return self.header.processor

    @property
    def worker(self) -> int:
        """Number of the application that produced the result, in this run of the proxy."""
        return self.header.worker

    @property
    def camera(self) -> str:
        """Name of the frame's camera."""
        return self.header.camera

    @property
    def seq(self) -> int:
        """Number of the frame."""
        return self.header.seq

    @property
    def captured_ns(self) -> int:
        """Time at which the frame was captured."""
        return self.header.captured_ns

    @property
    def made_ns(self) -> int:
        """Time at which the processor finished the result."""
        return self.header.made_ns

    @property
    def took_s(self) -> float:
        """Processing time [s]."""
        return self.header.took_ns / 1e9

    @property
    def age_s(self) -> float:
        """Time since the frame's capture [s]."""
        return (self._clock() + self._offset_ns - self.header.captured_ns) / 1e9

    @property
    def value(self) -> Any:
        """The value that ``process`` returned, with dataclasses as dicts, tuples as lists, and read-only arrays.

        Raises :class:`DecodeError` if the payload is malformed, which can only happen if another program sent it.
        """
        if self._value is _UNREAD:
            self._value = unpack(self.header.payload)
        return self._value

    def to(self, kind: type[T]) -> T:
        """Convert the value to a dataclass, ``msgspec.Struct`` or other type; raise :class:`DecodeError` on failure."""
        try:
            return msgspec.convert(self.value, kind, dec_hook=lambda _kind, value: value)  # arrays stay as they are
        except (msgspec.ValidationError, TypeError) as error:
            raise DecodeError(f"a result of {self.processor} is not a {kind.__name__}: {error}") from None

    @property
    def feedback(self) -> Feedback | None:
        """The vehicle's state at the time of capture, interpolated; None if unknown."""
        return self._history.at(self.header.captured_ns)[0]

    def __repr__(self) -> str:
        header = self.header
        return f"<Result of {header.processor} for {header.camera} {header.seq}, {self.age_s * 1e3:.0f} ms old>"


class ResultMailbox:
    """Keeps the newest result of each processor for one consumer, and skips those that are too old when taken."""

    def __init__(self, max_age_s: float | None = None, notifier: Notifier | None = None) -> None:
        """Create an empty mailbox. Results older than ``max_age_s`` [s] are skipped when results are taken."""
        self.notifier = notifier or Notifier()
        self.expired = 0  #: number of results that were too old when they would have been taken
        self.closed = False
        self._max_age_s = max_age_s
        self._mailboxes: dict[str, Mailbox[Result]] = {}

    def put(self, result: Result) -> None:
        """Add a result. Must be called on the receiving thread. Results that arrive after newer ones are ignored."""
        if result.overtaken:
            return  # its channel counts it
        mailbox = self._mailboxes.get(result.processor)
        if mailbox is None:
            mailbox = Mailbox(1, self.notifier)
            known = {**self._mailboxes, result.processor: mailbox}
            if len(known) > MAX_CHANNELS:
                oldest = known.pop(next(iter(known)))
                self.expired += oldest.dropped + oldest.waiting
            self._mailboxes = known
        mailbox.put(result)

    def take(self) -> Result | None:
        """Remove and return the oldest waiting result (one per processor); None if there is none. Never waits."""
        while waiting := [mailbox for mailbox in self._mailboxes.values() if mailbox.waiting]:
            result = min(waiting, key=_captured_ns).take()
            if result is None or not is_old(result, self._max_age_s):
                return result
            self.expired += 1
        return None

    def wait(self, timeout_s: float) -> Result | None:
        """Wait for a result and take it; return None after ``timeout_s`` or once the mailbox is closed."""
        deadline = time.monotonic() + timeout_s
        while self.notifier.wait_for(lambda: self.waiting or self.closed, deadline - time.monotonic()):
            result = None if self.closed else self.take()
            if result is not None or self.closed:
                return result
        return None

    def close(self) -> None:
        """Wake all waiting threads and make later waits return immediately."""
        self.closed = True
        self.notifier.notify()

    @property
    def waiting(self) -> bool:
        """Whether a result is waiting, even if it is too old."""
        return any(mailbox.waiting for mailbox in self._mailboxes.values())

    @property
    def pushed_out(self) -> int:
        """Number of results replaced by newer ones."""
        return self.dropped - self.expired

    @property
    def dropped(self) -> int:
        """Number of results that were replaced by newer ones or were too old."""
        return self.expired + sum(mailbox.dropped for mailbox in self._mailboxes.values())


def is_old(result: Result, max_age_s: float | None) -> bool:
    """Return whether a result is older than ``max_age_s`` now; always False if ``max_age_s`` is None."""
    return max_age_s is not None and result.age_s > max_age_s


class ResultListener(Listener[Result]):
    """A listener that skips results that are too old when delivered, and counts them in ``expired``."""

    def __init__(self, *arguments: Any, max_age_s: float | None, **options: Any) -> None:
        """Start calling the function, but skip results older than ``max_age_s``; for the rest see :class:`Listener`."""
        self.expired = 0  #: number of results too old when they would have been delivered
        self._max_age_s = max_age_s
        super().__init__(*arguments, **options)

    @property
    def dropped(self) -> int:
        """Number of results that were replaced by newer ones or were too old."""
        return super().dropped + self.expired

    def _call(self, sample: Result) -> None:
        if is_old(sample, self._max_age_s):
            self.expired += 1
        else:
            super()._call(sample)


class ResultChannel(Channel[Result]):
    """Results of one processor; a result that arrives after one for a later frame of its camera is skipped."""

    def __init__(self, processor: str, connection: ProxyConnection, scheduler: Scheduler) -> None:
        self.name = results(processor)  #: name of the topic
        super().__init__(lambda on: connection.subscribe(self.name, on))
        self.newest: Result | None = None
        self.notifier = scheduler.notifier()  #: notified of each result
        self.counter = ChannelCounter()
        self._overtaken = 0
        self._numbers: dict[int, int] = {}  # number of the last result from each worker
        self._captured: dict[str, int] = {}  # capture time of the newest frame of each camera

    def restart(self) -> None:
        """Forget the numbers of workers and frames, because a newly connected proxy starts new ones."""
        self._numbers.clear()
        self._captured.clear()

    def stats(self, now_ns: int) -> ChannelStats:
        """Return the statistics at ``now_ns``; results that arrived after newer ones count as dropped."""
        return self.counter.stats(now_ns, dropped=self.dropped + self._overtaken)

    def receive(self, result: Result) -> bool:
        """Publish a result unless one for a later frame was; return False if it already came on the other topic."""
        header = result.header
        last = self._numbers.get(header.worker)
        if last is not None and header.number <= last:
            return False
        if last is not None:
            self.counter.lost += header.number - last - 1
        self._numbers[header.worker] = header.number
        if len(self._numbers) > MAX_WORKERS:
            del self._numbers[next(iter(self._numbers))]
        result.overtaken = header.captured_ns < self._captured.get(header.camera, header.captured_ns)
        if result.overtaken:
            self._overtaken += 1
        else:
            self._captured[header.camera] = header.captured_ns
            self.newest = result
            self.publish(result)
            self.notifier.notify()
        return True


class ResultChannels:
    """The channels of all processors. Thread-safe; results arrive on the receiving thread."""

    def __init__(self, connection: ProxyConnection, scheduler: Scheduler, history: FeedbackHistory) -> None:
        self._connection = connection
        self.everything: Channel[Result] = Channel(lambda on: connection.subscribe(RESULTS, on))
        self._scheduler = scheduler
        self._history = history
        self._lock = threading.Lock()
        self._channels: dict[str, ResultChannel] = {}
        self._sent: Counter[str] = Counter()

    def channel(self, processor: str) -> ResultChannel:
        """Return the channel of a processor's results, even if no such processor is running.

        Raises :class:`UsageError` if the name is invalid, and :class:`ClosedError` if the drone was closed.
        """
        self._connection.check_open()
        return self._made(checked_name(processor))

    def _made(self, processor: str) -> ResultChannel:
        with self._lock:
            found = self._channels.get(processor)
            if found is None:
                found = ResultChannel(processor, self._connection, self._scheduler)
                self._channels = {**self._channels, processor: found}
            return found

    def all(self) -> list[ResultChannel]:
        return list(self._channels.values())

    def next_number(self, processor: str) -> int:
        """Return the number of the next result; this application may run only one worker per processor."""
        self._sent[processor] += 1
        return self._sent[processor]

    def restart(self) -> None:
        """Reset all channels after connecting to a proxy."""
        for channel in self.all():
            channel.restart()

    def receive(self, header: ProcessorResult, now_ns: int) -> None:
        offset_ns = self._connection.offset_ns
        result = Result(header, now_ns, offset_ns, self._history, self._scheduler.clock)
        channel = self._channels.get(header.processor)
        if channel is None:
            self._make_room()
            channel = self._made(header.processor)
        if channel.receive(result):
            channel.counter.add(now_ns + offset_ns - header.made_ns, header.captured_ns - offset_ns, now_ns)
            self.everything.publish(result)

    def _make_room(self) -> None:
        """If there are too many channels, forget those without consumers, oldest first: programs may invent names."""
        with self._lock:
            unused = [name for name, one in self._channels.items() if not one.subscribed]
            surplus = len(self._channels) + 1 - MAX_CHANNELS
            for name in unused[: max(0, surplus)]:
                self._channels = {known: one for known, one in self._channels.items() if known != name}


def _captured_ns(mailbox: Mailbox[Result]) -> int:
    newest = mailbox.peek()
    return 0 if newest is None else newest.captured_ns


def silence(processor: str, timeout_s: float, expired: int) -> str:
    """Return the error message for missing results, including how many results were too old."""
    if expired:
        return f"no sufficiently new result of {processor} arrived within {timeout_s:g} s; {expired} were too old"
    return (
        f"no result of processor {processor} arrived within {timeout_s:g} s: does skyloop process run one of that name "
        "for this drone?"
    )
