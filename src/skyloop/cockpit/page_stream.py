"""One camera as H.264 on one page: choose its form and its pictures. On the event loop.

Pages that keep up share a form. A page whose acknowledgements arrive late gets its own stream, with a rate and size
adapted to the path to that page, until nothing has been late for a while.
"""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.cockpit.encoded_feed import EncodedFeed, Form, Numbered, form_for
from skyloop.cockpit.feeds import Wake
from skyloop.errors import SkyloopError
from skyloop.messages import CameraInfo, EncodedFrame

if TYPE_CHECKING:
    from skyloop.cockpit.station import Station

LATE_S: Final = 0.25  #: a picture acknowledged after more than this is late
FALLS_BEHIND_S: Final = 1.0  #: a page gets its own stream if all pictures were late for this long
QUIET_S: Final = 10.0  #: after this long without a late picture it shares a stream again; doubles with each relapse
MOST_QUIET_S: Final = 160.0
SILENT_S: Final = 3.0  #: give up on a form after this much silence
RETRY_S: Final = 10.0  #: pause before trying it again, doubled each time …
MOST_RETRY_S: Final = 300.0  #: … up to this: each attempt makes a refusing proxy report it
MOST_UNDER_WAY: Final = 8  #: number of pictures sent and not yet acknowledged
MOST_BYTES: Final = 1_000_000  #: total size of these pictures [bytes], unless a single one is larger


class PagePath:
    """Judges from its acknowledgements whether a page keeps up. Pure: the time is an argument."""

    def __init__(self) -> None:
        self.behind = False  #: whether it needs a lower rate than other pages get
        self.late_here = False  #: whether that is not because of its own path: pictures reached the cockpit late
        self._under_way: deque[tuple[int, int, int]] = deque()  # number, bytes, time sent
        self._trip_s = 0.0  # round-trip time of the newest acknowledged picture
        self._changed_ns: int | None = None  # since when all are late, or none is
        self._was_late = False
        self._quiet_s = QUIET_S
        self._back_ns: int | None = None

    @property
    def free(self) -> bool:
        """Whether another picture may be sent."""
        waiting = self._under_way
        return len(waiting) < MOST_UNDER_WAY and (not waiting or sum(size for _, size, _ in waiting) < MOST_BYTES)

    @property
    def waiting(self) -> int:
        """The number of pictures in flight."""
        return len(self._under_way)

    def sent(self, number: int, size: int, now_ns: int) -> None:
        """Record that a picture was sent, with its size in bytes."""
        self._under_way.append((number, size, now_ns))

    def acknowledged(self, number: int, now_ns: int) -> int:
        """Record that the page has a picture and all earlier ones; return how many of them were new."""
        count = 0
        while self._under_way and self._under_way[0][0] <= number:
            self._trip_s = seconds(now_ns - self._under_way.popleft()[2])
            count += 1
        return count

    def update(self, now_ns: int, extra_s: float = 0.0) -> bool:
        """Update the judgement; return whether the page is behind.

        Args:
            now_ns: The current time.
            extra_s: Time that pictures take to reach the cockpit [s].
        """
        oldest_s = seconds(now_ns - self._under_way[0][2]) if self._under_way else 0.0
        late = max(oldest_s, self._trip_s, extra_s) > LATE_S
        if self._changed_ns is None or late != self._was_late:
            self._changed_ns, self._was_late = now_ns, late
        if late:
            self.late_here = extra_s > LATE_S
        lasts_s = seconds(now_ns - self._changed_ns)
        if late and not self.behind and lasts_s >= FALLS_BEHIND_S:
            relapse = self._back_ns is not None and seconds(now_ns - self._back_ns) < 2.0 * self._quiet_s
            self._quiet_s = min(2.0 * self._quiet_s, MOST_QUIET_S) if relapse else QUIET_S
            self.behind, self._changed_ns = True, now_ns
        elif self.behind and not late and lasts_s >= self._quiet_s:
            self.behind, self._back_ns, self._changed_ns = False, now_ns, now_ns
        return self.behind


@dataclass(frozen=True, slots=True)
class Sent:
    """A picture for a page."""

    picture: EncodedFrame
    form: Form
    age_s: float
    late_here: bool = False  #: whether the page has its own form because pictures reach the cockpit late


class PageStream:
    """One camera for one page.

    Args:
        station: The drone.
        camera: The camera.
        width: Of the pane [device pixels]; 0: full size.
        max_fps: Most pictures a second; None: all.
        wake: Called on the event loop for each picture; None: the page polls.
        clock: The monotonic clock [ns].
    """

    def __init__(
        self,
        station: Station,
        camera: CameraInfo,
        width: int,
        max_fps: float | None,
        wake: Wake | None,
        clock: Clock = monotonic_ns,
    ) -> None:
        self.path = PagePath()
        self.skipped = 0  #: number of pictures not sent because the page could not have decoded them
        self._station = station
        self._camera = camera
        self._width = width
        self._max_fps = max_fps
        self._wake = wake
        self._clock = clock
        self._name = ""  # name of the page's own stream, if it has one
        self._feed: EncodedFeed | None = None
        self._next: EncodedFeed | None = None  # will replace the current form at its first key picture
        self._serial = 0  # number of the last picture sent
        self._follows = True  # whether the page can decode the picture after that
        self._numbers: deque[tuple[int, EncodedFeed, int]] = deque()  # message numbers, each with its newest picture
        self._late_s = 0.0  # delay of the newest picture when it reached the cockpit
        self._missed = 0  # number of pictures missed before those that are ready
        self._refused_ns: int | None = None
        self._retry_s = RETRY_S

    @property
    def shows(self) -> bool:
        """Whether the page receives these pictures; until it does, it needs others."""
        return self._feed is not None

    def resize(self, width: int) -> None:
        """Set the pane's new width [device pixels]."""
        self._width = width

    def take(self) -> list[Sent]:
        """Return the pictures to send now, in order, and mark them as sent; report their numbers to :meth:`sent`."""
        self._choose()
        if self._next is not None and self._ready(self._next, 0):
            self._release(self._feed)
            self._feed, self._next, self._serial = self._next, None, 0
            self._refused_ns, self._retry_s = None, RETRY_S
        feed = self._feed
        if feed is None or not self.path.free:
            return []
        pictures, skipped = self._ready(feed, self._serial), self._missed
        pictures = pictures[: MOST_UNDER_WAY - self.path.waiting]
        if not pictures:
            return []
        if self._serial:
            self.skipped += skipped
        self._serial, self._follows = pictures[-1].serial, True
        now_ns = self._clock() + self._station.drone.clock_offset_ns
        self._late_s = seconds(now_ns - pictures[-1].picture.published_ns)
        form, late = feed.form, self.path.late_here
        return [Sent(one.picture, form, seconds(now_ns - one.picture.captured_ns), late) for one in pictures]

    def sent(self, number: int, one: Sent) -> None:
        """Record the message number of pictures from :meth:`take`."""
        if self._feed is not None:
            self._numbers.append((number, self._feed, one.picture.seq))
            self.path.sent(number, len(one.picture.data), self._clock())

    def acknowledged(self, number: int) -> int:
        """Handle the page's report that it has drawn or skipped pictures; return how many were new."""
        newest = None
        while self._numbers and self._numbers[0][0] <= number:
            newest = self._numbers.popleft()
        if newest is not None:
            newest[1].acknowledge(newest[2])
        return self.path.acknowledged(number, self._clock())

    def restart(self) -> None:
        """Resume at a key picture, because the page can't decode the next picture."""
        self._follows = False

    def close(self) -> None:
        """Release the streams. Idempotent."""
        for feed in (self._feed, self._next):
            self._release(feed)
        self._feed = self._next = None
        self._numbers.clear()
        if self._name:
            self._station.free_name(self._name)
            self._name = ""

    def _ready(self, feed: EncodedFeed, serial: int) -> list[Numbered[EncodedFrame]]:
        """Return a form's pictures that the page can decode after ``serial``; if none, request a key picture."""
        pictures, self._missed = feed.after(serial, follows=self._follows)
        if not pictures and self._missed:
            feed.ask_for_key()
        return pictures

    def _choose(self) -> None:
        """Subscribe to the form that suits the page now. The current one is used until a key picture arrives."""
        form = form_for(self._camera, self._width, self._max_fps)
        if self.path.update(self._clock(), self._late_s):
            self._name = self._name or self._station.own_name()
            form = Form(None, form.scale, self._max_fps, self._name)
        for feed in filter(None, (self._next, self._feed)):
            if feed.silent_s > SILENT_S:
                self._refuse(feed)
                return
        present = self._next or self._feed
        refused = self._refused_ns is not None and self._clock() - self._refused_ns < nanoseconds(self._retry_s)
        if refused or (present is not None and present.form == form):
            return
        self._release(self._next)
        self._next = None
        if self._feed is not None and self._feed.form == form:
            return  # it returned to the current form before the other one arrived
        feed = self._station.encoded(self._camera.name, form)
        with suppress(SkyloopError):  # the drone is being closed
            feed.subscribe(self, self._wake)
            self._next = feed

    def _refuse(self, feed: EncodedFeed) -> None:
        if self._refused_ns is not None:
            self._retry_s = min(2.0 * self._retry_s, MOST_RETRY_S)
        self._refused_ns = self._clock()
        self._release(feed)
        if feed is self._next:
            self._next = None
        else:
            self._feed = None

    def _release(self, feed: EncodedFeed | None) -> None:
        if feed is not None:
            feed.unsubscribe(self)
            if not feed.wanted:
                self._station.forget(feed)
