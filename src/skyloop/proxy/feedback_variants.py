"""Feedback as subscribers asked for it: fewer samples, or fewer fields; each form is encoded once."""

from __future__ import annotations

import threading
from typing import Final

import msgspec

from skyloop.clock import Clock, nanoseconds
from skyloop.errors import UsageError
from skyloop.messages import Feedback, FeedbackRequest, encode
from skyloop.messages.feedback_request import TOPIC
from skyloop.messages.rate import RateLimiter
from skyloop.proxy.events import Counters
from skyloop.transport.base import TransportServer

MAX_VARIANTS: Final = 16  #: forms at a time, however many subscribers each has
#: A form that was asked for and has no subscriber keeps its place for so long: its subscription may be under way.
KEEP_NS: Final = nanoseconds(5.0)
PREFIX: Final = f"{TOPIC}?"  #: how the topic of each form begins


class _Variant:
    """One form of feedback."""

    def __init__(self, request: FeedbackRequest) -> None:
        self.request = request
        self.topic = request.topic
        self.rate = RateLimiter(request.max_hz)
        self.asked_ns = 0
        self.last_seq = 0


class FeedbackVariants:
    """The forms of feedback that have, or may soon have, subscribers."""

    def __init__(self, server: TransportServer, counters: Counters, clock: Clock) -> None:
        self._publish = server.publish
        self._subscribers = server.subscribers
        self._counts = counters.counts
        self._clock = clock
        self._lock = threading.Lock()  # guards changes of what follows
        self.known: tuple[_Variant, ...] = ()

    def problem(self, topic: str) -> str:
        """Return why a form can't be subscribed to; empty if it can, and then it has a place here. Any thread.

        Args:
            topic: Of feedback, with options.
        """
        try:
            request = FeedbackRequest.parse(topic)
        except UsageError as error:
            return str(error)
        now_ns = self._clock()
        with self._lock:
            for variant in self.known:
                if variant.topic == topic:
                    variant.asked_ns = now_ns
                    return ""
            kept = [one for one in self.known if now_ns - one.asked_ns < KEEP_NS or self._subscribers(one.topic)]
            if len(kept) >= MAX_VARIANTS:
                return (
                    f"this proxy sends feedback in {MAX_VARIANTS} forms at most at a time, and all are in use: "
                    f"subscribe to {TOPIC}, or to one of {', '.join(one.topic for one in kept[:4])} …"
                )
            variant = _Variant(request)
            variant.asked_ns = now_ns
            self.known = (*kept, variant)
        return ""

    def publish(self, sample: Feedback, now_ns: int) -> None:
        """Publish a sample in each form in which it is due. One thread at a time.

        Args:
            sample: As it is published to those who get all.
            now_ns: The present time; not that of capture, which stands still while the vehicle is silent.
        """
        for variant in self.known:
            if not self._subscribers(variant.topic) or not variant.rate.in_time(now_ns):
                continue
            skipped = sample.seq - variant.last_seq - 1 if variant.last_seq else 0
            variant.last_seq = sample.seq
            selected = msgspec.structs.replace(variant.request.select(sample), skipped=skipped)
            try:
                packet = encode(selected)
            except (ValueError, TypeError, OverflowError):  # its native telemetry, as was published with the whole one
                packet = encode(msgspec.structs.replace(selected, native=None))
            missed = self._publish(variant.topic, packet)
            self._counts["feedback.selected"] += 1
            if missed:
                self._counts["feedback.missed"] += missed
