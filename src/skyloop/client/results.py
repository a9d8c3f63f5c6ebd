"""Results of processors: one channel for each processor, and mailboxes in which the newest wins."""

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
MAX_CHANNELS: Final = 256  #: processors known at a time, besides subscribed ones
MAX_WORKERS: Final = 1024  #: workers of one processor whose last numbers are kept


class Result:
    """What a processor found in one frame. Times are on the proxy's clock [ns], as those of frames are."""

    __slots__ = ("_clock", "_history", "_offset_ns", "_value", "header", "overtaken", "received_ns")

    def __init__(
        self, header: ProcessorResult, received_ns: int, offset_ns: int, history: FeedbackHistory, clock: Clock
    ) -> None:
        """Keep what was received at ``received_ns``, on ``clock``, which is ``offset_ns`` behind the proxy's.

        ``history`` is looked up for the state at the capture. The value is decoded when it is first read.
        """
        self.header = header  #: the packet as received
        self.received_ns = received_ns  #: on this host's clock
        self.overtaken = False  #: a result of a later frame of the same camera came before it
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
        """Number of the application that made it, in this run of the proxy."""
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
        """When the frame was captured."""
        return self.header.captured_ns

    @property
    def made_ns(self) -> int:
        """When the processor had finished it."""
        return self.header.made_ns

    @property
    def took_s(self) -> float:
        """How long the processor worked on it [s]."""
        return self.header.took_ns / 1e9

    @property
    def age_s(self) -> float:
        """Time since the frame's capture [s]."""
        return (self._clock() + self._offset_ns - self.header.captured_ns) / 1e9

    @property
    def value(self) -> Any:
        """What ``process`` returned, with dataclasses as dicts, tuples as lists, and arrays read-only.

        Raises:
            DecodeError: If the payload is malformed, as only another program can send it.
        """
        if self._value is _UNREAD:
            self._value = unpack(self.header.payload)
        return self._value

    def to(self, kind: type[T]) -> T:
        """Return the value as a dataclass, ``msgspec.Struct`` or other type.

        Raises:
            DecodeError: If it can't be converted.
        """
        try:
            return msgspec.convert(self.value, kind, dec_hook=_as_it_is)
        except (msgspec.ValidationError, TypeError) as error:
            raise DecodeError(f"a result of {self.processor} is no {kind.__name__}: {error}") from None

    @property
    def feedback(self) -> Feedback | None:
        """The vehicle's state at the frame's capture, interpolated; None if nothing is known of that time."""
        return self._history.at(self.header.captured_ns)[0]

    def __repr__(self) -> str:
        header = self.header
        return f"<Result of {header.processor} for {header.camera} {header.seq}, {self.age_s * 1e3:.0f} ms old>"


def _as_it_is(kind: type, value: Any) -> Any:  # noqa: ARG001  (as msgspec calls it)
    return value


class ResultMailbox:
    """Keeps the newest result of each processor for one consumer, and leaves out those that are too old when taken."""

    def __init__(self, max_age_s: float | None = None, notifier: Notifier | None = None) -> None:
        """Make an empty mailbox, which leaves out what is older than ``max_age_s`` [s] when it is taken."""
        self.notifier = notifier or Notifier()
        self.expired = 0  #: results that were too old when their turn came
        self.closed = False
        self._max_age_s = max_age_s
        self._mailboxes: dict[str, Mailbox[Result]] = {}

    def put(self, result: Result) -> None:
        """Add a result, on the receiving thread alone. One that was overtaken is ignored."""
        if result.overtaken:
            return  # counted by its channel
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
        """Take the oldest of the waiting results, one for each processor; None if there is none. Does not wait."""
        while waiting := [mailbox for mailbox in self._mailboxes.values() if mailbox.waiting]:
            result = min(waiting, key=_captured_ns).take()
            if result is None or not is_old(result, self._max_age_s):
                return result
            self.expired += 1
        return None

    def wait(self, timeout_s: float) -> Result | None:
        """Take a result like :meth:`take`, but wait for one; None if none comes in ``timeout_s`` or it is closed."""
        deadline = time.monotonic() + timeout_s
        while self.notifier.wait_for(lambda: self.waiting or self.closed, deadline - time.monotonic()):
            result = None if self.closed else self.take()
            if result is not None or self.closed:
                return result
        return None

    def close(self) -> None:
        """Wake everybody who waits here; nothing can be waited for any more."""
        self.closed = True
        self.notifier.notify()

    @property
    def waiting(self) -> bool:
        """Whether there is a result, possibly too old."""
        return any(mailbox.waiting for mailbox in self._mailboxes.values())

    @property
    def pushed_out(self) -> int:
        """Results that newer ones pushed out."""
        return self.dropped - self.expired

    @property
    def dropped(self) -> int:
        """Results that newer ones pushed out, or that were too old."""
        return self.expired + sum(mailbox.dropped for mailbox in self._mailboxes.values())


def is_old(result: Result, max_age_s: float | None) -> bool:
    """Return whether a result is now older than ``max_age_s``; False for None."""
    return max_age_s is not None and result.age_s > max_age_s


class ResultListener(Listener[Result]):
    """A listener that leaves out results that are too old when their turn comes, counted in ``expired``."""

    def __init__(self, *arguments: Any, max_age_s: float | None, **options: Any) -> None:
        """Start calling; arguments are those of :class:`Listener`, and ``max_age_s`` [s], None for no limit."""
        self.expired = 0  #: results that were too old when their turn came
        self._max_age_s = max_age_s
        super().__init__(*arguments, **options)

    @property
    def dropped(self) -> int:
        """Results that newer ones pushed out, or that were too old."""
        return super().dropped + self.expired

    def _call(self, sample: Result) -> None:
        if is_old(sample, self._max_age_s):
            self.expired += 1
        else:
            super()._call(sample)


class ResultChannel(Channel[Result]):
    """Results of one processor; leaves out a result of an older frame than one that came before."""

    def __init__(self, processor: str, connection: ProxyConnection, scheduler: Scheduler) -> None:
        self.name = results(processor)  #: name of the topic
        super().__init__(lambda on: connection.subscribe(self.name, on))
        self.newest: Result | None = None
        self.notifier = scheduler.notifier()  #: notified with each result
        self.counter = ChannelCounter()
        self._overtaken = 0
        self._numbers: dict[int, int] = {}  # last number of each worker
        self._captured: dict[str, int] = {}  # capture time of the newest frame of each camera

    def restart(self) -> None:
        """Forget the numbers of workers and frames, which a newly connected proxy counts from the start."""
        self._numbers.clear()
        self._captured.clear()

    def stats(self, now_ns: int) -> ChannelStats:
        """Return the statistics at ``now_ns``; overtaken results count as dropped."""
        return self.counter.stats(now_ns, dropped=self.dropped + self._overtaken)

    def receive(self, result: Result) -> bool:
        """Publish a result, unless it was overtaken; return False if it came before, by the other topic."""
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
    """The channels of all processors. Asked for on any thread; results arrive on the receiving one."""

    def __init__(self, connection: ProxyConnection, scheduler: Scheduler, history: FeedbackHistory) -> None:
        self._connection = connection
        self.everything: Channel[Result] = Channel(lambda on: connection.subscribe(RESULTS, on))
        self._scheduler = scheduler
        self._history = history
        self._lock = threading.Lock()
        self._channels: dict[str, ResultChannel] = {}
        self._sent: Counter[str] = Counter()

    def channel(self, processor: str) -> ResultChannel:
        """Return the channel of a processor's results, whether or not such a processor runs.

        Raises:
            UsageError: If ``processor`` can't be a name.
            ClosedError: If the drone was closed.
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
        """Return all channels."""
        return list(self._channels.values())

    def next_number(self, processor: str) -> int:
        """Return the number of the next result that this application sends, for one worker of a processor at a time."""
        self._sent[processor] += 1
        return self._sent[processor]

    def restart(self) -> None:
        """Reset all channels: a proxy was connected."""
        for channel in self.all():
            channel.restart()

    def receive(self, header: ProcessorResult, now_ns: int) -> None:
        """Publish a result that came at ``now_ns``."""
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
        """Forget channels without consumers, oldest first, while there are too many: any program may invent names."""
        with self._lock:
            unused = [name for name, one in self._channels.items() if not one.subscribed]
            surplus = len(self._channels) + 1 - MAX_CHANNELS
            for name in unused[: max(0, surplus)]:
                self._channels = {known: one for known, one in self._channels.items() if known != name}


def _captured_ns(mailbox: Mailbox[Result]) -> int:
    newest = mailbox.peek()
    return 0 if newest is None else newest.captured_ns


def silence(processor: str, timeout_s: float, expired: int) -> str:
    """Return the message of the error when no result came, with how many were too old meanwhile."""
    if expired:
        return f"no result of {processor} came within {timeout_s:g} s that was new enough; {expired} were too old"
    return (
        f"no result of processor {processor} came within {timeout_s:g} s: does skyloop process run one of that name "
        "for this drone?"
    )
