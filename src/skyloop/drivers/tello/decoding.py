"""H.264 that lost pieces on its way, to pictures: a little damage is patched up, more of it is not shown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from skyloop.drivers.backlog import Coded
from skyloop.drivers.live_video import Decoded
from skyloop.errors import MissingExtraError
from skyloop.wire.tello.video import AccessUnit

if TYPE_CHECKING:
    import av
    from av.video.codeccontext import VideoCodecContext

#: A picture may build on so many damaged ones. With a tenth of the datagrams of a simulated flight lost, encoded with
#: 0.3 Mbit/s, a marker was found in 81 % of the pictures that are shown with 1 here, in 73 % with 2, in 67 % with 3.
MOST_DAMAGED: Final = 2
MOST_UNITS: Final = 120  #: kept to be decoded anew; key pictures of the drone are 30 apart
_STRICT: Final = {"err_detect": "explode+aggressive"}


class TelloVideo:
    """Pictures of one stream. Raises :class:`MissingExtraError` without PyAV.

    From a whole key picture on a decoder is at work that refuses any damage. At the first damage another one takes
    over, which fills what is missing with what stood there before; it decodes once more what came since the key. After
    more than :data:`MOST_DAMAGED` damaged pictures, or a damaged key, nothing is shown up to the next whole key.
    """

    def __init__(self) -> None:
        try:
            from skyloop.drivers.video.decoder import av, limit_memory
        except MissingExtraError as error:
            raise MissingExtraError("the video of a Tello", error.extra, cause=str(error.__cause__)) from error
        self._av = av
        self._limit = limit_memory
        self.waited = 0
        self.damaged = 0
        self._strict: VideoCodecContext | None = None
        self._patching: VideoCodecContext | None = None
        self._units: list[bytes] = []  # since the key, while there is no damage
        self._damage = 0  # pictures since the key
        self._number = 0

    def restart(self) -> None:
        """What comes next does not continue what came before."""
        self._strict = self._patching = None

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        unit = coded.data
        if not isinstance(unit, AccessUnit):
            raise TypeError("a picture of a Tello is wanted")
        if unit.is_key:
            image = self._decode_key(unit.data)
        elif self._strict is None and self._patching is None:
            self.waited += 1
            return None
        else:
            image = self._decode_next(unit)
        if image is None or not show:
            return None
        self._number += 1
        return Decoded(self._number, np.ascontiguousarray(image.to_ndarray(format="bgr24"), dtype=np.uint8))

    def _decode_key(self, data: bytes) -> av.VideoFrame | None:
        fresh = self._fresh(strict=True)
        image = self._decode(fresh, data)
        if image is None:
            self.damaged += 1
            self.restart()
            return None
        self._strict, self._patching, self._units, self._damage = fresh, None, [data], 0
        return image

    def _decode_next(self, unit: AccessUnit) -> av.VideoFrame | None:
        if self._strict is not None and len(self._units) < MOST_UNITS and unit.whole and not unit.after_gap:
            image = self._decode(self._strict, unit.data)
            if image is not None:
                self._units.append(unit.data)
                return image
        noted = self._strict is not None or unit.after_gap or not unit.whole
        if noted:
            self._note_damage()
        if self._patching is None:
            return None
        image = self._decode(self._patching, unit.data)
        if image is None and not noted:
            self._note_damage()
        return image

    def _note_damage(self) -> None:
        """Patch from here on, or wait for a key if there is too much of it."""
        self.damaged += 1
        self._damage += 1
        if self._damage > MOST_DAMAGED:
            self._strict = self._patching = None
        elif self._strict is not None:
            self._strict, self._patching = None, self._fresh(strict=False)
            for data in self._units:
                self._decode(self._patching, data)
        self._units = []

    def _decode(self, context: VideoCodecContext, data: bytes) -> av.VideoFrame | None:
        """The picture; None if there is none, or the decoder says that it is damaged."""
        try:
            images = context.decode(self._av.Packet(data))
        except (self._av.error.FFmpegError, ValueError):
            return None
        return images[-1] if images else None

    def _fresh(self, *, strict: bool) -> VideoCodecContext:
        context: VideoCodecContext = self._av.CodecContext.create("h264", "r")
        if strict:
            context.options = dict(_STRICT)
        else:
            context.flags |= self._av.codec.context.Flags.output_corrupt
        self._limit(context)
        context.flags |= self._av.codec.context.Flags.low_delay
        context.thread_count = 1  # frame threads would hold pictures back
        return context
