"""Which feedback an application is sent: the least that gives each of its consumers what it asked for."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce

from skyloop.client.channels import Channel
from skyloop.client.connection import ProxyConnection
from skyloop.messages import Feedback, FeedbackRequest
from skyloop.messages.subscription import PLAIN, RateLimiter


class FeedbackDemand:
    """Subscribes to the form of feedback that all consumers of a drone need together.

    A pilot is sent every sample whole: its link, its authority and a failsafe show in them. An observer is, too, until
    a consumer asks for less, and whenever one asks for all. A connection has one form at a time.
    """

    def __init__(self, connection: ProxyConnection, *, whole: bool) -> None:
        """Subscribe to every sample.

        Args:
            connection: Where it is subscribed to.
            whole: Whether it stays so, whatever consumers ask for.
        """
        self._connection = connection
        self._whole = whole
        self._wanted: dict[FeedbackRequest, int] = {}  # how many consumers want each
        self._kept: set[FeedbackRequest] = set()  # wanted for good
        self._lock = threading.Lock()
        self.request = PLAIN  #: what is subscribed to now
        connection.subscribe(PLAIN.topic)

    def want(self, request: FeedbackRequest, on: bool) -> None:
        """Count a consumer in, or out again.

        Args:
            request: What it asks for.
            on: Whether it comes or goes.
        """
        with self._lock:
            count = self._wanted.get(request, 0) + (1 if on else -1)
            if count > 0:
                self._wanted[request] = count
            else:
                self._wanted.pop(request, None)
            self._update()

    def keep(self, request: FeedbackRequest) -> None:
        """Want this for good."""
        if not self._whole and request not in self._kept:
            with self._lock:
                self._kept.add(request)
                self._update()

    @contextmanager
    def wanted(self, request: FeedbackRequest) -> Iterator[None]:
        """Want this within the block."""
        self.want(request, True)
        try:
            yield
        finally:
            self.want(request, False)

    def _update(self) -> None:
        """Change the subscription if another is needed. The lock is held."""
        asked = [*self._wanted, *self._kept]
        needed = PLAIN if self._whole or not asked else reduce(FeedbackRequest.union, asked)
        before = self.request
        if needed != before:
            self.request = needed
            self._connection.subscribe(needed.topic, True)  # first, so that none is missing in between
            self._connection.subscribe(before.topic, False)


class FeedbackChannel(Channel[Feedback]):
    """Feedback for consumers that ask for fewer samples than the connection may be sent for others."""

    def __init__(self, request: FeedbackRequest, demand: FeedbackDemand) -> None:
        super().__init__(lambda on: demand.want(request, on))
        self.request = request
        self._rate = RateLimiter(request.max_hz)

    def receive(self, sample: Feedback) -> None:
        """Publish a sample if it is due; on the receiving thread."""
        if self._consumers and self._rate.in_time(sample.published_ns):
            self.publish(sample)
