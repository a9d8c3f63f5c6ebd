"""Notices when a thread that serves all vehicles does not come back from the code of one."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Final, Protocol

LOOK_S: Final = 0.05
STALL_LOOKS: Final = 5  #: 0.25 s: the other vehicles get another thread, before their pilots' silence makes them hover
HANG_LOOKS: Final = 40  #: 2 s: the vehicle is given up
_log = logging.getLogger(__name__)


class SharedLoop(Protocol):
    """A thread that runs the code of many vehicles: a ``Reactor`` or a ``Ticker``."""

    @property
    def inside(self) -> Any:
        """Whose code it is in now; None for nobody's."""

    @property
    def entries(self) -> int:
        """How often that was set."""

    @property
    def empty(self) -> bool:
        """Whether it serves nobody."""

    def close(self) -> None:
        """End the thread, unless it is stuck."""


class Watchdog:
    """Looks at shared loops 20 times a second, on a thread of its own, from :meth:`start` to :meth:`close`.

    It counts its own looks rather than the time: on a machine that stood still, or had no processor to spare, nobody
    hangs only because much time has gone by.

    Args:
        loops: Returns the loops.
        on_stall: Called with a loop and whose code it is stuck in, once per call that does not return.
        on_hang: Called with the same when it still has not.
    """

    def __init__(
        self,
        loops: Callable[[], Iterable[SharedLoop]],
        on_stall: Callable[[SharedLoop, Any], None],
        on_hang: Callable[[SharedLoop, Any], None],
    ) -> None:
        self._loops = loops
        self._on_stall = on_stall
        self._on_hang = on_hang
        self._seen: dict[SharedLoop, tuple[int, int]] = {}  # entries, and looks at which they were the same
        self._looked_s = 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-watchdog", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def close(self) -> None:
        """Look no more. Idempotent."""
        self._closing.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join()

    def look(self, now_s: float) -> None:
        """Look once.

        Args:
            now_s: The time, on a monotonic clock [s].
        """
        punctual = now_s - self._looked_s < 2 * LOOK_S
        self._looked_s = now_s
        seen: dict[SharedLoop, tuple[int, int]] = {}
        for loop in list(self._loops()):
            entries, inside = loop.entries, loop.inside
            if inside is None:
                continue
            before, looks = self._seen.get(loop, (-1, 0))
            looks = looks + punctual if before == entries else 0
            seen[loop] = entries, looks
            if punctual and before == entries and looks in (STALL_LOOKS, HANG_LOOKS):
                act = self._on_stall if looks == STALL_LOOKS else self._on_hang
                try:
                    act(loop, inside)
                except Exception:  # noqa: BLE001  it must go on to look
                    _log.exception("what was to be done about a vehicle that hangs failed")
        self._seen = seen

    def _run(self) -> None:
        while not self._closing.wait(LOOK_S):
            self.look(time.monotonic())
