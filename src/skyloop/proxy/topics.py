"""A proxy's topics: their names, feedback at reduced rates, and the overview.

No other topics can be subscribed to, so that made-up names use no resources.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Collection
from typing import Final, Generic, Protocol, TypeVar

import msgspec

from skyloop.clock import Clock, nanoseconds
from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import Feedback, FeedbackRequest, Overview, VehicleOverview, VideoRequest, encode
from skyloop.messages.relayed import PROCESSOR_NAME
from skyloop.messages.subscription import RateLimiter
from skyloop.proxy.events import Counters
from skyloop.transport.base import (
    ANNOTATIONS,
    COMMANDS,
    EVENTS,
    FEEDBACK,
    LOGS,
    OVERVIEW,
    RESULTS,
    TransportServer,
    stream,
    video,
)

#: The topics whose names never change.
FIXED_TOPICS: Final = frozenset({FEEDBACK, EVENTS, COMMANDS, ANNOTATIONS, LOGS, OVERVIEW, RESULTS})
STREAM_TOPIC: Final = stream("")  #: prefix of stream topics
PREFIX: Final = f"{FEEDBACK}?"  #: prefix of the topics of feedback variants
_VIDEO_TOPIC: Final = video("")
_RESULTS_TOPIC: Final = RESULTS + "/"

MAX_VARIANTS: Final = 16  #: maximum number of simultaneous feedback variants, each with any number of subscribers
#: How long a requested variant is kept without subscribers, in case a subscription is still in transit.
KEEP_NS: Final = nanoseconds(5.0)
PERIOD_NS: Final = nanoseconds(1.0)  #: interval between two overviews
_FRESH_NS: Final = PERIOD_NS // 2  # if an overview is younger than this, it is sent again instead of a new one
_replace = msgspec.structs.replace


def topic_problem(topic: str, cameras: Callable[[], Collection[str]]) -> str:
    """Return why a topic can't be subscribed to, and name the available topics; an empty string if it can.

    A processor's results may be subscribed to before it has a worker.
    """
    if topic in FIXED_TOPICS:
        return ""
    if topic.startswith(_RESULTS_TOPIC):
        name = topic.removeprefix(_RESULTS_TOPIC)
        known = re.fullmatch(PROCESSOR_NAME, name)
        return "" if known else f"{name[:64]!r} is not a processor's name, which has 1 to 64 letters, digits and _ . -"
    if topic.startswith((STREAM_TOPIC, _VIDEO_TOPIC)):
        try:
            return camera_problem(VideoRequest.parse(topic).camera, cameras)
        except UsageError as error:
            return str(error)
    available = {*FIXED_TOPICS, *map(video, cameras()), *map(stream, cameras())}
    return UnknownNameError("topic", topic[:64], available).message


def camera_problem(camera: str, cameras: Callable[[], Collection[str]]) -> str:
    """Return an error that lists the vehicle's cameras; empty if this is one of them."""
    known = cameras()
    return "" if camera in known else UnknownNameError("camera of this vehicle", camera[:64], known).message


# Variants of samples, and feedback at reduced rates -------------------------------------------------------------------


class Variant(Protocol):
    """A variant of samples that is published on one topic."""

    topic: str
    asked_ns: int  #: time of the newest request for this variant


V = TypeVar("V", bound=Variant)


class Variants(Generic[V]):
    """A limited number of variants that have subscribers or may soon have some. Thread-safe."""

    def __init__(self, most: int, subscribers: Callable[[str], int], clock: Clock) -> None:
        self.known: tuple[V, ...] = ()
        self._most = most
        self._subscribers = subscribers
        self._clock = clock
        self._lock = threading.Lock()  # guards changes to the set of known variants

    def find(self, topic: str) -> V | None:
        """Return the variant of a topic; None if no one has requested it."""
        return next((variant for variant in self.known if variant.topic == topic), None)

    def claim(self, topic: str, make: Callable[[], V]) -> bool:
        """Reserve a place for a variant, or renew the reservation. Return False if all places are taken."""
        now_ns = self._clock()
        with self._lock:
            variant = self.find(topic)
            if variant is None:
                kept = [one for one in self.known if now_ns - one.asked_ns < KEEP_NS or self._subscribers(one.topic)]
                if len(kept) >= self._most:
                    return False
                variant = make()
                self.known = (*kept, variant)
            variant.asked_ns = now_ns
        return True


class _FeedbackVariant:
    def __init__(self, topic: str, request: FeedbackRequest) -> None:
        self.topic = topic
        self.rate = RateLimiter(request.max_hz)
        self.asked_ns = 0
        self.last_seq = 0


class FeedbackVariants(Variants[_FeedbackVariant]):
    """The variants of feedback that have subscribers or may soon have some."""

    def __init__(self, server: TransportServer, counters: Counters, clock: Clock) -> None:
        super().__init__(MAX_VARIANTS, server.subscribers, clock)
        self._publish = server.publish
        self._counts = counters.counts

    def problem(self, topic: str) -> str:
        """Reserve a place for a variant and return ""; if it can't be subscribed to, return the reason. Thread-safe."""
        try:
            request = FeedbackRequest.parse(topic)
        except UsageError as error:
            return str(error)
        if self.claim(topic, lambda: _FeedbackVariant(topic, request)):
            return ""
        return (
            f"this proxy sends feedback in at most {MAX_VARIANTS} variants at a time, and all are in use: "
            f"subscribe to {FEEDBACK}, or to one of {', '.join(one.topic for one in self.known[:4])} …"
        )

    def publish(self, sample: Feedback, now_ns: int) -> None:
        """Publish a sample in each variant that is due. Not thread-safe.

        ``now_ns`` must not be the capture time, which does not advance while the vehicle is silent.
        """
        for variant in self.known:
            if not self._subscribers(variant.topic) or not variant.rate.in_time(now_ns):
                continue
            skipped = sample.seq - variant.last_seq - 1 if variant.last_seq else 0
            variant.last_seq = sample.seq
            selected = _replace(sample, skipped=skipped)
            try:
                packet = encode(selected)
            except (ValueError, TypeError, OverflowError):  # caused by native telemetry, and already reported
                packet = encode(_replace(selected, native=None))
            missed = self._publish(variant.topic, packet)
            self._counts["feedback.selected"] += 1
            if missed:
                self._counts["feedback.missed"] += missed


# The overview: one row for each vehicle of the same process -----------------------------------------------------


class OverviewRegistry:
    """The rows of all proxies in a process, encoded once and shared by all of them. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sources: dict[Callable[[], VehicleOverview], None] = {}
        self._seq = 0
        self._made_ns: int | None = None
        self._packets: list[bytes] = []

    def add(self, row: Callable[[], VehicleOverview]) -> None:
        """Add a vehicle. ``row`` returns the vehicle's row and is called on any proxy's ticker."""
        with self._lock:
            self._sources[row] = None
            self._made_ns = None

    def remove(self, row: Callable[[], VehicleOverview]) -> None:
        """Remove a vehicle. Does nothing if the vehicle is unknown."""
        with self._lock:
            self._sources.pop(row, None)
            self._made_ns = None

    def packets(self, now_ns: int) -> list[bytes]:
        """Return the current overview, split into as many packets as needed."""
        with self._lock:
            if self._made_ns is None or not 0 <= now_ns - self._made_ns < _FRESH_NS:
                rows = sorted((row() for row in self._sources), key=lambda row: row.name)
                self._seq += 1
                self._made_ns = now_ns
                whole = Overview(at_ns=now_ns, seq=self._seq, total=len(rows), vehicles=tuple(rows))
                self._packets = _encoded(whole)
            return self._packets


class OverviewPublisher:
    """Publishes the overview on one proxy's transport once a second, and immediately to a new subscriber."""

    def __init__(self, server: TransportServer, row: Callable[[], VehicleOverview]) -> None:
        self.registry = OverviewRegistry()  #: provides the published rows; by default, only the proxy's own row
        self._server = server
        self._row = row
        self._subscribers = 0
        self._due_ns = 0

    def share(self, registry: OverviewRegistry) -> None:
        """Publish the rows of other proxies, too, and share this proxy's row. Call before :meth:`begin`.

        Does nothing if applications may have access to only some of the proxies, because they would see all rows.
        """
        if not self._server.restricted:
            self.registry = registry

    def begin(self) -> None:
        """Add the vehicle to the overview."""
        self.registry.add(self._row)

    def end(self) -> None:
        """Remove the vehicle from the overview."""
        self.registry.remove(self._row)

    def tick(self, now_ns: int) -> None:
        """Publish the overview if it is due. Call several times a second."""
        before, self._subscribers = self._subscribers, self._server.subscribers(OVERVIEW)
        if self._subscribers and (self._subscribers > before or now_ns >= self._due_ns):
            self._due_ns = now_ns + PERIOD_NS
            for packet in self.registry.packets(now_ns):
                self._server.publish(OVERVIEW, packet)


def _encoded(page: Overview) -> list[bytes]:
    """Encode rows as one packet, or as several if they don't fit into one."""
    try:
        return [encode(page)]
    except ValueError:
        if len(page.vehicles) < 2:
            raise
        half = len(page.vehicles) // 2
        one = _replace(page, vehicles=page.vehicles[:half])
        other = _replace(page, first=page.first + half, vehicles=page.vehicles[half:])
        return _encoded(one) + _encoded(other)
