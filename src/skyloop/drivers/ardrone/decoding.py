"""Frames of the drone's video to pixels, with one face for both drones."""

from __future__ import annotations

from typing import Final

import numpy as np

from skyloop.drivers.backlog import Coded
from skyloop.drivers.live_video import Decoded, Decoder
from skyloop.errors import DecodeError, MissingExtraError, UnsupportedError
from skyloop.wire.ardrone.pave import Codec, PaveFrame
from skyloop.wire.ardrone.uvlc import UvlcDecoder, UvlcPicture, is_p264

REORDERED: Final = 64  #: a number further back than this is not a late picture but a drone that was started again,
OLD_RUN: Final = 4  #: and so are this many pictures in a row that are older than the newest
_DECODED: Final = (Codec.MPEG4_VISUAL, Codec.MPEG4_AVC)


class PaveVideo:
    """An AR.Drone 2's. Raises :class:`MissingExtraError` without PyAV."""

    def __init__(self) -> None:
        try:
            from skyloop.drivers.video.decoder import PaveDecoder
        except MissingExtraError as error:
            raise MissingExtraError("the video of an AR.Drone 2", error.extra, cause=str(error.__cause__)) from error
        self._decoder = PaveDecoder()

    @property
    def waited(self) -> int:
        return self._decoder.waited

    @property
    def damaged(self) -> int:
        return self._decoder.damaged

    def restart(self) -> None:
        self._decoder.restart()

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        frame = coded.data
        if not isinstance(frame, PaveFrame):
            raise TypeError("a frame of an AR.Drone 2 is wanted")
        if frame.codec not in _DECODED:
            raise UnsupportedError(
                f"the drone sends video in codec {_codec_name(frame.codec)}, which is not decoded here: "
                "set video:video_codec to H.264 (129)"
            )
        image = self._decoder.decode(frame)
        if image is None or not show:
            return None
        return Decoded(frame.number, np.ascontiguousarray(image.to_ndarray(format="bgr24"), dtype=np.uint8))


class UvlcVideo:
    """An AR.Drone 1's."""

    def __init__(self) -> None:
        self.waited = 0
        self.damaged = 0
        self._decoder = UvlcDecoder()
        self._number: int | None = None  # of the newest picture
        self._old_run = 0

    def restart(self) -> None:
        self._decoder = UvlcDecoder()
        self._number = None

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        packet = coded.data
        if not isinstance(packet, bytes):
            raise TypeError("a datagram of an AR.Drone 1 is wanted")
        if is_p264(packet):
            raise UnsupportedError(
                "the drone sends video in P264, which is not decoded here: set video:video_codec to UVLC (32)"
            )
        try:
            picture = self._decoder.decode(packet)
        except DecodeError:
            self.damaged += 1
            return None
        self._old_run = self._old_run + 1 if self._is_old(picture) else 0
        if 0 < self._old_run < OLD_RUN:
            self.waited += 1
            return None
        self._number = picture.number
        return Decoded(picture.number, picture.pixels) if show else None

    def _is_old(self, picture: UvlcPicture) -> bool:
        """Whether it came after a newer one, or a second time."""
        return self._number is not None and 0 <= (self._number - picture.number) % (1 << 32) < REORDERED


def make_decoder(version: int) -> Decoder:
    """Raises :class:`MissingExtraError` if what it needs is not installed."""
    return PaveVideo() if version == 2 else UvlcVideo()


def _codec_name(codec: int) -> str:
    try:
        return Codec(codec).name
    except ValueError:
        return str(codec)
