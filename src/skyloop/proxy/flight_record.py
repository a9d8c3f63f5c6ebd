"""The note of a flight that this proxy began, in a file: a proxy that was killed ends its own flight when it is back.

Written when a flight becomes the proxy's, kept young while it lasts, removed when it is over, somebody else's, or not
looked for any more. A note is believed for :data:`LIFE_S`: after that somebody else may have begun another flight.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from skyloop.clock import seconds
from skyloop.proxy.core.flight import BELIEF_NS

LIFE_S: Final = seconds(
    BELIEF_NS
)  #: a supervisor starts a proxy again within seconds, and nobody changes the pilot then
KEEP_S: Final = 2.0  #: how often it is made young
CLOSE_S: Final = 2.0  #: how long the end of a proxy waits for the file
MAX_BYTES: Final = 4096  #: of an address; a longer file is none of ours
SUFFIX: Final = ".flight"

_log = logging.getLogger(__name__)


def record_path(name: str) -> Path:
    """The file of a proxy: beside its socket, where only its user may write."""
    from skyloop.transport.local.directory import find_directory

    return find_directory().path / (name + SUFFIX)


class FlightRecord:
    """The file of one proxy, written on a thread of its own from :meth:`start` to :meth:`close`.

    Args:
        path: the file.
        vehicle: the vehicle's address: a note about another vehicle is not believed.
        wall: the wall clock [s].
    """

    def __init__(self, path: Path, vehicle: str, wall: Callable[[], float] = time.time) -> None:
        self.path = path
        self._vehicle = vehicle
        self._wall = wall
        self._ours: bool | None = None  # not known yet: the note stays as it is
        self._written = False
        self._failed = False
        self._closing = False
        self._changed = threading.Event()
        self._thread: threading.Thread | None = None

    def believed(self) -> bool:
        """Return whether an earlier run of this proxy flew this vehicle a moment ago. Call before :meth:`start`."""
        return self.left_s() > 0.0

    def left_s(self) -> float:
        """Return for how long the flight of an earlier run may still be found [s]; 0: there is none."""
        try:
            age_s = self._wall() - self.path.stat().st_mtime
            with self.path.open(encoding="utf-8") as file:
                content = file.read(MAX_BYTES)
        except (OSError, ValueError):
            return 0.0
        believed = content == self._vehicle and -1.0 <= age_s <= LIFE_S  # a clock is no better than that
        return LIFE_S - max(0.0, age_s) if believed else 0.0

    def start(self) -> None:
        """Start to write."""
        self._thread = threading.Thread(target=self._run, name="skyloop-flight-record", daemon=True)
        self._thread.start()

    def set(self, ours: bool) -> None:
        """Record whether the flight is this proxy's now. Any thread; never waits."""
        if ours is not self._ours:
            self._ours = ours
            self._changed.set()

    def close(self) -> None:
        """Write the last word. What is left in the air stays noted, so that a new run of the proxy can end it."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._closing = True
            self._changed.set()
            thread.join(CLOSE_S)  # a file system may hang: the proxy's end does not

    def _run(self) -> None:
        closing = False
        while not closing:
            self._changed.wait(KEEP_S if self._ours else None)
            self._changed.clear()
            closing = self._closing  # before the last word is read: what is set while it is written is written too
            try:
                self._write()
            except OSError as error:
                if not self._failed:
                    self._failed = True
                    _log.warning("the note of this flight, %s, can't be written: %s", self.path, error)

    def _write(self) -> None:
        if self._ours and self._written:
            os.utime(self.path)
        elif self._ours:
            beside = self.path.with_suffix(f"{SUFFIX}.{os.getpid()}")
            beside.write_text(self._vehicle, encoding="utf-8")
            beside.replace(self.path)
            self._written = True
        elif self._ours is not None:
            self.path.unlink(missing_ok=True)
            self._written = False
