"""Pictures of an encoded stream: as the vehicle sent them, or encoded by the proxy; only while somebody subscribes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final

import msgspec

from skyloop.messages.fields import Encoding
from skyloop.messages.frame import FrameHeader, Intrinsics, Name, Pixels
from skyloop.messages.numbers import Count, TimeNs

H264: Final = "h264"  #: the one codec that is recorded as it comes
#: Bytes of a picture that fit a packet, with all that is sent beside it.
MAX_PIECE: Final = 57_000
MAX_PIECES: Final = 64
MAX_ENCODED: Final = MAX_PIECE * MAX_PIECES  #: bytes of a whole picture
Topic = Annotated[str, msgspec.Meta(max_length=200)]


class EncodedFrame(msgspec.Struct, frozen=True, array_like=True):
    """One picture: of H.264 an access unit in Annex B form, with its parameter sets if it is a key picture.

    One that is larger than a packet travels in pieces, each of them one of these. A picture that is no key builds on
    the one before, so after a gap in ``seq`` nothing can be decoded up to the next key. There are no pictures that
    build on later ones. A frame decoded from it has the same ``captured_ns``, and a number of its own.
    """

    camera: Name
    seq: Count  #: grows by one with each picture of the stream, those too large for a packet included
    captured_ns: TimeNs  #: as of the decoded frame
    published_ns: TimeNs  #: when the proxy had it
    width: Pixels  #: of the picture when decoded
    height: Pixels
    codec: Annotated[str, msgspec.Meta(max_length=16)]  #: ``h264``
    key: bool  #: it can be decoded without those before it
    data: Annotated[bytes, msgspec.Meta(max_length=MAX_ENCODED)]  #: at most :data:`MAX_PIECE` of them in a packet
    intrinsics: Intrinsics | None = None
    topic: Topic = ""  #: that it was published on; empty: ``stream/CAMERA``, as the vehicle encoded it
    piece: Annotated[int, msgspec.Meta(ge=0, lt=MAX_PIECES)] = 0
    pieces: Annotated[int, msgspec.Meta(ge=1, le=MAX_PIECES)] = 1

    def decoded(self, width: int, height: int) -> FrameHeader:
        """Return the header of the frame that was decoded from it, in BGR and of this size [px]."""
        same = (width, height) == (self.width, self.height)
        times = (self.captured_ns, self.published_ns)
        lens = self.intrinsics if same else None  # it is for the announced size
        return FrameHeader(self.camera, self.seq, *times, width, height, Encoding.BGR8, width * height * 3, lens)


class StreamReport(msgspec.Struct, frozen=True, array_like=True):
    """What a subscriber tells the proxy of a stream that the proxy encodes. It may be lost: the next one tells more."""

    topic: Topic
    seq: Count  #: the newest picture that came whole; 0: none so far
    wants_key: bool = False  #: it can decode nothing before the next key picture


def split(picture: EncodedFrame) -> Iterator[EncodedFrame]:
    """Yield the pieces of a picture in order; the picture itself if it fits a packet.

    Args:
        picture: Whole, of at most :data:`MAX_ENCODED` bytes.
    """
    pieces = -(-len(picture.data) // MAX_PIECE)
    if pieces <= 1:
        yield picture
        return
    for piece in range(pieces):
        data = picture.data[piece * MAX_PIECE : (piece + 1) * MAX_PIECE]
        yield msgspec.structs.replace(picture, data=data, piece=piece, pieces=pieces)


class Pieces:
    """Puts the pictures of one stream together again. Pieces come in order, or the picture is not whole."""

    def __init__(self) -> None:
        self._parts: list[EncodedFrame] = []

    def add(self, part: EncodedFrame) -> EncodedFrame | None:
        """Take what came; return a picture that is whole now."""
        if part.pieces == 1:
            self._parts.clear()
            return part
        last = self._parts[-1] if self._parts else None
        if part.piece == 0:
            self._parts = [part]
        elif last is not None and (part.seq, part.pieces, part.piece) == (last.seq, last.pieces, last.piece + 1):
            self._parts.append(part)
        else:
            self._parts.clear()
            return None
        if len(self._parts) < part.pieces:
            return None
        parts, self._parts = self._parts, []
        return msgspec.structs.replace(part, data=b"".join(each.data for each in parts), piece=0, pieces=1)


class Chain:
    """Tells which pictures of a stream can be decoded: a key, and each that follows it without a gap in the numbers."""

    def __init__(self) -> None:
        self._last: int | None = None  # None: wait for a key

    def follows(self, number: int, *, key: bool) -> bool:
        """Return whether a picture, the next that came, can be decoded; False for one that came a second time.

        Args:
            number: The picture's ``seq``.
            key: Whether it is a key picture.
        """
        if number == self._last and not key:
            return False
        whole = key or (self._last is not None and number == self._last + 1)
        self._last = number if whole else None
        return whole

    def restart(self) -> None:
        """Restart: the next picture does not continue what came before."""
        self._last = None
