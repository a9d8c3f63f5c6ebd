"""How samples get from the receiving thread to the application's own functions, each at its own pace."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Final, Generic, Protocol, Self, TypeVar

from skyloop.client.slots import Buffer
from skyloop.messages import EventKind, Severity

T = TypeVar("T")

#: Told that an application's function raised: where, and what.
Report = Callable[[str, Exception], None]


class Tell(Protocol):
    """Makes an event of the client's own; ``data`` are its particulars."""

    def __call__(self, kind: EventKind, text: str, severity: Severity = Severity.WARNING, **data: str) -> None: ...


JOIN_S: Final = 2.0  #: how long the end of a function that is running is waited for
_REPORT_EVERY_S: Final = 1.0
_log = logging.getLogger("skyloop")


class Topic(Generic[T]):
    """Consumers of one kind of sample. ``on_change(wanted)`` is called when the first comes and the last goes."""

    def __init__(self, on_change: Callable[[bool], None] | None = None) -> None:
        self._sinks: tuple[Callable[[T], None], ...] = ()
        self._drops: dict[Callable[[T], None], Callable[[], int]] = {}
        self._dropped_before = 0  # by consumers that are gone
        self._lock = threading.Lock()
        self._on_change = on_change

    def add(self, sink: Callable[[T], None], dropped: Callable[[], int]) -> None:
        """Deliver to this function too, on the publishing thread; ``dropped`` tells what its consumer missed."""
        with self._lock:
            self._drops[sink] = dropped
            first = not self._sinks
            self._sinks = (*self._sinks, sink)
            if first and self._on_change is not None:
                self._on_change(True)

    def remove(self, sink: Callable[[T], None]) -> None:
        """Deliver there no longer. Does nothing if it is not there."""
        with self._lock:
            if sink not in self._drops:
                return
            self._dropped_before += self._drops.pop(sink)()
            left = tuple(known for known in self._sinks if known != sink)
            self._sinks = left
            if not left and self._on_change is not None:
                self._on_change(False)

    @property
    def dropped(self) -> int:
        """Samples that any consumer missed, those who are gone included."""
        with self._lock:
            return self._dropped_before + sum(dropped() for dropped in self._drops.values())

    def publish(self, sample: T) -> None:
        """Hand to every consumer. No lock is held while they take it."""
        for sink in self._sinks:
            sink(sample)


class Listener(Generic[T]):
    """An application's function that is called with what comes; ends with :meth:`cancel` or as a context manager.

    The function has a thread of its own and a buffer of the newest ``depth`` samples, so that however slow it is, it
    gets new samples and costs nobody else anything. ``inline=True``: it is called on the link's receiving thread,
    before anybody else gets the next sample, which is fastest; it must be quick and must not wait.
    What it raises is counted, logged and reported as an event, and it is called again with the next sample.
    """

    def __init__(
        self,
        function: Callable[[T], object],
        topic: Topic[T],
        report: Report,
        *,
        name: str,
        depth: int = 1,
        inline: bool = False,
        on_cancel: Callable[[Listener[T]], None] | None = None,
    ) -> None:
        self.name = name
        self.errors = 0  #: calls that raised
        self._function = function
        self._topic = topic
        self._report = report
        self._on_cancel = on_cancel
        self._calls = 0
        self._next_report_s = 0.0
        self._buffer: Buffer[T] = Buffer(depth)
        self._sink = self._call if inline else self._buffer.put
        self._thread = None if inline else threading.Thread(target=self._run, name=f"skyloop-{name}", daemon=True)
        if self._thread is not None:
            self._thread.start()
        topic.add(self._sink, lambda: self.dropped)

    @property
    def delivered(self) -> int:
        """Samples with which the function was called."""
        return self._calls

    @property
    def dropped(self) -> int:
        """Samples that newer ones pushed out before the function was ready for them."""
        return self._buffer.dropped

    def cancel(self, *, wait: bool = True) -> None:
        """Call the function no more; waits (at most two seconds) for a call that is under way. Idempotent."""
        self._topic.remove(self._sink)
        self._buffer.close()
        if self._on_cancel is not None:
            self._on_cancel(self)
        thread = self._thread
        if wait and thread is not None and thread is not threading.current_thread():
            thread.join(JOIN_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.cancel()

    def _run(self) -> None:
        buffer = self._buffer
        while not buffer.closed:
            sample = buffer.wait()
            if sample is not None:
                self._call(sample)

    def _call(self, sample: T) -> None:
        self._calls += 1
        try:
            self._function(sample)
        except Exception as error:  # noqa: BLE001  (an application's function may raise anything)
            self.errors += 1
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        now_s = time.monotonic()
        if now_s < self._next_report_s:
            return  # one that fails at every frame is told once a second; ``errors`` counts them all
        self._next_report_s = now_s + _REPORT_EVERY_S
        _log.error("%s raised %r (%d times so far)", self.name, error, self.errors, exc_info=error)
        self._report(self.name, error)


#: A listener to frames. Each has its own thread, its own slot of the newest frame, and its own count of drops.
Processor = Listener
