"""Decide which of a live stream's frames to decode and show, and which to forward undecoded."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.drivers.base import Sink
from skyloop.drivers.h264 import Unit
from skyloop.messages import EventKind, Intrinsics, Severity
from skyloop.messages.frame import Chain

LATE_NS: Final = 50_000_000  #: a frame that has waited longer than this is late
MAX_FRAMES: Final = 120  #: 4 s of video; the vehicles' key frames are half a second or a second apart
KEYLESS: Final = 600  #: number of pictures without a key picture after which a stream is reported as not forwardable


@dataclass(frozen=True, slots=True)
class Coded:
    """An encoded frame on arrival."""

    data: object  #: input for the vehicle's decoder
    is_key: bool  #: whether decoding can start here
    captured_ns: int  #: capture time, on this host's clock
    arrived_ns: int
    connection: int  #: increases with each connection; frames never refer to those of another connection


class FrameBacklog:
    """Keeps at most :data:`MAX_FRAMES` frames in order of arrival. The newest wins.

    While frames are wanted and decoding keeps up, every frame is decoded and shown. When decoding is late, frames
    before the newest key frame are dropped; the rest must all be decoded, as each refers to the previous one, but only
    the newest is shown. While no frames are wanted, those since the newest key frame are kept, so that the first
    subscriber gets an image at once.

    ``skipped`` counts wanted frames that were not shown because newer ones had arrived.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self._frames: deque[tuple[Coded, bool]] = deque()  # frames, and whether each was wanted on arrival

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, frame: Coded, *, wanted: bool) -> None:
        """Add a received frame."""
        if frame.is_key and not wanted:
            self._drop(len(self._frames))
        elif len(self._frames) == MAX_FRAMES:
            self._drop(1)  # frames that refer to it are lost up to the next key frame, as after any loss
        self._frames.append((frame, wanted))

    def take(self, now_ns: int) -> tuple[Coded, bool]:
        """Remove and return the frame to decode next.

        Args:
            now_ns: The present time, on the clock of ``arrived_ns``.

        Returns:
            The frame, and whether to show it.

        Raises:
            IndexError: The backlog is empty.
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


class StreamRelay:
    """Forwards H.264 while it is wanted, starting with a key picture, and restarting with one after a gap.

    Whether pictures are also decoded makes no difference. Not thread-safe.
    """

    def __init__(self, sink: Sink, intrinsics: Callable[[str, int, int], Intrinsics | None]) -> None:
        self._sink = sink
        self._intrinsics = intrinsics
        self._chain = Chain()
        self._source: tuple[str, int] | None = None  # camera and connection of the previous picture

    def wanted(self, camera: str) -> bool:
        """Return whether a camera's stream is wanted. If not, it will restart with a key picture."""
        wanted = self._sink.wants_stream(camera)
        if not wanted:
            self.restart()
        return wanted

    def restart(self) -> None:
        """Restart with the next key picture."""
        self._source = None

    def take(
        self,
        camera: str,
        unit: Unit,
        captured_ns: int,
        *,
        number: int,
        connection: int,
        picture: bool = True,
    ) -> bool:
        """Forward a picture if it is wanted and can be decoded after the last one.

        Args:
            camera: The camera whose video the vehicle is sending.
            unit: The picture, undamaged.
            captured_ns: Capture time, the same as in the decoded frame.
            number: Number of the picture within the connection; pictures left out cause gaps.
            connection: Number of the connection.
            picture: False if there are only parameters, which are not forwarded.

        Returns:
            Whether the picture was forwarded.
        """
        if not self.wanted(camera):
            return False
        source = camera, connection
        if unit.after_gap or source != self._source:
            self._chain.restart()
        self._source = source
        if not self._chain.follows(number, key=unit.is_key) or not picture:
            return False
        self._sink.stream(
            camera,
            unit.data,
            captured_ns,
            width=unit.width,
            height=unit.height,
            key=unit.is_key,
            intrinsics=self._intrinsics(camera, unit.width, unit.height),
        )
        return True


class CheckedRelay:
    """Forwards the H.264 of a camera whose stream is not known in advance; if it can't, reports once why.

    Not thread-safe.
    """

    def __init__(self, relay: StreamRelay, sink: Sink, camera: str, where: str) -> None:
        self._relay = relay
        self._sink = sink
        self._camera = camera
        self._where = where
        self._refused = (-1, "")  # number of the connection, and the reason
        self._waited = 0
        self._reported = ""

    @property
    def wanted(self) -> bool:
        """Whether the stream is wanted."""
        return self._relay.wanted(self._camera)

    def take(self, unit: Unit | None, reason: str, captured_ns: int, *, number: int, connection: int) -> None:
        """Forward an undamaged picture; see :meth:`StreamRelay.take`.

        Args:
            unit: The picture; None if its headers are unknown.
            reason: Why it can't be forwarded, for the rest of the connection; empty if it can.
            captured_ns: Capture time, the same as in the decoded frame.
            number: Number of the picture within the connection.
            connection: Number of the connection.
        """
        if not self.wanted:
            return
        if reason:
            self._refused = connection, reason
        if self._refused[0] == connection:
            self._report(self._refused[1])
            return
        taken = unit is not None and self._relay.take(
            self._camera, unit, captured_ns, number=number, connection=connection
        )
        self._waited = 0 if taken else self._waited + 1
        if self._waited == KEYLESS:
            self._report(f"{KEYLESS} pictures without a key picture (IDR) with parameters: configure the encoder")

    def _report(self, why: str) -> None:
        if why != self._reported:
            self._reported = why
            text = f"{self._where}: {why}: only decoded frames are available, not the original stream"
            self._sink.event(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, where=self._where)
