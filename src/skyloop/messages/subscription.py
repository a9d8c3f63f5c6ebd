"""Define subscribers' requests: the rate of feedback, and the camera, encoding and rate of video. Pure.

Each request has exactly one topic; equal requests are therefore encoded once for all their subscribers.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Final, Literal, Self, get_args
from urllib.parse import parse_qsl, quote, unquote

from skyloop.clock import NS_PER_S
from skyloop.errors import UsageError
from skyloop.messages.relayed import MAX_PARTS

FEEDBACK: Final = "feedback"
MIN_HZ: Final = 0.001  #: lowest rate: one sample every quarter of an hour, which keeps the period finite
MAX_HZ: Final = 1000.0  #: highest rate that can be requested [samples/s]
_FEEDBACK_RATE: Final = f"{FEEDBACK}?max_hz="
TOLERANCE: Final = 0.1  #: fraction of a period by which a sample may arrive early

VideoEncoding = Literal["raw", "jpeg", "h264"]
DEFAULT_QUALITY: Final = 80  #: JPEG quality, 1 to 100
MIN_KBIT_S: Final = 30  #: lowest bit rate of a stream that the proxy encodes
MAX_KBIT_S: Final = 50_000  #: highest bit rate of a stream that the proxy encodes
MAX_SUBSCRIBER: Final = 32  #: maximum length of a subscriber's name [characters]
MIN_FPS: Final = 0.001  #: lowest rate: one frame every quarter of an hour, which keeps the period finite
_ENCODINGS: Final = get_args(VideoEncoding)
_PREFIX: Final = "video/"
_STREAM_PREFIX: Final = "stream/"
_FIELDS: Final = ("encoding", "kbit_s", "max_fps", "part", "quality", "scale", "subscriber")


@dataclass(frozen=True, slots=True)
class FeedbackRequest:
    """A consumer's request for feedback. Requests for the same samples are equal and have the same :attr:`topic`.

    Raises :class:`UsageError` if ``max_hz`` is not within :data:`MIN_HZ` to :data:`MAX_HZ`.
    """

    max_hz: float | None = None  #: maximum number of samples per second; None: no limit

    def __post_init__(self) -> None:
        rate = self.max_hz
        if rate is not None:
            known = isinstance(rate, int | float) and not isinstance(rate, bool)
            if not (known and MIN_HZ <= rate <= MAX_HZ):
                raise UsageError(f"max_hz is {rate!r} and must be from {MIN_HZ} to {MAX_HZ:g} samples a second")
            # Round the rate as in the topic's name so that subscriber and publisher have the same request.
            object.__setattr__(self, "max_hz", float(f"{rate:g}"))

    @property
    def is_plain(self) -> bool:
        """Whether the request includes every sample."""
        return self.max_hz is None

    @property
    def topic(self) -> str:
        """The topic to subscribe to: ``feedback``, or for example ``feedback?max_hz=5`` if the rate is limited."""
        return FEEDBACK if self.max_hz is None else f"{_FEEDBACK_RATE}{self.max_hz:g}"

    @property
    def period_s(self) -> float:
        """Minimum time between two samples [s]; 0 if all samples are requested."""
        return 0.0 if self.max_hz is None else 1.0 / self.max_hz

    @classmethod
    def parse(cls, topic: str) -> Self:
        """Parse a topic in exactly the form of :attr:`topic`; raise :class:`UsageError` for any other form."""
        if topic == FEEDBACK:
            return cls()
        try:
            if not topic.startswith(_FEEDBACK_RATE):
                raise ValueError(f"expected {FEEDBACK}, or {_FEEDBACK_RATE} and a number")
            request = cls(float(topic.removeprefix(_FEEDBACK_RATE)))
        except (ValueError, UsageError) as error:
            raise UsageError(f"{topic[:100]!r} is not a request for feedback: {error}") from None
        if request.topic != topic:
            raise UsageError(f"{topic[:100]!r} must be written {request.topic!r}")
        return request

    def union(self, other: FeedbackRequest) -> FeedbackRequest:
        """Return the smallest request that includes both requests."""
        if self.max_hz is None or other.max_hz is None:
            return EVERY_SAMPLE
        return self if self.max_hz >= other.max_hz else other


EVERY_SAMPLE: Final = FeedbackRequest()


@dataclass(frozen=True, slots=True)
class VideoRequest:
    """A consumer's request for a camera's frames; an H.264 stream has its own topic, :attr:`stream_topic`.

    Requests for the same frames are equal and have the same :attr:`topic`. Raises :class:`UsageError` for invalid
    values.
    """

    camera: str
    encoding: VideoEncoding = "raw"  #: encoding of the pixels when sent over a network: unchanged, JPEG or H.264
    quality: int = DEFAULT_QUALITY  #: JPEG quality, 1 to 100
    max_fps: float | None = None  #: maximum number of frames per second; None: no limit
    scale: float = 1.0  #: factor for width and height, greater than 0 and at most 1
    part: tuple[int, int] | None = None  #: (k, n): only frames whose number modulo n equals k
    kbit_s: int | None = None  #: average H.264 bit rate; None: as sent by the vehicle, or as much as the path can carry
    subscriber: str = ""  #: unique name of the only subscriber, if the H.264 rate adapts to that subscriber's path

    def __post_init__(self) -> None:
        if not self.camera:
            raise UsageError("a request for video needs the name of a camera")
        if self.encoding not in _ENCODINGS:
            raise UsageError(f'encoding is {self.encoding!r} and must be "raw", "jpeg" or "h264"')
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
        self._check_stream()
        if self.encoding != "jpeg" and self.quality != DEFAULT_QUALITY:
            object.__setattr__(self, "quality", DEFAULT_QUALITY)  # not used: the same in all equivalent requests
        if self.part == (0, 1):
            object.__setattr__(self, "part", None)

    def _check_stream(self) -> None:
        if self.encoding != "h264":
            if self.kbit_s is not None or self.subscriber:
                raise UsageError(f'kbit_s and subscriber need encoding="h264", and the encoding is {self.encoding!r}')
            return
        if self.part is not None:
            raise UsageError('part is not possible with encoding="h264": each of its frames refers to the previous one')
        if self.kbit_s is not None and not (_is_whole(self.kbit_s) and MIN_KBIT_S <= self.kbit_s <= MAX_KBIT_S):
            raise UsageError(
                f"kbit_s is {self.kbit_s!r} and must be a whole number of kbit/s from {MIN_KBIT_S} to {MAX_KBIT_S}"
            )
        if self.subscriber and not re.fullmatch(rf"[A-Za-z0-9_-]{{1,{MAX_SUBSCRIBER}}}", self.subscriber):
            raise UsageError(
                f"subscriber is {self.subscriber[:64]!r} and must have 1 to {MAX_SUBSCRIBER} letters, digits, _ and -"
            )

    @property
    def variant(self) -> str:
        """The part of the topic after the ``?``; empty for unchanged frames."""
        return self._variant("" if self.encoding == "raw" else self.encoding)

    def _variant(self, encoding: str) -> str:
        values = {
            "encoding": encoding,
            "kbit_s": "" if self.kbit_s is None else str(self.kbit_s),
            "max_fps": "" if self.max_fps is None else f"{self.max_fps:g}",
            "part": "" if self.part is None else f"{self.part[0]}/{self.part[1]}",
            "quality": str(self.quality) if self.encoding == "jpeg" else "",
            "scale": "" if self.scale == 1.0 else f"{self.scale:g}",
            "subscriber": self.subscriber,
        }
        return "&".join(f"{field}={quote(values[field], safe='')}" for field in _FIELDS if values[field])

    @property
    def topic(self) -> str:
        """The topic to subscribe to, e.g. ``video/front?encoding=jpeg&quality=80``."""
        variant = self.variant
        return f"{_PREFIX}{self.camera}" + (f"?{variant}" if variant else "")

    @property
    def stream_topic(self) -> str:
        """The topic of the request's H.264, e.g. ``stream/front?kbit_s=500``.

        Without options, this is the vehicle's own stream.
        """
        variant = self._variant("")
        return f"{_STREAM_PREFIX}{self.camera}" + (f"?{variant}" if variant else "")

    @property
    def plain(self) -> VideoRequest:
        """A request for all frames of the same camera, unchanged."""
        return VideoRequest(self.camera)

    @classmethod
    def parse(cls, topic: str) -> VideoRequest:
        """Parse a video topic. Raises :class:`UsageError` for any other topic."""
        prefix = _STREAM_PREFIX if topic.startswith(_STREAM_PREFIX) else _PREFIX
        camera, _, variant = topic.removeprefix(prefix).partition("?")
        if not topic.startswith(prefix) or not camera:
            raise UsageError(f"{topic[:100]!r} is not a topic of a camera's frames, such as video/front")
        request = cls(camera, encoding="h264") if prefix == _STREAM_PREFIX else cls(camera)
        try:
            for field, text in parse_qsl(variant, keep_blank_values=True, strict_parsing=bool(variant)):
                request = _with(request, field, unquote(text))
        except ValueError as error:
            raise UsageError(f"{topic[:100]!r} is not a request for video: {error}") from None
        return request


class FrameFilter:
    """Selects a request's frames (``part``, ``max_fps``) from one stream of frames, by number and capture time."""

    def __init__(self, request: VideoRequest) -> None:
        self._part = request.part
        self._rate = RateLimiter(request.max_fps)

    def wants(self, seq: int, captured_ns: int) -> bool:
        """Return whether the request includes this frame. Must be called once for each frame, in order.

        The capture time [ns] may be on any clock, but always on the same one.
        """
        if self._part is not None and seq % self._part[1] != self._part[0]:
            return False
        return self._rate.in_time(captured_ns)


class RateLimiter:
    """Reduces one series of samples to an average rate for one consumer, beginning with the first sample."""

    def __init__(self, max_hz: float | None) -> None:
        """Create a limiter; if ``max_hz`` is None, keep all samples."""
        self.max_hz = math.inf if max_hz is None else max_hz
        self._due_ns: int | None = None

    @property
    def max_hz(self) -> float:
        """Maximum rate; infinity: all samples are kept."""
        return NS_PER_S / self._period_ns if self._period_ns else math.inf

    @max_hz.setter
    def max_hz(self, max_hz: float) -> None:
        self._period_ns = round(NS_PER_S / max_hz)  # 0: keep every sample

    def in_time(self, at_ns: int) -> bool:
        """Return whether to keep a sample. Must be called once for each sample, in order.

        The sample's time [ns] may be on any clock, but always on the same one.
        """
        period_ns, due_ns = self._period_ns, self._due_ns
        if not period_ns:
            return True
        # Start over after a pause of the source, or if its time jumped back because it was restarted.
        if due_ns is None or at_ns < due_ns - 2 * period_ns or at_ns >= due_ns + period_ns:
            self._due_ns = at_ns + period_ns
            return True
        if at_ns < due_ns - TOLERANCE * period_ns:
            return False
        self._due_ns = due_ns + period_ns
        return True


def _with(request: VideoRequest, field: str, text: str) -> VideoRequest:
    """Return the request with one more field, given as text. Raises ``ValueError``."""
    if field == "encoding" and text in _ENCODINGS and request.encoding != "h264":
        return replace(request, encoding=text)  # type: ignore[arg-type]
    if field in ("quality", "kbit_s"):
        return replace(request, **{field: int(text)})  # type: ignore[arg-type]
    if field == "subscriber":
        return replace(request, subscriber=text)
    if field in ("max_fps", "scale"):
        return replace(request, **{field: float(text)})  # type: ignore[arg-type]
    if field == "part":
        k, _, n = text.partition("/")
        return replace(request, part=(int(k), int(n)))
    raise ValueError(f"{field}={text[:40]} is unknown; known fields are {', '.join(_FIELDS)}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_part(part: object) -> bool:
    if not (isinstance(part, tuple) and len(part) == 2 and all(_is_whole(number) for number in part)):
        return False
    k, n = part
    return bool(0 <= k < n <= MAX_PARTS)
