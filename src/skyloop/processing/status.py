"""Statistics of a worker: counts since it started, and rates and ages of the last second."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Final

import msgspec

from skyloop.clock import NS_PER_S, Clock
from skyloop.messages import ProcessorShare

_KEPT: Final = 1024  #: newest results and frames that are kept for rates and ages
#: Summed over several workers.
_SUMS: Final = ("frames", "results", "dropped", "stale", "errors", "refused", "unsent", "frames_hz", "results_hz")


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """Statistics of one worker, or of several of one processor together.

    Counts are since the start; rates and ages are of the last second.
    """

    processor: str
    camera: str
    processes: int = 1  #: workers that these statistics cover
    part: int = 0  #: which part of the frames it takes; 0 for several workers
    parts: int = 0  #: of how many parts, 0: none now; for several workers: how many of them take a part
    workers: int = 0  #: of this processor and camera that the proxy knows
    frames: int = 0  #: frames of its part
    results: int = 0
    dropped: int = 0  #: frames that newer ones replaced before it was ready
    stale: int = 0  #: frames that were too old when their turn came
    errors: int = 0  #: calls of ``process`` that raised
    refused: int = 0  #: results that can't be sent
    unsent: int = 0  #: results that could not be handed to the transport
    frames_hz: float = 0.0
    results_hz: float = 0.0
    age_s: float | None = None  #: median time from a frame's capture to its result
    age_max_s: float | None = None
    took_s: float | None = None  #: median duration of ``process``

    def __str__(self) -> str:
        share = f"part {self.part + 1} of {self.parts}" if self.parts else "no part now"
        if self.processes > 1:
            share = f"{self.parts} of {self.processes} processes at work"
        age = "–" if self.age_s is None or self.age_max_s is None else f"{_ms(self.age_s)} (max {_ms(self.age_max_s)})"
        parts = [
            f"{self.processor} {self.camera}",
            share,
            f"{self.frames_hz:.1f} frames/s",
            f"{self.results_hz:.1f} results/s",
            f"age {age}",
            f"dropped {self.dropped}",
            f"too old {self.stale}",
            f"errors {self.errors}",
            *([f"not sendable {self.refused}"] if self.refused else []),
            *([f"not sent {self.unsent}"] if self.unsent else []),
        ]
        return "  ".join(parts)


def together(found: Iterable[Status]) -> Status | None:
    """Combine the statistics of several workers of one processor; None for none.

    Counts and rates are summed. Ages are the worst of all.
    """
    each = list(found)
    if len(each) < 2:
        return each[0] if each else None
    ages = [one.age_s for one in each if one.age_s is not None]
    longest = [one.age_max_s for one in each if one.age_max_s is not None]
    sums = {name: sum(getattr(one, name) for one in each) for name in _SUMS}
    return Status(
        processor=each[0].processor,
        camera=each[0].camera,
        processes=len(each),
        parts=sum(one.parts > 0 for one in each),
        workers=max(one.workers for one in each),
        age_s=max(ages, default=None),
        age_max_s=max(longest, default=None),
        **sums,
    )


class Tally:
    """Counts what one worker does. One thread counts frames, one results; any may read."""

    def __init__(self, clock: Clock) -> None:
        self.frames = self.results = self.stale = self.errors = self.refused = self.unsent = 0
        self._clock = clock
        self._came: deque[int] = deque(maxlen=_KEPT)
        self._made: deque[tuple[int, float, float]] = deque(maxlen=_KEPT)  # when, age [s], took [s]

    def came(self) -> None:
        """Count a frame of its part; on the receiving thread."""
        self.frames += 1
        self._came.append(self._clock())

    def made(self, age_s: float, took_s: float) -> None:
        """Count a result that was published.

        Args:
            age_s: From the frame's capture until now [s].
            took_s: Duration of ``process`` [s].
        """
        self.results += 1
        self._made.append((self._clock(), age_s, took_s))

    def status(self, processor: str, camera: str, share: ProcessorShare | None, dropped: int) -> Status:
        """Return the present statistics.

        Args:
            processor: Name of the processor.
            camera: Name of the camera.
            share: Share of the frames; None while it is not known.
            dropped: Frames that newer ones replaced.
        """
        since_ns = self._clock() - NS_PER_S
        made = [one for one in self._made.copy() if one[0] > since_ns]
        ages, took = sorted(age for _, age, _ in made), sorted(took for _, _, took in made)
        return Status(
            processor=processor,
            camera=camera,
            part=share.part if share is not None else 0,
            parts=share.parts if share is not None else 0,
            workers=share.workers if share is not None else 0,
            frames=self.frames,
            results=self.results,
            dropped=dropped,
            stale=self.stale,
            errors=self.errors,
            refused=self.refused,
            unsent=self.unsent,
            frames_hz=float(sum(at_ns > since_ns for at_ns in self._came.copy())),
            results_hz=float(len(made)),
            age_s=ages[len(ages) // 2] if ages else None,
            age_max_s=ages[-1] if ages else None,
            took_s=took[len(took) // 2] if took else None,
        )


def _ms(value: float) -> str:
    return f"{value * 1e3:.0f} ms"
