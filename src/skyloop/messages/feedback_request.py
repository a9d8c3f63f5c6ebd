"""What a consumer of feedback asks for: how many samples a second, and which of the vehicle's fields."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Self
from urllib.parse import parse_qsl

import msgspec

from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages.feedback import Feedback

TOPIC: Final = "feedback"
MIN_HZ: Final = 0.001  #: a sample in a quarter of an hour; the time between two of much less has no end
MAX_HZ: Final = 1000.0
#: What can be left out: the vehicle's own fields. Times, flight state, links, authority and failsafe always come.
FIELDS: Final = (
    "battery",
    "battery_v",
    "roll_rad",
    "pitch_rad",
    "yaw_rad",
    "altitude_m",
    "velocity_m_s",
    "angular_velocity_rad_s",
    "acceleration_m_s2",
    "position_m",
    "native",
)
_ALL: Final = frozenset(FIELDS)
_NO_FIELDS: Final = "none"  # in a topic
_replace = msgspec.structs.replace


@dataclass(frozen=True, slots=True)
class FeedbackRequest:
    """Feedback as one consumer wants it.

    Two requests that give the same samples are equal and have the same :attr:`topic`.

    Raises:
        UsageError: ``max_hz`` is not within :data:`MIN_HZ` and :data:`MAX_HZ`, or ``fields`` is no set of names.
        UnknownNameError: There is no such field, or it can't be left out.
    """

    max_hz: float | None = None  #: at most so many samples a second; None: all
    fields: frozenset[str] | None = None  #: of :data:`FIELDS`, the others are None; None: all

    def __post_init__(self) -> None:
        rate = self.max_hz
        if rate is not None:
            known = isinstance(rate, int | float) and not isinstance(rate, bool)
            if not (known and MIN_HZ <= rate <= MAX_HZ):
                raise UsageError(f"max_hz is {rate!r} and must be from {MIN_HZ} to {MAX_HZ:g} samples a second")
            # As it is written in a topic, so that both ends have the same request.
            object.__setattr__(self, "max_hz", float(f"{rate:g}"))
        if self.fields is not None:
            for field in sorted(self.fields, key=str):
                if field not in _ALL:
                    raise UnknownNameError("field of feedback that can be asked for", str(field)[:64], FIELDS)
            if self.fields == _ALL:
                object.__setattr__(self, "fields", None)

    @classmethod
    def of(cls, max_hz: float | None = None, fields: Iterable[str] | None = None) -> Self:
        """Make a request of what an application gave.

        Args:
            max_hz: At most so many samples a second; None: all.
            fields: Names of the vehicle's fields that are wanted, in any order; None: all.

        Raises:
            UsageError: See :class:`FeedbackRequest`; also if ``fields`` is a single text.
        """
        if fields is None:
            return cls(max_hz)
        if isinstance(fields, str) or not isinstance(fields, Iterable):
            raise UsageError(f'fields is {fields!r:.80} and must be several names, such as fields=("battery",)')
        names = list(fields)
        if not all(isinstance(name, str) for name in names):
            raise UsageError(f"fields is {names!r:.80} and must be names: {', '.join(FIELDS)}")
        return cls(max_hz, frozenset(names))

    @property
    def is_plain(self) -> bool:
        """Whether it asks for every sample whole."""
        return self.max_hz is None and self.fields is None

    @property
    def topic(self) -> str:
        """The topic to subscribe to: ``feedback``, or for example ``feedback?fields=battery,position_m&max_hz=5``."""
        options = []
        if self.fields is not None:
            options.append(f"fields={','.join(name for name in FIELDS if name in self.fields) or _NO_FIELDS}")
        if self.max_hz is not None:
            options.append(f"max_hz={self.max_hz:g}")
        return TOPIC + (f"?{'&'.join(options)}" if options else "")

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
        name, mark, options = topic.partition("?")
        try:
            if name != TOPIC or (mark and not options):
                raise ValueError(f"it begins with {TOPIC}, and options follow a ?")
            request = cls()
            pairs = parse_qsl(options, keep_blank_values=True, strict_parsing=True, max_num_fields=2) if options else []
            for field, text in pairs:
                if field == "max_hz":
                    request = cls(float(text), request.fields)
                elif field == "fields":
                    request = cls(request.max_hz, frozenset() if text == _NO_FIELDS else frozenset(text.split(",")))
                else:
                    raise ValueError(f"{field[:40]} is unknown; known are fields and max_hz")
        except (ValueError, UsageError) as error:
            raise UsageError(f"{topic[:100]!r} is no request for feedback: {error}") from None
        if request.topic != topic:
            raise UsageError(f"{topic[:100]!r} is no request for feedback as it must be written: {request.topic!r}")
        return request

    def union(self, other: FeedbackRequest) -> FeedbackRequest:
        """Return the smallest request that gives what either asks for."""
        both_slow = self.max_hz is not None and other.max_hz is not None
        both_few = self.fields is not None and other.fields is not None
        return FeedbackRequest(
            max(self.max_hz or 0.0, other.max_hz or 0.0) if both_slow else None,
            (self.fields or frozenset()) | (other.fields or frozenset()) if both_few else None,
        )

    def select(self, sample: Feedback) -> Feedback:
        """Return the sample with no other of the vehicle's fields than those asked for."""
        if self.fields is None:
            return sample
        return _replace(sample, **dict.fromkeys(_ALL - self.fields))


PLAIN: Final = FeedbackRequest()
