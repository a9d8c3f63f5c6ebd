"""A picture as the vehicle encoded it, for recorders: sent only while somebody subscribes to the camera's stream."""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from skyloop.messages.frame import Intrinsics, Name, Pixels
from skyloop.messages.numbers import Count, TimeNs

H264: Final = "h264"  #: the one codec that is recorded as it comes
#: Bytes of a picture that fit a packet, with all that is sent beside it.
MAX_ENCODED: Final = 59_000


class EncodedFrame(msgspec.Struct, frozen=True, array_like=True):
    """One picture, whole: of H.264 an access unit in Annex B form, with its parameter sets if it is a key picture.

    A picture that is no key builds on the one before, so after a gap in ``seq`` nothing can be decoded up to the next
    key. There are no pictures that build on later ones. A frame decoded from it has the same ``captured_ns``, and a
    number of its own.
    """

    camera: Name
    seq: Count  #: grows by one with each picture of the stream, those too large for a packet included
    captured_ns: TimeNs  #: as of the decoded frame
    published_ns: TimeNs  #: when the proxy had it
    width: Pixels  #: of the picture when decoded
    height: Pixels
    codec: Annotated[str, msgspec.Meta(max_length=16)]  #: ``h264``
    key: bool  #: it can be decoded without those before it
    data: Annotated[bytes, msgspec.Meta(max_length=MAX_ENCODED)]
    intrinsics: Intrinsics | None = None


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
