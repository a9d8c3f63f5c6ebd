"""What a consumer of feedback asks for: how many samples a second."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

from skyloop.errors import UsageError

TOPIC: Final = "feedback"
MIN_HZ: Final = 0.001  #: a sample in a quarter of an hour; the time between two of much less has no end
MAX_HZ: Final = 1000.0
_RATE: Final = f"{TOPIC}?max_hz="


@dataclass(frozen=True, slots=True)
class FeedbackRequest:
    """Feedback as one consumer wants it.

    Two requests that give the same samples are equal and have the same :attr:`topic`.

    Raises:
        UsageError: ``max_hz`` is not within :data:`MIN_HZ` and :data:`MAX_HZ`.
    """

    max_hz: float | None = None  #: at most so many samples a second; None: all

    def __post_init__(self) -> None:
        rate = self.max_hz
        if rate is not None:
            known = isinstance(rate, int | float) and not isinstance(rate, bool)
            if not (known and MIN_HZ <= rate <= MAX_HZ):
                raise UsageError(f"max_hz is {rate!r} and must be from {MIN_HZ} to {MAX_HZ:g} samples a second")
            # As it is written in a topic, so that both ends have the same request.
            object.__setattr__(self, "max_hz", float(f"{rate:g}"))

    @property
    def is_plain(self) -> bool:
        """Whether it asks for every sample."""
        return self.max_hz is None

    @property
    def topic(self) -> str:
        """The topic to subscribe to: ``feedback``, or for example ``feedback?max_hz=5``."""
        return TOPIC if self.max_hz is None else f"{_RATE}{self.max_hz:g}"

    @property
    def period_s(self) -> float:
        """Shortest time between two samples [s]; 0 for all samples."""
        return 0.0 if self.max_hz is None else 1.0 / self.max_hz

    @classmethod
    def parse(cls, topic: str) -> Self:
        """Parse the request of a topic, which must be written as :attr:`topic` writes it.

        So each request has one topic, and is encoded once.

        Raises:
            UsageError: It is not a topic of feedback, or not written that way.
        """
        if topic == TOPIC:
            return cls()
        try:
            if not topic.startswith(_RATE):
                raise ValueError(f"it is {TOPIC}, or {_RATE} and a number")
            request = cls(float(topic.removeprefix(_RATE)))
        except (ValueError, UsageError) as error:
            raise UsageError(f"{topic[:100]!r} is no request for feedback: {error}") from None
        if request.topic != topic:
            raise UsageError(f"{topic[:100]!r} is no request for feedback as it must be written: {request.topic!r}")
        return request

    def union(self, other: FeedbackRequest) -> FeedbackRequest:
        """Return the smallest request that gives what either asks for."""
        if self.max_hz is None or other.max_hz is None:
            return PLAIN
        return self if self.max_hz >= other.max_hz else other


PLAIN: Final = FeedbackRequest()
