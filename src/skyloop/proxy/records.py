"""Files that a proxy writes, each on its own thread: the audit trail, and the note of its flight.

The audit trail says who flew when, one JSON object a line, only ever appended to. ``docs/sharing.md`` describes it.
:func:`entry_of` and :func:`tenures` are pure: events to lines, and lines to a table.

The note says that a flight is this proxy's: one that was killed ends its own flight when it is back. It is written when
a flight becomes the proxy's, kept young while it lasts, and removed when it is over, somebody else's, or not looked for
any more. It is believed for :data:`LIFE_S`: after that somebody else may have begun another flight.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from typing import Final

import msgspec

from skyloop.clock import seconds
from skyloop.errors import UsageError
from skyloop.messages import Event, EventKind, FlightState
from skyloop.proxy.core.flight import BELIEF_NS

CLOSE_S: Final = 2.0  #: how long the end of a proxy waits for each file
FOLDER: Final = "audit"
SUFFIX: Final = ".jsonl"
_MODE: Final = 0o600

#: How long a note is believed: a supervisor restarts a proxy within seconds, before anybody changes the pilot.
LIFE_S: Final = seconds(BELIEF_NS)
KEEP_S: Final = 2.0  #: how often it is made young
MAX_BYTES: Final = 4096  #: of an address; a longer file is none of ours
NOTE_SUFFIX: Final = ".flight"

_log = logging.getLogger(__name__)


class Entry(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line. Which of the fields there are, depends on ``what``."""

    at: datetime  #: wall-clock time, UTC
    proxy: str
    run: str  #: of the proxy, at random
    what: str  #: ``begin``, ``granted``, ``ended``, ``takeoff``, ``landed``, ``emergency`` or ``end``
    who: str = ""  #: name of the application
    identity: str = ""  #: what the transport knows of it: process and user, or a certificate's name
    lease: int = 0
    priority: int = 0
    how: str = ""  #: why a lease, or the run, ended; the vehicle's address at the begin of a run


class Tenure(msgspec.Struct, frozen=True):
    """From a grant to its end."""

    proxy: str
    who: str
    identity: str
    priority: int
    begin: datetime
    end: datetime | None  #: None: it goes on, or the proxy was killed
    how: str  #: how it ended; empty: not ended, as far as the file shows
    takeoffs: int = 0


def entry_of(event: Event, at: datetime, proxy: str, run: str) -> Entry | None:
    """The line of an event; None for one that is no part of who flew when."""
    data, who = event.data, event.app or ""
    lease = data.get("lease")
    numbered = Entry(at, proxy, run, "", who, lease=lease if isinstance(lease, int) else 0)
    filled = msgspec.structs.replace
    if event.kind is EventKind.AUTHORITY_GRANTED:
        priority = data.get("priority")
        number = priority if isinstance(priority, int) else 0
        return filled(numbered, what="granted", identity=str(data.get("identity", "")), priority=number)
    if event.kind is EventKind.AUTHORITY_LOST:
        return filled(numbered, what="ended", how=str(data.get("reason", "")))
    if event.kind is EventKind.AUTHORITY_PREEMPTED:
        verb = "handed over to" if data.get("granted") else "taken over by"
        return filled(numbered, what="ended", how=f"{verb} {data.get('by', '')}")
    if event.kind is EventKind.STATE_CHANGED:
        return _of_state(filled(numbered, who="", lease=0), data.get("before"), data.get("after"))
    if event.kind is EventKind.EMERGENCY:
        return filled(numbered, what="emergency", how=event.text)
    return filled(numbered, what="end", how=event.text) if event.kind is EventKind.PROXY_CLOSING else None


def _of_state(entry: Entry, before: object, after: object) -> Entry | None:
    states = frozenset(FlightState)
    if before not in states or after not in states:
        return None
    was, now = FlightState(str(before)).airborne, FlightState(str(after)).airborne
    if was is now or (now and before != FlightState.LANDED):
        return None
    return msgspec.structs.replace(entry, what="takeoff" if now else "landed")


def tenures(entries: Iterable[Entry]) -> list[Tenure]:
    """Who held the authority from when to when, in the order of the grants; entries of several proxies may be mixed."""
    done: list[Tenure] = []
    held: dict[str, int] = {}
    for entry in entries:
        place = held.get(entry.proxy)
        if entry.what == "granted":
            held[entry.proxy] = len(done)
            begun = (entry.proxy, entry.who, entry.identity, entry.priority, entry.at)
            done.append(Tenure(*begun, end=None, how=""))
        elif place is None:
            continue
        elif entry.what == "takeoff":
            done[place] = msgspec.structs.replace(done[place], takeoffs=done[place].takeoffs + 1)
        elif entry.what in ("ended", "end", "begin"):
            del held[entry.proxy]
            how = {"ended": entry.how, "end": "the proxy ended", "begin": "the proxy was killed"}[entry.what]
            ended = entry.at if entry.what != "begin" else None
            done[place] = msgspec.structs.replace(done[place], end=ended, how=how)
    return done


def read(path: Path) -> tuple[list[Entry], int]:
    """The entries of a file, and how many of its lines can't be understood (as one that a crash has torn).

    Raises :class:`UsageError` for a file that can't be read.
    """
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise UsageError(f"the audit trail {path} can't be read: {error.strerror}") from None
    entries, bad = [], 0
    for line in lines:
        try:
            entries.append(msgspec.json.decode(line, type=Entry))
        except (msgspec.DecodeError, RecursionError):
            bad += 1
    return entries, bad


def audit_folder() -> Path:
    """Where the files are by default: in the user's state directory."""
    import platformdirs

    return Path(platformdirs.user_state_dir("skyloop", appauthor=False)) / FOLDER


def audit_path(name: str) -> Path:
    """The file of a proxy."""
    return audit_folder() / (name + SUFFIX)


class AuditTrail:
    """Writes the lines of one proxy's run, on a thread of its own: :meth:`note` never waits for the disk."""

    def __init__(self, path: Path, proxy: str, run: str, wall: Callable[[], datetime] | None = None) -> None:
        """Opens the file. Raises ``OSError``."""
        self.path = path
        self._proxy = proxy
        self._run = run
        self._wall = wall or (lambda: datetime.now(UTC))
        self._queue: SimpleQueue[Entry | None] = SimpleQueue()
        self._failed = False
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, _MODE)
        self._thread = threading.Thread(target=self._write_all, name="skyloop-audit", daemon=True)
        self._thread.start()

    def begin(self, uri: str) -> None:
        """The proxy's run begins."""
        self._queue.put(Entry(self._wall(), self._proxy, self._run, "begin", how=uri))

    def note(self, event: Event) -> None:
        """Take an event. Any thread."""
        entry = entry_of(event, self._wall(), self._proxy, self._run)
        if entry is not None:
            self._queue.put(entry)

    def close(self) -> None:
        """Write the remaining lines, for :data:`CLOSE_S` at most."""
        self._queue.put(None)
        self._thread.join(CLOSE_S)

    def _write_all(self) -> None:
        try:
            while (entry := self._queue.get()) is not None:
                self._write(msgspec.json.encode(entry) + b"\n")
        finally:
            os.close(self._file)

    def _write(self, line: bytes) -> None:
        try:
            os.write(self._file, line)  # one call, so that lines of several writers do not mix
            self._failed = False
        except OSError as error:
            if not self._failed:  # a full disk is logged once, and the flight goes on
                _log.error("the audit trail %s can't be written: %s", self.path, error)
            self._failed = True


# The note of a flight --------------------------------------------------------------------------------------------


def record_path(name: str) -> Path:
    """The file of a proxy: beside its socket, where only its user may write."""
    from skyloop.transport.local.directory import find_directory

    return find_directory().path / (name + NOTE_SUFFIX)


class FlightRecord:
    """The file of one proxy, written on a thread of its own from :meth:`start` to :meth:`close`.

    ``vehicle``: its address, as a note about another vehicle is not believed; ``wall``: the wall clock [s].
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

    def left_s(self) -> float:
        """Return for how long the flight of an earlier run may still be found [s]; 0: there is none.

        Call before :meth:`start`.
        """
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
            beside = self.path.with_suffix(f"{NOTE_SUFFIX}.{os.getpid()}")
            beside.write_text(self._vehicle, encoding="utf-8")
            beside.replace(self.path)
            self._written = True
        elif self._ours is not None:
            self.path.unlink(missing_ok=True)
            self._written = False
