"""Show drones live: subscribe to the sources that a screen needs and pass it their samples on a separate thread."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Final, Protocol, Self

from skyloop.client import Drone
from skyloop.clock import beats, nanoseconds
from skyloop.recording.backlog import Backlog, Item
from skyloop.recording.options import MB, Options
from skyloop.recording.taps import Tap, check_names

BEAT_S: Final = 0.02  #: interval between polls of the backlog; polling spares receiving threads from waking the view
_BATCH: Final = MB  # bytes to show before asking the screen again which sources it needs
_LIMIT: Final = 16 * MB  # bytes held for a slow screen; older images are useless to a viewer
_RESERVE: Final = 16 * MB  # bytes above that limit for samples that must not be dropped
_QUALITY: Final = 80  # JPEG quality: these images are only viewed, not stored
_LOOK_NS: Final = nanoseconds(1.0)  # interval between checks of the streams
NICENESS: Final = 5

#: A drone's index, and a channel named as in :data:`skyloop.recording.options.CHOICES`, or ``video.CAMERA``.
Source = tuple[int, str]
_log = logging.getLogger(__name__)


class Screen(Protocol):
    """Displays samples. All methods except :meth:`close` are called on the view's thread."""

    def wanted(self) -> frozenset[Source]:
        """Return the sources currently on display; only these are subscribed to."""

    def show(self, item: Item) -> None:
        """Show a sample."""

    def close(self) -> None:
        """Close the screen. Called after the view's thread has ended."""


class View:
    """Shows drones on a screen from :meth:`start` to :meth:`close`. Use it as a context manager.

    Attributes:
        failed: Number of samples that could not be shown.
        failed_why: Channel and error of the last one.
    """

    def __init__(self, drones: Sequence[Drone], screen: Screen) -> None:
        """Initialise without subscribing. The view closes the screen.

        Raises:
            UsageError: Two drones have the same name.
        """
        check_names(drones, "view")
        self.failed = 0
        self.failed_why = ""
        self._drones = drones
        self._screen = screen
        self._backlog = Backlog(_LIMIT, _RESERVE)
        self._taps: dict[Source, Tap] = {}
        self._look_due_ns = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-view", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Unsubscribe and close the screen. Idempotent."""
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._screen.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @property
    def subscribed(self) -> dict[str, list[str]]:
        """Current subscriptions by drone. Safe to read from any thread."""
        found: dict[str, list[str]] = {}
        for number, channel in sorted(self._taps):
            found.setdefault(self._drones[number].name, []).append(channel)
        return found

    @property
    def dropped(self) -> int:
        """Samples dropped because the screen or the encoder was too slow. Safe to read from any thread."""
        return sum(tuple(self._backlog.dropped.values()))

    # The thread ------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        for _ in beats(BEAT_S, self._closing):
            self._try_step(ending=False)
        self._try_step(ending=True)

    def _try_step(self, *, ending: bool) -> None:
        try:
            self.step(time.monotonic_ns(), ending=ending)
        except Exception:  # noqa: BLE001  (a view that ended would show a frozen image of a flying drone)
            _log.exception("the view continues after an error")

    def step(self, now_ns: int, *, ending: bool = False) -> None:
        """Subscribe to the sources needed and show received samples. Called by the thread, or by a test."""
        self._subscribe(frozenset() if ending else self._screen.wanted())
        for item in self._backlog.take(_BATCH):
            try:
                self._screen.show(item)
            except Exception as error:  # noqa: BLE001  (samples hold what any application may send)
                self.failed += 1
                self.failed_why = f"{item.channel}: {error!r:.200}"
                _log.warning("a sample of %s can't be shown: %r", item.channel, error)
        if now_ns >= self._look_due_ns:
            self._look_due_ns = now_ns + _LOOK_NS
            for tap in self._taps.values():
                tap.check_streams()

    def _subscribe(self, wanted: frozenset[Source]) -> None:
        for source in self._taps.keys() - wanted:
            self._taps.pop(source).stop()
        for source in sorted(wanted - self._taps.keys()):
            number, channel = source
            options = Options(channels=(channel,), quality=_QUALITY)
            tap = Tap(number, self._drones[number], options, self._backlog, encoded_far=True)
            self._taps[source] = tap
            tap.start()


def give_way() -> None:
    """Lower the priority of this process and of threads that it starts later, because the flight has priority."""
    if hasattr(os, "nice"):
        os.nice(NICENESS)
