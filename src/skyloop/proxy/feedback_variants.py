"""Feedback as subscribers asked for it, at fewer samples a second; each form is encoded once."""

from __future__ import annotations

from typing import Final

import msgspec

from skyloop.clock import Clock
from skyloop.errors import UsageError
from skyloop.messages import Feedback, FeedbackRequest, encode
from skyloop.messages.subscription import FEEDBACK as TOPIC
from skyloop.messages.subscription import RateLimiter
from skyloop.proxy.events import Counters
from skyloop.proxy.forms import Forms
from skyloop.transport.base import TransportServer

MAX_VARIANTS: Final = 16  #: forms at a time, however many subscribers each has
PREFIX: Final = f"{TOPIC}?"  #: how the topic of each form begins


class _Variant:
    """One form of feedback."""

    def __init__(self, topic: str, request: FeedbackRequest) -> None:
        self.topic = topic
        self.rate = RateLimiter(request.max_hz)
        self.asked_ns = 0
        self.last_seq = 0


class FeedbackVariants:
    """The forms of feedback that have, or may soon have, subscribers."""

    def __init__(self, server: TransportServer, counters: Counters, clock: Clock) -> None:
        self._publish = server.publish
        self._subscribers = server.subscribers
        self._counts = counters.counts
        self._forms: Forms[_Variant] = Forms(MAX_VARIANTS, server.subscribers, clock)

    @property
    def known(self) -> tuple[_Variant, ...]:
        """The forms."""
        return self._forms.known

    def problem(self, topic: str) -> str:
        """Return why a form can't be subscribed to; empty if it can, and then it has a place here. Any thread.

        Args:
            topic: Of feedback, with options.
        """
        try:
            request = FeedbackRequest.parse(topic)
        except UsageError as error:
            return str(error)
        if self._forms.claim(topic, lambda: _Variant(topic, request)):
            return ""
        return (
            f"this proxy sends feedback in {MAX_VARIANTS} forms at most at a time, and all are in use: "
            f"subscribe to {TOPIC}, or to one of {', '.join(one.topic for one in self.known[:4])} …"
        )

    def publish(self, sample: Feedback, now_ns: int) -> None:
        """Publish a sample in each form in which it is due. One thread at a time.

        Args:
            sample: As it is published to those who get all.
            now_ns: The present time; not that of capture, which stands still while the vehicle is silent.
        """
        for variant in self._forms.known:
            if not self._subscribers(variant.topic) or not variant.rate.in_time(now_ns):
                continue
            skipped = sample.seq - variant.last_seq - 1 if variant.last_seq else 0
            variant.last_seq = sample.seq
            selected = msgspec.structs.replace(sample, skipped=skipped)
            try:
                packet = encode(selected)
            except (ValueError, TypeError, OverflowError):  # its native telemetry, as was published with the whole one
                packet = encode(msgspec.structs.replace(selected, native=None))
            missed = self._publish(variant.topic, packet)
            self._counts["feedback.selected"] += 1
            if missed:
                self._counts["feedback.missed"] += missed
