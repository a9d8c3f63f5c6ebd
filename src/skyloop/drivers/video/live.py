"""Live video that PyAV opens, from the network or a device, for :class:`skyloop.drivers.live_video.LiveVideo`.

Every error of opening and reading is an OSError that says why in words.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from skyloop.clock import Clock, nanoseconds
from skyloop.drivers.backlog import Coded
from skyloop.drivers.live_clock import LiveClock
from skyloop.drivers.live_video import Decoded
from skyloop.drivers.pave_decoder import av, limit_memory
from skyloop.errors import UnsupportedError

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.codeccontext import VideoCodecContext

HOPELESS_S: Final = 3.0  #: how long nothing can be decoded before it is reported
#: How many pictures FFmpeg holds back: where one ends shows when the next begins, and a transport stream's packets end
#: in the same way once more.
_HELD_BACK: Final = {"rtsp": 1, "h264": 1, "hevc": 1, "mpegts": 2}
_REORDERED_NS: Final = 1_000_000_000  # a step back of the stamps up to this is one of B pictures, not a clock set back
_NO_STAMPS: Final[Any] = av.format.Flags.no_timestamps.value


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """A picture's bytes, and what it takes to decode them and to know when they were captured."""

    packet: av.Packet[av.VideoStream]
    context: VideoCodecContext  # of its connection
    number: int  # of the connection, from 0
    offset_ns: int | None  # from the stream's stamps to this host's clock; None: it has no stamps


class ContainerStream:
    """One connection to whatever PyAV opens.

    Args:
        name: What FFmpeg opens: an address or a path.
        connection: Its number.
        clock: Monotonic, ns.
        format_name: FFmpeg's format; None: it finds out.
        options: FFmpeg's.
        open_s: For the connection, the handshake and the size of the pictures, all together; a device that hangs takes
            longer.
        read_s: For the next picture. FFmpeg can't be interrupted earlier, so :meth:`read` takes up to this.

    Raises:
        OSError: It can't be opened, or holds no video that is known here.
    """

    broken = 0  # FFmpeg does not report what it throws away
    lost_bytes = 0

    def __init__(
        self,
        name: str,
        connection: int,
        clock: Clock,
        *,
        format_name: str | None = None,
        options: dict[str, str],
        open_s: float,
        read_s: float,
    ) -> None:
        self._connection = connection
        self._clock = clock
        self._read_s = read_s
        begun_ns = clock()
        try:
            self._container: InputContainer = av.open(
                name, format=format_name, options=options, timeout=(open_s, read_s)
            )
        except Exception as error:
            if clock() - begun_ns >= nanoseconds(open_s):  # which FFmpeg takes for damage, in the midst of a handshake
                raise TimeoutError(f"no answer, or no frame, within {open_s:g} s") from error
            raise _os_error(error) from error
        try:
            self._context, self._packets = self._chosen()
        except BaseException:
            self._container.close()
            raise
        held_back = _HELD_BACK.get(self._container.format.name, 0)
        self._came: deque[int] = deque(maxlen=held_back + 1)  # when FFmpeg gave the last ones
        self._number = 0
        self._live_clock = LiveClock()
        self._newest_ns: int | None = None  # stamp
        self._offset_ns = 0

    def read(self) -> list[Coded]:
        """Return the next picture, as a list of one.

        Raises:
            OSError: The stream ended, failed, or gave nothing for ``read_s``.
        """
        try:
            packet = next(self._packets, None)
        except av.error.ExitError as error:
            raise TimeoutError(f"nothing came for {self._read_s:g} s") from error
        except Exception as error:
            raise _os_error(error) from error
        if packet is None or not packet.size:
            raise ConnectionError("the stream ended")
        now_ns = self._clock()
        self._came.append(now_ns)
        offset_ns = self._offset(packet)
        stamp_ns = _stamp_ns(packet)
        piece = Piece(packet, self._context, self._number, offset_ns)
        self._number += 1
        captured_ns = self._came[0] if offset_ns is None or stamp_ns is None else stamp_ns + offset_ns
        is_key = packet.is_keyframe or self._context.codec.intra_only
        return [Coded(piece, is_key, captured_ns, now_ns, self._connection)]

    def close(self) -> None:
        """Close the connection."""
        self._container.close()

    def _chosen(self) -> tuple[VideoCodecContext, Iterator[av.Packet[av.VideoStream]]]:
        """Return the first video, ready to be read and decoded."""
        videos = self._container.streams.video
        if not videos:
            raise ConnectionError("what comes holds no video")
        context = videos[0].codec_context
        if context is None:
            raise ConnectionError("what comes is in a codec that is not known here")
        if not (context.width and context.height):
            raise ConnectionError("the stream has no frame size: it is damaged, or no video")
        limit_memory(context)
        return context, self._container.demux(videos[0])

    def _offset(self, packet: av.Packet[av.VideoStream]) -> int | None:
        """Return the offset from the stream's stamps to the clock: the smallest seen lately."""
        stamp_ns = _stamp_ns(packet)
        if stamp_ns is None or self._container.format.flags & _NO_STAMPS:
            return None
        if self._newest_ns is None or not 0 < self._newest_ns - stamp_ns < _REORDERED_NS:
            self._newest_ns = stamp_ns
            self._offset_ns = self._live_clock.captured_ns(stamp_ns / 1e9, self._came[0]) - stamp_ns
        return self._offset_ns


class LiveDecoder:
    """Decodes one connection after the other.

    FFmpeg itself leaves out what comes before the first key picture.
    """

    def __init__(self) -> None:
        self.waited = 0
        self.damaged = 0
        self._before: Piece | None = None
        self._failing_ns: int | None = None  # since when no piece could be decoded
        self._shown = 0

    def restart(self) -> None:
        """Forget the stream so far: the next picture does not continue it."""
        self._before = None
        self._failing_ns = None

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        """See :class:`skyloop.drivers.live_video.Decoder`.

        Raises:
            UnsupportedError: Nothing could be decoded for :data:`HOPELESS_S`.
        """
        piece = coded.data
        if not isinstance(piece, Piece):
            raise TypeError("a piece of a live stream is wanted")
        before, self._before = self._before, piece
        if piece.number and (before is None or before.number + 1 != piece.number):
            piece.context.flush_buffers()  # what was left out would show as a smear
        try:
            images = piece.context.decode(piece.packet)
        except (av.error.FFmpegError, ValueError):
            self._note_failure(coded)
            return None
        good = [image for image in images if not image.is_corrupt]
        if images and not good:
            self._note_failure(coded)
            return None
        if not good:
            self.waited += 1
            return None
        self._failing_ns = None
        if not show:
            return None
        self._shown += 1
        pixels = np.ascontiguousarray(good[-1].to_ndarray(format="bgr24"), dtype=np.uint8)
        stamp_ns = _stamp_ns(good[-1])
        if stamp_ns is None or piece.offset_ns is None:
            return Decoded(self._shown, pixels)
        return Decoded(self._shown, pixels, min(stamp_ns + piece.offset_ns, coded.arrived_ns))

    def _note_failure(self, coded: Coded) -> None:
        self._failing_ns = coded.arrived_ns if self._failing_ns is None else self._failing_ns
        if coded.arrived_ns - self._failing_ns > nanoseconds(HOPELESS_S):
            raise UnsupportedError(f"for {HOPELESS_S:g} s, nothing that came could be decoded")
        self.damaged += 1


def _stamp_ns(timed: av.Packet[av.VideoStream] | av.VideoFrame) -> int | None:
    if timed.pts is None or timed.time_base is None:
        return None
    return nanoseconds(float(timed.pts * timed.time_base))


def _os_error(error: Exception) -> OSError:
    """Return an error in words, without the address, which may hold a password."""
    if isinstance(error, av.error.InvalidDataError):
        return ConnectionError("what comes is no video that is known here")
    return ConnectionError(getattr(error, "strerror", None) or str(error) or repr(error))
