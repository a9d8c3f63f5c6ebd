"""The frames of the last seconds of one camera, so that tracking begins on the very frame a person drew on. Pure."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from skyloop.clock import nanoseconds, seconds
from skyloop.errors import RefusedError

if TYPE_CHECKING:
    from skyloop.client.frame import Arrival

KEPT_S: Final = 3.0  #: a picture that is older when its box comes is drawn again
KEPT_BYTES: Final = 64 * 1024 * 1024
#: While a tracker catches up it takes the newest frame that is no further than this from the one before.
STRIDE_S: Final = 0.07

_KEPT_NS: Final = nanoseconds(KEPT_S)
_STRIDE_NS: Final = nanoseconds(STRIDE_S)


class KeptFrames:
    """Frames as JPEGs, ordered by capture, the newest :data:`KEPT_S` or :data:`KEPT_BYTES` of them."""

    def __init__(self, most_bytes: int = KEPT_BYTES) -> None:
        """Keep nothing yet; at most ``most_bytes``."""
        self.bytes = 0  #: of all that are kept
        self._most_bytes = most_bytes
        self._frames: deque[Arrival] = deque()

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, arrival: Arrival) -> None:
        """Add a frame; one captured before the newest (a restarted proxy's) ends what was kept."""
        if self._frames and arrival.header.captured_ns <= self._frames[-1].header.captured_ns:
            self.clear()
        self._frames.append(arrival)
        self.bytes += arrival.header.size
        oldest_ns = arrival.header.captured_ns - _KEPT_NS
        while self._frames[0].header.captured_ns < oldest_ns or (
            self.bytes > self._most_bytes and len(self._frames) > 1
        ):
            self.bytes -= self._frames.popleft().header.size

    def clear(self) -> None:
        """Keep nothing of what came so far."""
        self._frames.clear()
        self.bytes = 0

    def find(self, captured_ns: int) -> Arrival:
        """Return the frame of that capture.

        Args:
            captured_ns: On the proxy's clock.

        Raises:
            RefusedError: It is not kept; the message says why.
        """
        for arrival in self._frames:
            if arrival.header.captured_ns == captured_ns:
                return arrival
        if not self._frames:
            raise RefusedError("there is no frame yet to begin on: draw the box again")
        oldest_ns, newest_ns = (self._frames[place].header.captured_ns for place in (0, -1))
        if oldest_ns < captured_ns < newest_ns:
            raise RefusedError("the frame that the box was drawn on did not arrive here: draw the box again")
        if captured_ns > newest_ns:
            raise RefusedError("the frame that the box was drawn on is newer than any that arrived here: draw it again")
        raise RefusedError(
            f"the picture was {seconds(newest_ns - captured_ns):.1f} s old when its box came, and the last "
            f"{seconds(newest_ns - oldest_ns):.1f} s are kept: draw the box again"
        )

    def next_after(self, captured_ns: int) -> Arrival | None:
        """Return the frame to track in next while catching up; None if there is none newer.

        It is the newest one that is at most :data:`STRIDE_S` after the last, or else the first one after it.

        Args:
            captured_ns: Capture of the last one.
        """
        best = None
        for arrival in self._frames:
            at_ns = arrival.header.captured_ns
            if at_ns <= captured_ns:
                continue
            if best is not None and at_ns > captured_ns + _STRIDE_NS:
                break
            best = arrival
        return best
