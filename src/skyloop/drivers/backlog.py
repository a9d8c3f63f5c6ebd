"""Frames that came and are not decoded yet: what is decoded, what is shown and what is left out. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

LATE_NS: Final = 50_000_000  #: a frame that waited longer than this since it came is late
MAX_FRAMES: Final = 120  #: 4 s; key frames of the vehicles are half a second or a second apart


@dataclass(frozen=True, slots=True)
class Coded:
    """A frame as it came."""

    data: object  #: what the vehicle's decoder takes
    is_key: bool  #: whether decoding can begin here
    captured_ns: int  #: on this host's clock
    arrived_ns: int
    connection: int  #: grows with each connection; a frame builds on none of another


class Backlog:
    """Frames in the order of their coming, at most :data:`MAX_FRAMES`. The newest wins.

    While pictures are wanted and decoding keeps up, every frame is decoded and shown. When it is late, what stands
    before the newest key frame is left out, and of the rest, which must all be decoded as each builds on the one
    before, only the newest is shown. While no picture is wanted the frames since the newest key frame are kept, so
    that a picture can be shown at once when one is.

    ``skipped`` counts the frames that were wanted and not shown because newer ones were there.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self._frames: deque[tuple[Coded, bool]] = deque()  # and whether it was wanted when it came

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, frame: Coded, *, wanted: bool) -> None:
        """A frame came."""
        if frame.is_key and not wanted:
            self._drop(len(self._frames))
        elif len(self._frames) == MAX_FRAMES:
            self._drop(1)  # those that build upon it wait for the next key frame, as after any loss
        self._frames.append((frame, wanted))

    def take(self, now_ns: int) -> tuple[Coded, bool]:
        """The frame to decode next, and whether to show it. Raises IndexError if there is none."""
        if self._late(now_ns):
            keys = [n for n, (frame, _) in enumerate(self._frames) if frame.is_key]
            self._drop(keys[-1] if keys else 0)
        show = len(self._frames) == 1 or not self._late(now_ns)
        frame, wanted = self._frames.popleft()
        self.skipped += wanted and not show
        return frame, show

    def _late(self, now_ns: int) -> bool:
        return now_ns - self._frames[0][0].arrived_ns > LATE_NS

    def _drop(self, count: int) -> None:
        for _ in range(count):
            _, wanted = self._frames.popleft()
            self.skipped += wanted
