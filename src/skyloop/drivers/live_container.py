"""Receive live video with PyAV, from the network or a device, for :class:`skyloop.drivers.live_video.LiveVideo`.

All errors in opening and reading are OSErrors with a readable reason.
"""

from __future__ import annotations

import errno
import io
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from skyloop.clock import Clock, LiveClock, nanoseconds
from skyloop.drivers.h264 import Inspector, Unit
from skyloop.drivers.live_video import Coded, Decoded
from skyloop.errors import MissingExtraError, UnsupportedError
from skyloop.messages.frame import H264
from skyloop.pyav import limit_memory, new_decoder

try:
    import av
except ImportError as error:
    raise MissingExtraError("video://", "video", cause=str(error)) from error

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.codeccontext import VideoCodecContext

HOPELESS_S: Final = 3.0  #: time without a decodable frame before this is reported
STRICT_S: Final = 15.0  #: time without undamaged H.264 before damage is tolerated
#: Number of frames that FFmpeg holds back. FFmpeg detects the end of a frame only when the next frame starts, and the
#: packets of a transport stream add the same delay once more.
_HELD_BACK: Final = {"rtsp": 1, "sdp": 1, "h264": 1, "hevc": 1, "mpegts": 2}
_REORDERED_NS: Final = 1_000_000_000  # B-frames cause smaller backward steps; a clock set back causes larger ones
_STAMPS: Final = 128  # maximum number of stored capture times: two per frame, more than any decoder holds back
_NO_STAMPS: Final[Any] = av.format.Flags.no_timestamps.value


class ProtocolRefusedError(ConnectionError):
    """Raised when a server refuses the requested protocol."""


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """The bytes of an encoded frame, and everything needed to decode and time it."""

    packet: av.Packet[av.VideoStream]
    context: VideoCodecContext  # codec context of the frame's connection
    number: int  # number of the frame within its connection, from 0
    unit: Unit | None = None  # frame as H.264 in Annex B format; None if it is not H.264 or its headers are unknown
    reason: str = ""  # why the frame can't be forwarded without decoding; empty if it can be
    reordered: bool = False  # whether frames depend on later frames (H.264 only)

    @property
    def is_h264(self) -> bool:
        return self.context.name == H264


class ContainerStream:
    """One connection to a source that PyAV can open.

    Args:
        name: An address or a path for FFmpeg, or the content of a file.
        format_name: FFmpeg's name for the format; None lets FFmpeg detect it.
        open_s: Time limit for connecting, the handshake and finding the image size [s]; a hanging device takes longer.
        read_s: Time limit for the next frame [s]. FFmpeg can't be interrupted, and :meth:`read` may take this long.

    Raises:
        ProtocolRefusedError: If the server refuses the requested protocol.
        OSError: If the source can't be opened, or has no supported video.
    """

    broken = 0  # always 0: FFmpeg does not report the frames it discards
    lost_bytes = 0

    def __init__(
        self,
        name: str | bytes,
        number: int,
        clock: Clock,
        *,
        format_name: str | None = None,
        options: dict[str, str],
        open_s: float,
        read_s: float,
    ) -> None:
        self._connection = number
        self._clock = clock
        self._read_s = read_s
        begun_ns = clock()
        try:
            self._container: InputContainer = av.open(
                io.BytesIO(name) if isinstance(name, bytes) else name,
                mode="r",
                format=format_name,
                options=options,
                timeout=(open_s, read_s),
            )
        except Exception as error:
            if clock() - begun_ns >= nanoseconds(open_s):  # FFmpeg reports a time-out in the handshake as damaged data
                raise TimeoutError(f"no answer, or no frame, within {open_s:g} s") from error
            raise _os_error(error) from error
        try:
            self._context, self._packets = self._chosen()
            self._units = Units(self._container.streams.video[0], self._context)
        except BaseException:
            self._container.close()
            raise
        held_back = _HELD_BACK.get(self._container.format.name, 0)
        self._arrivals: deque[int] = deque(maxlen=held_back + 1)  # arrival times of the latest frames from FFmpeg
        self._number = 0
        self._live_clock = LiveClock()
        self._newest_ns: int | None = None  # newest timestamp
        self._offset_ns = 0
        self._captured_newest_ns = 0

    def read(self) -> list[Coded]:
        """Return the next encoded frame, as a list of one item."""
        try:
            packet = next(self._packets, None)
        except av.error.ExitError as error:
            raise TimeoutError(f"nothing received for {self._read_s:g} s") from error
        except Exception as error:
            raise _os_error(error) from error
        if packet is None or not packet.size:
            raise ConnectionError("the stream ended")
        now_ns = self._clock()
        self._arrivals.append(now_ns)
        unit = self._units.of(packet)
        captured_ns = min(self._captured_ns(packet), now_ns)
        if self._units.in_order:  # a new estimate of the delay must not set the time back
            captured_ns = self._captured_newest_ns = max(captured_ns, self._captured_newest_ns)
        units = self._units
        piece = Piece(packet, self._context, self._number, unit, units.reason, not units.in_order)
        self._number += 1
        is_key = packet.is_keyframe or self._context.codec.intra_only
        return [Coded(piece, is_key, captured_ns, now_ns, self._connection)]

    def close(self) -> None:
        self._container.close()

    def _chosen(self) -> tuple[VideoCodecContext, Iterator[av.Packet[av.VideoStream]]]:
        """Return the first video stream, ready for reading and decoding."""
        videos = self._container.streams.video
        if not videos:
            raise ConnectionError("the source has no video")
        context = videos[0].codec_context
        if context is None:
            raise ConnectionError("the video's codec is not supported")
        if not (context.width and context.height):
            raise ConnectionError("the stream has no frame size: it is damaged, or not video")
        limit_memory(context)
        return context, self._container.demux(videos[0])

    def _captured_ns(self, packet: av.Packet[av.VideoStream]) -> int:
        """Return a frame's capture time: from its timestamp and the smallest recent delay, or else its arrival time."""
        stamp_ns = _stamp_ns(packet)
        if stamp_ns is None or self._container.format.flags & _NO_STAMPS:
            return self._arrivals[0]
        back_ns = 0 if self._newest_ns is None else self._newest_ns - stamp_ns
        if not self._units.in_order and 0 < back_ns < _REORDERED_NS:  # other frames depend on this frame
            return stamp_ns + self._offset_ns
        if self._newest_ns is None or back_ns:
            self._newest_ns = stamp_ns
            self._offset_ns = self._live_clock.captured_ns(stamp_ns / 1e9, self._arrivals[0]) - stamp_ns
        return stamp_ns + self._offset_ns


class Units:
    """Converts a stream's H.264 to Annex B format, from any container.

    ``reason`` tells why frames can't be forwarded without decoding; it is empty while they can be.
    """

    def __init__(self, stream: av.VideoStream, context: VideoCodecContext) -> None:
        self._is_h264 = context.name == H264
        self.reason = "" if self._is_h264 else f"the video is {context.name}, not H.264"
        self.in_order = self._is_h264  #: whether no frame so far has depended on a later frame
        self._filter: av.BitStreamFilterContext | None = None
        parameters = bytes(context.extradata or b"")
        if self._is_h264 and parameters[:1] == b"\1":  # the stream uses sizes instead of start codes, as in MP4
            self._filter, parameters = av.BitStreamFilterContext("h264_mp4toannexb", stream), b""
        self._inspector = Inspector(parameters)

    def of(self, packet: av.Packet[av.VideoStream]) -> Unit | None:
        """Return a packet's frame, if it contains one. Set ``reason`` once a frame can't be forwarded."""
        if not self._is_h264:
            return None
        data = self._annex_b(packet)
        if packet.is_corrupt or data is None:
            self._inspector.restart()
            return None
        unit = self._inspector.inspect(data)
        if unit is not None and unit.reason:
            self.reason, self.in_order = unit.reason, False
        return unit

    def _annex_b(self, packet: av.Packet[av.VideoStream]) -> bytes | None:
        if self._filter is None:
            return bytes(packet)
        copy = av.Packet(bytes(packet))  # pass a copy, because the filter consumes its input
        try:
            return b"".join(bytes(part) for part in self._filter.filter(copy))
        except (av.error.FFmpegError, ValueError):
            return None


class LiveDecoder:
    """Decodes one connection after another.

    In H.264, damaged frames are not shown. Frames that depend on them are not shown either, up to the next key frame.
    Decoding then restarts with a new decoder, because the old decoder may continue to show the damage. If these rules
    leave nothing to show for :data:`STRICT_S` (because the encoder is faulty or sends no key frames), FFmpeg alone
    decides which frames are good, up to the next undamaged key frame.

    Args:
        on_whole: Called on the decoding thread with each undamaged frame once it has been decoded.
        on_forgiving: Called once, with a message, when the decoder begins to tolerate damage.
    """

    def __init__(
        self, on_whole: Callable[[Coded], None] = lambda _: None, on_forgiving: Callable[[str], None] = lambda _: None
    ) -> None:
        self.waited = 0
        self.damaged = 0
        self._on_whole = on_whole
        self._on_forgiving = on_forgiving
        self._shown = 0
        self._forgave = False
        self.restart()

    def restart(self) -> None:
        """Forget the stream so far: the next frame does not continue it."""
        self._before: Piece | None = None
        self._failing_ns: int | None = None  # when pieces became undecodable
        self._barren_since_ns: int | None = None  # when H.264 data last stopped producing frames
        self._strict: VideoCodecContext | None = None  # None while H.264 waits for a key frame
        self._shown_ns = 0  # capture time of the newest frame; later frames can't have been captured earlier
        self._reorders = False  # whether the decoder holds back frames that depend on later frames
        self._forgiving: VideoCodecContext | None = None
        # Capture times of the decoders' inputs, by decoder (whether it was the strict decoder) and timestamp.
        self._captured: dict[tuple[bool, int | None], int] = {}

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        piece = coded.data
        if not isinstance(piece, Piece):
            raise TypeError("expected a piece of a live stream")
        before, self._before = self._before, piece
        follows = not piece.number or (before is not None and before.number + 1 == piece.number)
        self._note_stamp(piece, coded)
        image = self._decode_h264(piece, coded, follows) if piece.is_h264 else self._decode_other(piece, coded, follows)
        if image is None:
            return None
        self._failing_ns = self._barren_since_ns = None
        if not show:
            return None
        self._shown += 1
        pixels = np.ascontiguousarray(image.to_ndarray(format="bgr24"), dtype=np.uint8)
        strictly = self._forgiving is None and piece.is_h264
        captured_ns = self._captured.get((strictly, image.pts), coded.captured_ns)
        self._shown_ns = max(self._shown_ns, captured_ns)
        return Decoded(self._shown, pixels, self._shown_ns)

    def _decode_other(self, piece: Piece, coded: Coded, follows: bool) -> av.VideoFrame | None:
        if not follows:
            piece.context.flush_buffers()  # without this, skipped frames would cause smearing
        return self._judged(piece.context, piece.packet, coded)

    def _decode_h264(self, piece: Piece, coded: Coded, follows: bool) -> av.VideoFrame | None:
        unit = piece.unit
        if unit is None:  # it contains only parameters, or noise
            self._note_failure(coded)
            return None
        surprised = piece.reordered and not self._reorders  # the decoder would show the frame it depends on first
        if not follows or unit.after_gap or surprised:
            self._strict = None
            if self._forgiving is not None:
                self._forgiving.flush_buffers()
        image = self._decode_strict(piece, unit, coded)
        if image is not None:
            self._forgiving = None
            return image
        if self._forgiving is not None:
            return self._judged(self._forgiving, piece.packet, coded)
        if self._strict is None:
            self._barren_since_ns = coded.arrived_ns if self._barren_since_ns is None else self._barren_since_ns
            if coded.arrived_ns - self._barren_since_ns > nanoseconds(STRICT_S):
                self._forgive(piece)
        return None

    def _decode_strict(self, piece: Piece, unit: Unit, coded: Coded) -> av.VideoFrame | None:
        if self._strict is None:
            if not unit.is_key:
                self.waited += 1
                return None
            self._reorders = piece.reordered or bool(piece.context.has_b_frames)
            self._strict = new_decoder(H264, "a camera", low_delay=not self._reorders)
        packet = av.Packet(unit.data)
        packet.pts = piece.number  # identifies the decoded frame; not every packet of a stream has a timestamp
        try:
            images = self._strict.decode(packet)
        except (av.error.FFmpegError, ValueError):
            images = None
        if images is None or any(image.is_corrupt for image in images):
            self._strict = None
            self.damaged += 1
            return None
        self._on_whole(coded)
        if not images:
            self.waited += 1  # the decoder holds it back until it has shown others
            return None
        return images[-1]

    def _judged(
        self, context: VideoCodecContext, packet: av.Packet[av.VideoStream], coded: Coded
    ) -> av.VideoFrame | None:
        """Decode a piece; return the image, or None if the piece contains none that FFmpeg considers undamaged."""
        try:
            images = context.decode(packet)
        except (av.error.FFmpegError, ValueError):
            self._note_failure(coded)
            return None
        good = [image for image in images if not image.is_corrupt]
        if images and not good:
            self._note_failure(coded)
        elif not good:
            self.waited += 1
        return good[-1] if good else None

    def _note_stamp(self, piece: Piece, coded: Coded) -> None:
        self._captured[True, piece.number] = self._captured[False, piece.packet.pts] = coded.captured_ns
        while len(self._captured) > _STAMPS:
            del self._captured[next(iter(self._captured))]

    def _note_failure(self, coded: Coded) -> None:
        now_ns = coded.arrived_ns
        self._failing_ns = now_ns if self._failing_ns is None else self._failing_ns
        if now_ns - self._failing_ns > nanoseconds(HOPELESS_S):
            raise UnsupportedError(f"nothing received could be decoded for {HOPELESS_S:g} s")
        self.damaged += 1

    def _forgive(self, piece: Piece) -> None:
        context: VideoCodecContext = av.CodecContext.create(H264, "r")
        if piece.context.extradata:
            context.extradata = piece.context.extradata
        limit_memory(context)
        self._forgiving = context
        if not self._forgave:
            self._forgave = True
            self._on_forgiving(
                f"no flawless key picture arrived for {STRICT_S:g} s: frames are shown with their damage until one does"
            )


def _stamp_ns(timed: av.Packet[av.VideoStream] | av.VideoFrame) -> int | None:
    if timed.pts is None or timed.time_base is None:
        return None
    return nanoseconds(float(timed.pts * timed.time_base))


def _os_error(error: Exception) -> OSError:
    """Return an error with a readable message that omits the address, because the address may contain a password."""
    if isinstance(error, OSError) and error.errno == errno.EPROTONOSUPPORT:
        return ProtocolRefusedError(error.strerror)
    if isinstance(error, av.error.InvalidDataError):
        return ConnectionError("the source has no supported video")
    return ConnectionError(getattr(error, "strerror", None) or str(error) or repr(error))
