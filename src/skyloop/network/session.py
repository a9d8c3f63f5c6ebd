"""This process's Zenoh sessions. Connections with the same settings share one, for any number of drones."""

from __future__ import annotations

import atexit
import json
import logging
import os
import platform
import re
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Literal

from skyloop.errors import LinkError, MissingExtraError
from skyloop.network import config
from skyloop.network.config import FabricSettings, Part

if TYPE_CHECKING:
    import zenoh

_log = logging.getLogger(__name__)
LINGER_S: Final = 2.0  #: an unused session stays open this long, in case clients reconnect
REOPEN_S: Final = 2.0  #: time to wait for an address to become free again
CLOSE_S: Final = 5.0  #: time that the process waits at exit for a session to close
_BORROWED: Final = 1000  # number of retries when another thread is using the object …
_BORROWED_S: Final = 0.001  # … and the pause between them
#: Parts of Zenoh's error texts: positions in its source code, and text that it adds to an endpoint's address.
_PLACE: Final = re.compile(r" at (?:/|[A-Za-z]:\\\\)\S+?\.rs:\d+\.?")
_ENDPOINT: Final = re.compile(r"((?:tcp|udp|quic)/[^?\s]+)\?\w+=\w+")
_ATTEMPTS: Final = 5  # number of attempts to get a free port before another process takes it
Priority = Literal["REAL_TIME", "DATA_HIGH", "DATA", "DATA_LOW"]  #: the Zenoh priorities in use, highest first


class FabricSession:
    """A shared Zenoh session. Give it back with :func:`release`."""

    def __init__(self, settings: FabricSettings, part: Part) -> None:
        self.settings = settings
        self.part = part
        self.users = 0
        self.retired = False  #: not given to new users, because there is a better session
        self.idle_since = 0.0
        self.opened = time.monotonic()
        self.listens: list[str] = []  #: network addresses that it listens on
        self.zenoh: zenoh.Session = self._open()

    def callback(self, function: Callable[[Any], None]) -> Any:
        """Wrap a function that Zenoh calls on its thread for each sample, reply or query. It must return quickly."""
        from zenoh.handlers import Callback

        return Callback(function, indirect=False)

    def put(self, key: str, payload: bytes, attachment: bytes, priority: Priority) -> None:
        """Send a packet. It is dropped if the path is congested. Raises Zenoh's error if the session is closed."""
        z = load()
        drop, level = z.CongestionControl.DROP, getattr(z.Priority, priority)
        self.zenoh.put(key, payload, attachment=attachment, congestion_control=drop, priority=level, express=True)

    def publisher(self, key: str, priority: Priority, *, best_effort: bool) -> zenoh.Publisher:
        """Declare a publisher. Packets are dropped if the path is congested, and never resent with ``best_effort``."""
        z = load()
        reliability = z.Reliability.BEST_EFFORT if best_effort else z.Reliability.RELIABLE
        drop, level = z.CongestionControl.DROP, getattr(z.Priority, priority)
        return self.zenoh.declare_publisher(
            key, congestion_control=drop, priority=level, reliability=reliability, express=True
        )

    def peers(self) -> set[str]:
        """Return the common names in the certificates of all linked nodes; an empty set without keys."""
        try:
            return {link.auth_identifier or "" for link in self.zenoh.info.links()} - {""}
        except load().ZError:  # the session is closed
            return set()

    def shut_out(self) -> frozenset[str]:
        """Return the linked nodes that the newest roster excludes; Zenoh still applies the roster from its start."""
        ring = self.settings.ring
        return ring.shut_out & self.peers() if ring is not None and ring.shut_out else frozenset()

    def over(self, now: float) -> bool:
        """Return whether the session has been unused for long enough to close it. Called only by the pool."""
        return self.retired or now - self.idle_since >= LINGER_S

    def close(self) -> None:
        """Close the Zenoh session. For use by the pool."""
        try:
            self.zenoh.close()  # type: ignore[no-untyped-call]
        except Exception as error:  # noqa: BLE001  (nothing more can be done)
            _log.warning("closing a network session failed: %s", error)

    def _open(self) -> Any:
        zenoh_module = load()
        listens = self.part is not Part.APP
        for attempt in range(_ATTEMPTS):
            self.listens = config.listening(self.settings) if listens else list(self.settings.listen)
            sections = config.make(self.settings, self.part, config.endpoints_of(self.listens, self.settings))
            try:
                return zenoh_module.open(configure(sections))
            except zenoh_module.ZError as error:
                # Another process may have taken the free port. Only in that case can another attempt help.
                if attempt == _ATTEMPTS - 1 or not any(each.endswith(":0") for each in self.settings.listen or (":0",)):
                    raise LinkError(f"cannot join the network: {reason_of(error)}") from None
        raise AssertionError("unreachable")


def reason_of(error: BaseException) -> str:
    """Return the text of a Zenoh error, without positions in Zenoh's source code and the internal form of endpoints."""
    text = _PLACE.sub("", str(error))
    return _ENDPOINT.sub(r"\1", text).replace("failed to lookup address information", "the host's name is unknown")


class _Pool:
    """All of this process's sessions. A thread closes unused sessions, and ends when none are left."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._sessions: list[FabricSession] = []
        self._closing = 0  # number of sessions that are being closed and are no longer in the list
        self._over = False  # the process is exiting
        self._reaper: threading.Thread | None = None

    def acquire(self, settings: FabricSettings, part: Part) -> FabricSession:
        """Return a session with these settings, opening one if necessary."""
        with self._changed:
            if self._over:
                raise LinkError("the network can't be joined: this process is exiting")
            for session in self._sessions:
                same = (session.settings, session.part) == (settings, part)
                if same and not session.retired and not session.zenoh.is_closed():
                    session.users += 1
                    return session
            session = FabricSession(settings, part)
            session.users = 1
            self._sessions.append(session)
            return session

    def release(self, session: FabricSession, *, linger: bool = True) -> None:
        """Give a session back. Once unused, the session stays open for :data:`LINGER_S` if it may linger."""
        with self._changed:
            session.users -= 1
            session.idle_since = time.monotonic() if linger else -LINGER_S
            at_once = not linger and session.users == 0
            if at_once:
                self._take_out(session)
            elif self._reaper is None:
                self._reaper = threading.Thread(target=self._reap, name="skyloop-fabric-sessions", daemon=True)
                self._reaper.start()
            self._changed.notify()
        if at_once:
            self._close(session)

    def retire(self, session: FabricSession) -> None:
        """Give new users another session from now on. This session closes once its last user has left."""
        with self._changed:
            session.retired = True

    def close_all(self) -> None:
        """Close all sessions when the process ends.

        Zenoh's threads must not call into an interpreter that is gone, and none of our threads may be inside Zenoh.
        When such a thread returns to Python, an exception ends it. That exception can't pass through native code, so
        the process would abort ("FATAL: exception not rethrown").
        """
        with self._changed:
            self._over = True
            for session in self._sessions:
                session.close()
            self._sessions.clear()
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._closing, CLOSE_S)

    def _take_out(self, session: FabricSession) -> None:
        """Start closing a session. The caller holds the lock. The caller must then call :meth:`_close`."""
        self._sessions.remove(session)
        self._closing += 1

    def _close(self, session: FabricSession) -> None:
        """Close a session outside the lock, because closing may wait for the network."""
        try:
            session.close()
        finally:
            with self._changed:
                self._closing -= 1
                self._changed.notify_all()

    def _reap(self) -> None:
        while True:
            with self._changed:
                if not any(session.users == 0 for session in self._sessions):
                    self._reaper = None
                    return
                now = time.monotonic()
                over = [session for session in self._sessions if session.users == 0 and session.over(now)]
                for session in over:
                    self._take_out(session)
            for session in over:
                self._close(session)
            with self._changed:
                self._changed.wait(LINGER_S / 4)


_POOL: Final = _Pool()
acquire = _POOL.acquire
release = _POOL.release
retire = _POOL.retire


def _close_all(process: int) -> None:
    if process == os.getpid():  # a forked process has none of the sessions' threads
        _POOL.close_all()


atexit.register(_close_all, os.getpid())


def load() -> Any:
    """Import the package ``zenoh`` and return it. Raises :class:`MissingExtraError` if it is not installed."""
    try:
        import zenoh
    except ImportError as error:
        raise MissingExtraError("the network", "network", cause=str(error)) from None
    return zenoh


def host_name() -> str:
    return platform.node()[:64] or "?"


def renewed(session: FabricSession) -> FabricSession:
    """Replace a session that has no other users with a session at the same addresses that uses the newest roster.

    All links of the session are closed and re-established. Raises :class:`LinkError` if the keys were revoked, or if an
    address does not become free again within :data:`REOPEN_S`.
    """
    settings = replace(session.settings.current(), listen=tuple(session.listens))
    release(session, linger=False)
    deadline = time.monotonic() + REOPEN_S
    while True:
        try:
            return acquire(settings, session.part)
        except LinkError:  # the ports will soon become free
            if time.monotonic() > deadline:
                raise
            time.sleep(_BORROWED_S)


def undeclare(held: Iterable[Any]) -> None:
    """Undeclare a session's declarations in reverse order. Must not be called on Zenoh's threads."""
    ended: type[Exception] = load().ZError
    for each in reversed([*held]):
        for _ in range(_BORROWED):
            try:
                each.undeclare()
            except ended:  # the session has ended, and its declarations with it
                break
            except RuntimeError:  # "Already borrowed": another thread is sending with the object
                time.sleep(_BORROWED_S)
            else:
                break


def configure(sections: dict[str, Any]) -> zenoh.Config:
    """Convert a configuration's sections to Zenoh's own form."""
    found = load().Config()
    for path, value in _leaves("", sections):
        found.insert_json5(path, json.dumps(value))
    return found  # type: ignore[no-any-return]


def _leaves(path: str, value: Any) -> list[tuple[str, Any]]:
    """Split sections so that missing values keep their defaults. Some sections can only be set as a whole."""
    if isinstance(value, dict) and not path.endswith(("access_control", "autoconnect", "gateway", "retry")):
        return [leaf for key, inner in value.items() for leaf in _leaves(f"{path}/{key}" if path else key, inner)]
    return [(path, value)]
