"""What processors find, as it arrives: one channel a processor, and slots in which the newest wins."""

from __future__ import annotations

import math
import re
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from skyloop.client.delivery import Listener, Topic
from skyloop.client.slots import Bell, Buffer
from skyloop.client.statistics import ChannelCounter
from skyloop.clock import Clock
from skyloop.errors import DecodeError, UsageError
from skyloop.messages import Feedback, ProcessorResult
from skyloop.messages.payload import unpack
from skyloop.messages.result import PROCESSOR_NAME
from skyloop.transport.base import RESULTS, results

if TYPE_CHECKING:
    from skyloop.client.history import FeedbackHistory
    from skyloop.client.link import Link
    from skyloop.client.pace import Pace

T = TypeVar("T")
_UNREAD: Final = object()


class Result:
    """What a processor found in one frame. Times are on the proxy's clock [ns], as those of frames are."""

    __slots__ = ("_clock", "_history", "_offset_ns", "_value", "header", "overtaken", "received_ns")

    def __init__(
        self, header: ProcessorResult, received_ns: int, offset_ns: int, history: FeedbackHistory, clock: Clock
    ) -> None:
        self.header = header  #: as it came
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
        """The camera of the frame."""
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
        """When the processor was done with it."""
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
        """What ``process`` returned: dataclasses as dicts, tuples as lists, arrays read-only. Raises
        :class:`DecodeError` for a payload that is none, as only somebody else's program can send."""
        if self._value is _UNREAD:
            self._value = unpack(self.header.payload)
        return self._value

    def to(self, kind: type[T]) -> T:
        """The value as a dataclass, ``msgspec.Struct`` or other type. Raises :class:`DecodeError` if it is none."""
        try:
            return msgspec.convert(self.value, kind, dec_hook=_as_it_is)
        except (msgspec.ValidationError, TypeError) as error:
            raise DecodeError(f"a result of {self.processor} is no {kind.__name__}: {error}") from None

    @property
    def feedback(self) -> Feedback | None:
        """The vehicle's state when the frame was captured, interpolated; None if nothing is known of that time."""
        return self._history.at(self.header.captured_ns)[0]

    def __repr__(self) -> str:
        header = self.header
        return f"<Result of {header.processor} for {header.camera} {header.seq}, {self.age_s * 1e3:.0f} ms old>"


def _as_it_is(kind: type, value: Any) -> Any:  # noqa: ARG001  (as msgspec calls it)
    return value


class ResultSlot:
    """The newest result of each processor, to be taken by one thread; those that are too old by then are left out."""

    def __init__(self, max_age_s: float | None = None, bell: Bell | None = None) -> None:
        self.bell = bell or Bell()
        self.expired = 0  #: results that were too old when their turn came
        self.closed = False
        self._max_age_s = max_age_s
        self._buffers: dict[str, Buffer[Result]] = {}

    def put(self, result: Result) -> None:
        """Offer one; on the receiving thread alone."""
        if result.overtaken:
            return  # counted by its channel
        buffer = self._buffers.get(result.processor)
        if buffer is None:
            buffer = Buffer(1, self.bell)
            self._buffers = {**self._buffers, result.processor: buffer}
        buffer.put(result)

    def take(self) -> Result | None:
        """The oldest of those that wait, one a processor; None if there is none. Does not wait."""
        while waiting := [buffer for buffer in self._buffers.values() if buffer.waiting]:
            result = min(waiting, key=_captured_ns).take()
            if result is None or not is_old(result, self._max_age_s):
                return result
            self.expired += 1
        return None

    def wait(self, timeout_s: float) -> Result | None:
        """Like :meth:`take`, but waits; None if nothing came in time or it was closed."""
        deadline = time.monotonic() + timeout_s
        while self.bell.wait_for(lambda: self.waiting or self.closed, deadline - time.monotonic()):
            result = None if self.closed else self.take()
            if result is not None or self.closed:
                return result
        return None

    def close(self) -> None:
        """Let nobody wait here any more."""
        self.closed = True
        self.bell.ring()

    @property
    def waiting(self) -> bool:
        """Whether there is one to take, maybe too old."""
        return any(buffer.waiting for buffer in self._buffers.values())

    @property
    def dropped(self) -> int:
        """How many newer ones pushed out, or were too old."""
        return self.expired + sum(buffer.dropped for buffer in self._buffers.values())


def is_old(result: Result, max_age_s: float | None) -> bool:
    """Whether it is past a consumer's limit now."""
    return max_age_s is not None and result.age_s > max_age_s


class ResultListener(Listener[Result]):
    """A listener that leaves out what is older than its limit when its turn comes; ``expired`` counts that."""

    def __init__(self, *arguments: Any, max_age_s: float | None, **options: Any) -> None:
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


class ResultChannel:
    """What one processor finds. ``topic`` has no result of a frame that is older than one that came before."""

    def __init__(self, processor: str, link: Link, pace: Pace) -> None:
        self.processor = processor
        self.newest: Result | None = None
        self.bell = pace.bell()
        self.counter = ChannelCounter()
        self.overtaken = 0
        self.topic: Topic[Result] = Topic(lambda on: link.subscribe(results(processor), on or self.keep))
        self.keep = False  #: subscribed for good, by ``result()``
        self._link = link
        self._numbers: dict[int, int] = {}  # the last one of each worker
        self._captured: dict[str, int] = {}  # the newest frame of each camera

    @property
    def name(self) -> str:
        """The topic's name."""
        return results(self.processor)

    def keep_newest(self) -> None:
        """Subscribe for good."""
        if not self.keep:
            self.keep = True
            self._link.subscribe(self.name)

    def restart(self) -> None:
        """A proxy was connected: numbers of workers mean something else now."""
        self._numbers.clear()
        self._captured.clear()

    def arrived(self, result: Result) -> bool:
        """Take one in; False if it came before, by the other topic."""
        header = result.header
        last = self._numbers.get(header.worker)
        if last is not None and header.number <= last:
            return False
        if last is not None:
            self.counter.lost += header.number - last - 1
        self._numbers[header.worker] = header.number
        result.overtaken = header.captured_ns < self._captured.get(header.camera, header.captured_ns)
        if result.overtaken:
            self.overtaken += 1
        else:
            self._captured[header.camera] = header.captured_ns
            self.newest = result
            self.topic.publish(result)
            self.bell.ring()
        return True


class ResultChannels:
    """The channels of all processors. Asked for on any thread; results arrive on the receiving one."""

    def __init__(self, pace: Pace, history: FeedbackHistory) -> None:
        self.link: Link
        self.everything: Topic[Result] = Topic(lambda on: self.link.subscribe(RESULTS, on))
        self._pace = pace
        self._history = history
        self._lock = threading.Lock()
        self._channels: dict[str, ResultChannel] = {}
        self._sent: Counter[str] = Counter()

    def channel(self, processor: str) -> ResultChannel:
        """The one of this processor, from now on."""
        with self._lock:
            found = self._channels.get(processor)
            if found is None:
                found = ResultChannel(processor, self.link, self._pace)
                self._channels = {**self._channels, processor: found}
            return found

    def all(self) -> list[ResultChannel]:
        return list(self._channels.values())

    def next_number(self, processor: str) -> int:
        """For a result that this application sends itself; one worker of a processor at a time."""
        self._sent[processor] += 1
        return self._sent[processor]

    def restart(self) -> None:
        """A proxy was connected."""
        for channel in self.all():
            channel.restart()

    def arrived(self, header: ProcessorResult, now_ns: int) -> None:
        """A result came."""
        offset_ns = self.link.offset_ns
        result = Result(header, now_ns, offset_ns, self._history, self._pace.clock)
        channel = self._channels.get(header.processor) or self.channel(header.processor)
        if channel.arrived(result):
            channel.counter.add(now_ns + offset_ns - header.made_ns, header.captured_ns - offset_ns, now_ns)
            self.everything.publish(result)


def _captured_ns(buffer: Buffer[Result]) -> int:
    newest = buffer.peek()
    return 0 if newest is None else newest.captured_ns


def checked_name(processor: str) -> str:
    """Raises :class:`UsageError` for what can't be the name of a processor."""
    if not isinstance(processor, str) or not re.fullmatch(PROCESSOR_NAME, processor):
        raise UsageError(f"the name of a processor has 1 to 64 letters, digits and any of _ . -, not {processor!r:.80}")
    return processor


def checked_age(max_age_s: float | None) -> float | None:
    """Raises :class:`UsageError` for what can't be a limit of age [s]."""
    if max_age_s is not None and (not isinstance(max_age_s, int | float) or math.isnan(max_age_s) or max_age_s < 0):
        raise UsageError(f"max_age_s is {max_age_s!r} and must be a number of seconds")
    return max_age_s
