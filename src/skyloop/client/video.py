"""Encoded video: pictures as they come, put together from their packets, and decoded on a thread of its own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np

from skyloop.client.channels import Channel
from skyloop.clock import Clock
from skyloop.messages import EncodedFrame, FrameHeader, StreamReport, encode
from skyloop.messages.encoded import H264, Chain, Pieces
from skyloop.pyav import new_decoder
from skyloop.transport.base import Pixels

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

    from skyloop.client.connection import ProxyConnection

#: Pictures that may wait to be decoded. With more, decoding is too slow for what comes: they are left out up to a key.
MOST_WAITING: Final = 6
ASK_AGAIN_NS: Final = 300_000_000  #: how long to wait for a key picture before it is asked for again
_IDLE_S: Final = 2.0
_PURPOSE: Final = "reading H.264"


class StreamChannel(Channel[EncodedFrame]):
    """The pictures of one stream, whole, in the order in which they came; some may be missing.

    Args:
        topic: The stream's.
        connection: What it comes through.
        clock: This process's clock [ns].
    """

    def __init__(self, topic: str, connection: ProxyConnection, clock: Clock) -> None:
        super().__init__(lambda on: connection.subscribe(topic, on))
        self.topic = topic
        self.decoder: StreamDecoder | None = None  #: for frames that were asked for as H.264
        self._connection = connection
        self._clock = clock
        self._encoded_here = "?" in topic  # by the proxy, which wants to know what came
        self._pieces = Pieces()
        self._asked_ns = -ASK_AGAIN_NS

    def receive(self, part: EncodedFrame) -> None:
        """Take what came, on the receiving thread."""
        picture = self._pieces.add(part)
        if picture is None:
            return
        if self.decoder is not None and self._connection.variants:  # else frames come as they are
            self.decoder.put(picture)
        self.publish(picture)

    def report(self, seq: int, *, wants_key: bool = False) -> None:
        """Tell the proxy what was received, which a rate that follows the path needs. Any thread.

        Args:
            seq: The newest picture.
            wants_key: It can't be decoded, as one before it is missing; asked at most some times a second.
        """
        if not self._encoded_here:
            return
        if wants_key:
            now_ns = self._clock()
            wants_key = now_ns - self._asked_ns >= ASK_AGAIN_NS
            if wants_key:
                self._asked_ns = now_ns
        self._connection.transmit(encode(StreamReport(self.topic, seq, wants_key)))


class StreamDecoder:
    """Decodes one stream on a thread of its own, in order. What can't be decoded is left out up to a key picture.

    Args:
        stream: The pictures.
        deliver: Called with each decoded picture on the decoder's thread: its header, its pixels in BGR, and when it
            came.
        clock: This process's clock [ns].
        name: Of the thread.
    """

    def __init__(
        self, stream: StreamChannel, deliver: Callable[[FrameHeader, Pixels, int], None], clock: Clock, name: str
    ) -> None:
        self.dropped = 0  #: pictures that came and were not shown: after a gap, damaged, or too many at once
        self._stream = stream
        self._deliver = deliver
        self._clock = clock
        self._name = name
        self._changed = threading.Condition()
        self._waiting: deque[tuple[EncodedFrame, int]] = deque()
        self._chain = Chain()
        self._running = False
        self._context: VideoCodecContext | None = None

    def put(self, picture: EncodedFrame) -> None:
        """Take a picture, on the receiving thread."""
        with self._changed:
            follows = picture.codec == H264 and self._chain.follows(picture.seq, key=picture.key)
            if picture.key:  # nothing before it is of use any more
                self.dropped += len(self._waiting)
                self._waiting.clear()
            elif follows and len(self._waiting) >= MOST_WAITING:
                self._chain.restart()
                follows = False
            if follows:
                self._waiting.append((picture, self._clock()))
                if not self._running:
                    self._running = True
                    threading.Thread(target=self._run, name=self._name, daemon=True).start()
                self._changed.notify()
            else:
                self.dropped += 1
        if not follows:
            self._stream.report(picture.seq, wants_key=True)

    def _run(self) -> None:
        while (taken := self._next()) is not None:
            picture, came_ns = taken
            pixels = self._decode(picture)
            if pixels is None:
                self._leave_out()
                self._stream.report(picture.seq, wants_key=True)
                continue
            self._stream.report(picture.seq)
            height, width = pixels.shape[:2]
            header = picture.decoded(width, height)
            self._deliver(header, pixels.reshape(-1), came_ns)

    def _next(self) -> tuple[EncodedFrame, int] | None:
        with self._changed:
            if self._changed.wait_for(lambda: bool(self._waiting), _IDLE_S):
                return self._waiting.popleft()
            self._running = False  # what comes after a silence of the path still follows: the decoder stays
            return None

    def _leave_out(self) -> None:
        """Leave out a damaged picture and those that build on it."""
        with self._changed:
            self.dropped += 1
            while self._waiting and not self._waiting[0][0].key:
                self._waiting.popleft()
                self.dropped += 1
            if not self._waiting:
                self._chain.restart()

    def _decode(self, picture: EncodedFrame) -> Pixels | None:
        """Return the image, BGR; None for one that is damaged."""
        import av

        if self._context is None or picture.key:
            self._context = new_decoder(H264, _PURPOSE)
        try:
            images = self._context.decode(av.Packet(picture.data))
            image = images[-1] if images else None
            if image is None or image.is_corrupt:
                return None
            pixels = np.ascontiguousarray(image.to_ndarray(format="bgr24"), dtype=np.uint8)
        except (av.error.FFmpegError, ValueError):
            return None
        pixels.flags.writeable = False
        return pixels
