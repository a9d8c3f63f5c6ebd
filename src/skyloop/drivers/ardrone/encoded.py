"""The pictures of an AR.Drone 2 as they come, for whoever records them."""

from __future__ import annotations

from collections.abc import Callable

from skyloop.drivers.backlog import Coded
from skyloop.drivers.base import Sink
from skyloop.messages import Intrinsics
from skyloop.messages.encoded import Chain
from skyloop.wire.ardrone.pave import Codec, FrameType, PaveFrame


class EncodedStream:
    """Hands H.264 on while somebody wants it, from a key picture on, and after damage from the next one on.

    Whether pictures are decoded as well makes no difference. Belongs to the thread that reads.
    """

    def __init__(
        self, sink: Sink, camera: Callable[[], str], intrinsics: Callable[[int, int], Intrinsics | None]
    ) -> None:
        """``camera()``: which one the drone shows now; ``intrinsics(width, height)``: of that one."""
        self._sink = sink
        self._camera = camera
        self._intrinsics = intrinsics
        self._chain = Chain()
        self._source: tuple[str, int] | None = None  # camera and connection of the picture before

    def take(self, coded: Coded) -> None:
        """A frame that came whole."""
        frame = coded.data
        camera = self._camera()
        if not isinstance(frame, PaveFrame) or frame.codec != Codec.MPEG4_AVC or not self._sink.wants_stream(camera):
            self._source = None
            return
        source = camera, coded.connection
        if frame.after_damage or source != self._source:
            self._chain.restart()
        self._source = source
        if self._chain.follows(frame.number, key=frame.is_key) and frame.type != FrameType.HEADERS:
            self._sink.stream(
                camera,
                frame.payload,
                coded.captured_ns,
                width=frame.width,
                height=frame.height,
                key=frame.is_key,
                intrinsics=self._intrinsics(frame.width, frame.height),
            )
