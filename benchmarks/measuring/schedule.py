"""The schedule: channels, periods, and absolute deadlines. Needs only the standard library."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

COMMAND: Final = "command"
FEEDBACK: Final = "feedback"
VIDEO: Final = "video"
CHANNELS: Final = (COMMAND, FEEDBACK, VIDEO)

#: The periods of the paper's experiment (Mellado-Bataller et al., IAS-12, 2013).
PACKET_PERIOD_S: Final = 0.03125
FRAME_PERIOD_S: Final = 0.0667
WARM_UP_S: Final = 0.4  #: not counted at the start of a turn, because a connection must first be set up
SETTLE_S: Final = 0.3  #: time for the last samples of a turn to arrive
_GOLDEN: Final = 0.618034  # the fractional parts of any number of its multiples are spread evenly


@dataclass(frozen=True, slots=True)
class Size:
    """The size of a raw frame with three bytes per pixel."""

    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width}×{self.height}"

    @property
    def frame_bytes(self) -> int:
        """Size of a frame in bytes."""
        return self.width * self.height * 3


SMALL: Final = Size(320, 240)
MIDDLE: Final = Size(640, 480)
LARGE: Final = Size(1920, 1080)
SIZES: Final = (SMALL, MIDDLE, LARGE)


@dataclass(frozen=True, slots=True)
class Turn:
    """All three channels at once for ``seconds``, after the warm-up.

    ``number`` shifts the channels against each other, so that over several turns they coincide in every way.
    """

    number: int
    seconds: float
    size: Size = SMALL
    frame_period_s: float = FRAME_PERIOD_S

    def period_s(self, channel: str) -> float:
        """Return the period of a channel [s]."""
        return self.frame_period_s if channel == VIDEO else PACKET_PERIOD_S

    def count(self, channel: str) -> int:
        """Return the number of samples of a channel sent after the warm-up."""
        return max(1, int(self.seconds / self.period_s(channel)))

    def deadlines_ns(self, channel: str, begin_ns: int) -> Iterator[int]:
        """Yield the sending times of a channel's samples, from the warm-up on [ns].

        Args:
            channel: The channel.
            begin_ns: When counting begins.
        """
        period_s = self.period_s(channel)
        phase = CHANNELS.index(channel) * (1 + self.number) * _GOLDEN % 1.0
        for index in range(-int(WARM_UP_S / period_s), self.count(channel)):
            yield begin_ns + round((index + phase) * period_s * 1e9)


def paced(
    deadlines_ns: Iterator[int],
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[None]:
    """Yield at each deadline; a late one does not shift the later ones.

    Args:
        deadlines_ns: Times on the clock.
        clock: Returns the time [ns].
        sleep: Sleeps for a number of seconds.
    """
    for deadline_ns in deadlines_ns:
        wait_ns = deadline_ns - clock()
        if wait_ns > 0:
            sleep(wait_ns / 1e9)
        yield


def sleep_until(at_ns: int) -> None:
    """Sleep until a time on the monotonic clock; return at once if it has passed."""
    time.sleep(max(0, at_ns - time.monotonic_ns()) / 1e9)
