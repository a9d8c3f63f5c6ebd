"""What is measured in one turn, and the processes that take part."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, Protocol

PACKET_BYTES = 100  #: of the bare hand-over: about what a command or feedback packet takes
STARTS_WITHIN_S = 30.0
ENDS_WITHIN_S = 5.0


class Pipe(Protocol):
    """A duplex ``multiprocessing`` connection."""

    def send(self, obj: Any, /) -> None: ...
    def recv(self) -> Any: ...
    def poll(self, timeout: float | None = 0.0, /) -> bool: ...


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel to measure. ``width`` 0: a packet; else a raw frame of that size with three bytes a pixel."""

    name: str
    period_s: float
    width: int = 0
    height: int = 0

    @property
    def frame_bytes(self) -> int:
        return self.width * self.height * 3


#: The periods are those of the paper's experiment (Mellado-Bataller et al., IAS-12, 2013); 1080p is ours.
COMMAND = Channel("command", 0.03125)
FEEDBACK = Channel("feedback", 0.03125)
VIDEO_SMALL = Channel("video 320×240", 0.0667, 320, 240)
VIDEO_LARGE = Channel("video 1920×1080", 0.0667, 1920, 1080)
CHANNELS = (COMMAND, FEEDBACK, VIDEO_SMALL, VIDEO_LARGE)


def paced(count: int, period_s: float, sleep: Callable[[float], None] = time.sleep) -> Iterator[int]:
    """Yield ``count`` numbers at absolute deadlines; a late one does not shift those after it."""
    begin = time.monotonic()
    for index in range(count):
        wait = begin + (index + 1) * period_s - time.monotonic()
        if wait > 0:
            sleep(wait)
        yield index


class Workers:
    """Processes with a pipe each; ``None`` on the pipe ends a worker, and so does the end of this process."""

    def __init__(self, context: SpawnContext) -> None:
        self._context = context
        self._running: list[tuple[SpawnProcess, Pipe]] = []

    def start(self, work: Callable[..., None], *arguments: Any) -> Pipe:
        """Start ``work(pipe, *arguments)`` and wait until it says that it is ready."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=work, args=(theirs, *arguments), daemon=True)
        process.start()
        theirs.close()
        self._running.append((process, ours))
        if not ours.poll(STARTS_WITHIN_S) or ours.recv() != "ready":
            self.close()
            raise TimeoutError(f"the measuring process {work.__module__}.{work.__name__} did not start")
        return ours

    def close(self) -> None:
        for process, pipe in self._running:
            with contextlib.suppress(OSError):  # it ended already
                pipe.send(None)
            process.join(ENDS_WITHIN_S if process.is_alive() else 0)
            if process.is_alive():
                process.kill()
        self._running.clear()
