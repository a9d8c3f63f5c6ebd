"""Write a proxy's files, each on a separate thread: the audit trail, and the note about the proxy's flight.

The audit trail records who flew when, as one JSON object per line. Lines are only appended. ``docs/sharing.md``
describes it. :func:`entry_of` and :func:`tenures` are pure: they turn events into lines, and lines into a table.

The note records that a flight belongs to this proxy, so that a proxy that was killed and restarted ends its own flight.
It is written when a flight becomes the proxy's, and refreshed during the flight. It is removed when the flight is over,
is someone else's, or can no longer turn up. It is valid for :data:`LIFE_S`. After that time, others may have taken off.
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

CLOSE_S: Final = 2.0  #: time to wait for each file when a proxy ends
FOLDER: Final = "audit"
SUFFIX: Final = ".jsonl"
_MODE: Final = 0o600  # only the user may read the trail

#: How long a note is valid. Supervisors restart a proxy within seconds, before another pilot takes over.
LIFE_S: Final = seconds(BELIEF_NS)
KEEP_S: Final = 2.0  #: how often the note is refreshed
MAX_BYTES: Final = 4096  #: maximum length of an address; a longer file can't be ours
NOTE_SUFFIX: Final = ".flight"

_log = logging.getLogger(__name__)


class AuditEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of an audit trail. The line's other fields depend on ``what``."""

    at: datetime  #: wall-clock time, UTC
    proxy: str
    run: str  #: random identity of the proxy's run
    what: str  #: ``begin``, ``granted``, ``ended``, ``takeoff``, ``landed``, ``emergency`` or ``end``
    who: str = ""  #: name of the application
    identity: str = ""  #: what the transport knows about it: process and user, or the name in its certificate
    lease: int = 0
    priority: int = 0
    how: str = ""  #: why a lease or the run ended; for ``begin``, the vehicle's address


class Tenure(msgspec.Struct, frozen=True):
    """The period during which an application held the authority, from a grant to its end."""

    proxy: str
    who: str
    identity: str
    priority: int
    begin: datetime
    end: datetime | None  #: None if the tenure continues, or if the proxy was killed
    how: str  #: why it ended; empty if, according to the file, it has not ended
    takeoffs: int = 0


def entry_of(event: Event, at: datetime, proxy: str, run: str) -> AuditEntry | None:
    """Return the line for an event; None if the trail does not record such events."""
    data, who = event.data, event.app or ""
    lease = data.get("lease")
    numbered = AuditEntry(at, proxy, run, "", who, lease=lease if isinstance(lease, int) else 0)
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


def _of_state(entry: AuditEntry, before: object, after: object) -> AuditEntry | None:
    states = frozenset(FlightState)
    if before not in states or after not in states:
        return None
    was, now = FlightState(str(before)).airborne, FlightState(str(after)).airborne
    if was is now or (now and before != FlightState.LANDED):
        return None
    return msgspec.structs.replace(entry, what="takeoff" if now else "landed")


def tenures(entries: Iterable[AuditEntry]) -> list[Tenure]:
    """Return all tenures in the order of their grants. Entries of several proxies may be mixed."""
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


def read(path: Path) -> tuple[list[AuditEntry], int]:
    """Return a file's entries, and the number of unreadable lines (for example, lines cut off by a crash)."""
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise UsageError(f"the audit trail {path} can't be read: {error.strerror}") from None
    entries, bad = [], 0
    for line in lines:
        try:
            entries.append(msgspec.json.decode(line, type=AuditEntry))
        except (msgspec.DecodeError, RecursionError):
            bad += 1
    return entries, bad


def audit_folder() -> Path:
    """Return the default folder of the files, in the user's state directory."""
    import platformdirs

    return Path(platformdirs.user_state_dir("skyloop", appauthor=False)) / FOLDER


def audit_path(name: str) -> Path:
    return audit_folder() / (name + SUFFIX)


class AuditTrail:
    """Writes the lines about one run of a proxy on a separate thread, so that :meth:`note` never waits for the disk."""

    def __init__(self, path: Path, proxy: str, run: str, wall: Callable[[], datetime] | None = None) -> None:
        """Open the file. Raises ``OSError``."""
        self.path = path
        self._proxy = proxy
        self._run = run
        self._wall = wall or (lambda: datetime.now(UTC))
        self._queue: SimpleQueue[AuditEntry | None] = SimpleQueue()
        self._failed = False
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0), _MODE)
        self._thread = threading.Thread(target=self._write_all, name="skyloop-audit", daemon=True)
        self._thread.start()

    def begin(self, uri: str) -> None:
        self._queue.put(AuditEntry(self._wall(), self._proxy, self._run, "begin", how=uri))

    def note(self, event: Event) -> None:
        """Record an event. Thread-safe."""
        if (entry := entry_of(event, self._wall(), self._proxy, self._run)) is not None:
            self._queue.put(entry)

    def close(self) -> None:
        """Write the remaining lines. Writing takes at most :data:`CLOSE_S`."""
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
            os.write(self._file, line)  # a single call, so that lines from several writers do not mix
            self._failed = False
        except OSError as error:
            if not self._failed:  # a full disk is logged once, and the flight continues
                _log.error("the audit trail %s can't be written: %s", self.path, error)
            self._failed = True


# The note of a flight --------------------------------------------------------------------------------------------


def record_path(name: str) -> Path:
    """Return the path of a proxy's note, next to its socket, where only the proxy's user may write."""
    from skyloop.transport.local.directory import find_directory

    return find_directory().path / (name + NOTE_SUFFIX)


class FlightRecord:
    """The note about one proxy's flight, written by a separate thread from :meth:`start` to :meth:`close`.

    ``vehicle``: the vehicle's address; notes about other vehicles are ignored. ``wall``: the wall clock [s].
    """

    def __init__(self, path: Path, vehicle: str, wall: Callable[[], float] = time.time) -> None:
        self.path = path
        self._vehicle = vehicle
        self._wall = wall
        self._ours: bool | None = None  # None while unknown: the note then stays unchanged
        self._written = False
        self._failed = False
        self._closing = False
        self._changed = threading.Event()
        self._thread: threading.Thread | None = None

    def left_s(self) -> float:
        """Return for how much longer an earlier run's flight may turn up [s]; 0: none. Call before :meth:`start`."""
        try:
            age_s = self._wall() - self.path.stat().st_mtime
            with self.path.open(encoding="utf-8") as file:
                content = file.read(MAX_BYTES)
        except (OSError, ValueError):
            return 0.0
        believed = content == self._vehicle and -1.0 <= age_s <= LIFE_S  # tolerance for an inaccurate clock
        return LIFE_S - max(0.0, age_s) if believed else 0.0

    def start(self) -> None:
        self._thread = threading.Thread(target=self._run, name="skyloop-flight-record", daemon=True)
        self._thread.start()

    def set(self, ours: bool) -> None:
        """Record whether the flight belongs to this proxy. Thread-safe. Never waits."""
        if ours is not self._ours:
            self._ours = ours
            self._changed.set()

    def close(self) -> None:
        """Write the final state. The note stays if the vehicle is left in the air, so that the next run can end it."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._closing = True
            self._changed.set()
            thread.join(CLOSE_S)  # a file system may hang, but the proxy must still end

    def _run(self) -> None:
        closing = False
        while not closing:
            self._changed.wait(KEEP_S if self._ours else None)
            self._changed.clear()
            closing = self._closing  # read this before the state, so that a change during the write is not missed
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
