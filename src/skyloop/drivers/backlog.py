"""Frames that arrived and are not decoded yet: which are decoded, shown and left out. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

LATE_NS: Final = 50_000_000  #: a frame that waited longer than this since it came is late
MAX_FRAMES: Final = 120  #: 4 s; key frames of the vehicles are half a second or a second apart


@dataclass(frozen=True, slots=True)
class Coded:
    """An encoded frame as it arrived."""

    data: object  #: what the vehicle's decoder takes
    is_key: bool  #: whether decoding can begin here
    captured_ns: int  #: on this host's clock
    arrived_ns: int
    connection: int  #: grows with each connection; a frame builds on none of another


class Backlog:
    """Frames in the order of arrival, at most :data:`MAX_FRAMES`. The newest wins.

    While frames are wanted and decoding keeps up, every frame is decoded and shown. When decoding is late, what stands
    before the newest key frame is left out; the rest must all be decoded, as each builds on the one before, but only
    the newest is shown. While no frame is wanted, those since the newest key frame are kept, so that one can be shown
    at once when somebody wants it.

    ``skipped`` counts the frames that were wanted and not shown because newer ones had arrived.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self._frames: deque[tuple[Coded, bool]] = deque()  # and whether it was wanted when it came

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, frame: Coded, *, wanted: bool) -> None:
        """Add a frame that arrived.

        Args:
            frame: The newest.
            wanted: Whether anybody wants frames now.
        """
        if frame.is_key and not wanted:
            self._drop(len(self._frames))
        elif len(self._frames) == MAX_FRAMES:
            self._drop(1)  # those that build upon it wait for the next key frame, as after any loss
        self._frames.append((frame, wanted))

    def take(self, now_ns: int) -> tuple[Coded, bool]:
        """Remove the frame to decode next.

        Args:
            now_ns: On the clock of ``arrived_ns``.

        Returns:
            The frame, and whether to show it.

        Raises:
            IndexError: There is none.
        """
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
