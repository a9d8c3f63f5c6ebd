"""What a consumer of video asks for: a camera, and in which form its frames are to come."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal
from urllib.parse import parse_qsl, quote, unquote

from skyloop.errors import UsageError
from skyloop.messages.rate import RateLimiter
from skyloop.messages.result import MAX_PARTS

VideoEncoding = Literal["raw", "jpeg"]
DEFAULT_QUALITY: Final = 80
MIN_FPS: Final = 0.001  #: a frame in a quarter of an hour; the time between two of much less has no end
_PREFIX: Final = "video/"
_FIELDS: Final = ("encoding", "max_fps", "part", "quality", "scale")


@dataclass(frozen=True, slots=True)
class VideoRequest:
    """Frames of one camera, as one consumer wants them.

    Two requests that give the same frames are equal and have the same :attr:`topic`.

    Raises:
        UsageError: A value is not valid.
    """

    camera: str
    encoding: VideoEncoding = "raw"  #: how the pixels travel where they must be sent: as they are, or as JPEG
    quality: int = DEFAULT_QUALITY  #: of a JPEG, 1 to 100
    max_fps: float | None = None  #: at most so many frames in a second
    scale: float = 1.0  #: width and height times this, above 0 and up to 1
    part: tuple[int, int] | None = None  #: (k, n): only frames whose number leaves k when divided by n

    def __post_init__(self) -> None:
        if not self.camera:
            raise UsageError("a request for video needs the name of a camera")
        if self.encoding not in ("raw", "jpeg"):
            raise UsageError(f'encoding is {self.encoding!r} and must be "raw" or "jpeg"')
        if not _is_whole(self.quality) or not 1 <= self.quality <= 100:
            raise UsageError(f"quality is {self.quality!r} and must be a whole number from 1 to 100")
        if self.max_fps is not None and not (_is_number(self.max_fps) and MIN_FPS <= self.max_fps < math.inf):
            raise UsageError(
                f"max_fps is {self.max_fps!r} and must be a finite number of frames a second, from {MIN_FPS}"
            )
        if not _is_number(self.scale) or not 0.0 < self.scale <= 1.0:
            raise UsageError(f"scale is {self.scale!r} and must be above 0 and at most 1")
        if self.part is not None and not _is_part(self.part):
            raise UsageError(f"part is {self.part!r} and must be (k, n) with 0 <= k < n <= {MAX_PARTS}")
        if self.encoding == "raw" and self.quality != DEFAULT_QUALITY:
            object.__setattr__(self, "quality", DEFAULT_QUALITY)  # it means nothing: equal requests stay equal
        if self.part == (0, 1):
            object.__setattr__(self, "part", None)

    @property
    def variant(self) -> str:
        """What follows the ``?`` of the topic; empty if the frames are to come as they are."""
        values = {
            "encoding": "" if self.encoding == "raw" else self.encoding,
            "max_fps": "" if self.max_fps is None else f"{self.max_fps:g}",
            "part": "" if self.part is None else f"{self.part[0]}/{self.part[1]}",
            "quality": "" if self.encoding == "raw" else str(self.quality),
            "scale": "" if self.scale == 1.0 else f"{self.scale:g}",
        }
        return "&".join(f"{field}={quote(values[field], safe='')}" for field in _FIELDS if values[field])

    @property
    def topic(self) -> str:
        """The topic to subscribe to, e.g. ``video/front?encoding=jpeg&quality=80``."""
        variant = self.variant
        return f"{_PREFIX}{self.camera}" + (f"?{variant}" if variant else "")

    @property
    def plain(self) -> VideoRequest:
        """The request for all frames of the same camera, as they are."""
        return VideoRequest(self.camera)

    @classmethod
    def parse(cls, topic: str) -> VideoRequest:
        """Parse the request of a topic.

        Raises:
            UsageError: It is not a topic of a camera's frames.
        """
        camera, _, variant = topic.removeprefix(_PREFIX).partition("?")
        if not topic.startswith(_PREFIX) or not camera:
            raise UsageError(f"{topic[:100]!r} is no topic of a camera's frames: it looks like video/front")
        request = cls(camera)
        try:
            for field, text in parse_qsl(variant, keep_blank_values=True, strict_parsing=bool(variant)):
                request = _with(request, field, unquote(text))
        except ValueError as error:
            raise UsageError(f"{topic[:100]!r} is no request for video: {error}") from None
        return request


class FrameFilter:
    """Selects the frames of one camera that a request is for, by their numbers and times of capture.

    It keeps state, so each stream of frames needs its own.

    Args:
        request: Its ``part`` and ``max_fps`` count.
    """

    def __init__(self, request: VideoRequest) -> None:
        self._part = request.part
        self._rate = RateLimiter(request.max_fps)

    def wants(self, seq: int, captured_ns: int) -> bool:
        """Return whether a frame is wanted. Call it once for each frame, in order.

        Args:
            seq: The frame's number.
            captured_ns: When it was captured, on any one clock [ns].
        """
        if self._part is not None and seq % self._part[1] != self._part[0]:
            return False
        return self._rate.in_time(captured_ns)


def _with(request: VideoRequest, field: str, text: str) -> VideoRequest:
    """The request with one more field, given as text. Raises ``ValueError``."""
    if field == "encoding" and text in ("raw", "jpeg"):
        return replace(request, encoding="raw" if text == "raw" else "jpeg")
    if field == "quality":
        return replace(request, quality=int(text))
    if field in ("max_fps", "scale"):
        return replace(request, **{field: float(text)})  # type: ignore[arg-type]
    if field == "part":
        k, _, n = text.partition("/")
        return replace(request, part=(int(k), int(n)))
    raise ValueError(f"{field}={text[:40]} is unknown; known are {', '.join(_FIELDS)}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_part(part: object) -> bool:
    if not (isinstance(part, tuple) and len(part) == 2 and all(_is_whole(number) for number in part)):
        return False
    k, n = part
    return bool(0 <= k < n <= MAX_PARTS)
