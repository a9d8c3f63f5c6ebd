"""A process's keys while it runs: what people should know of them, and who is shut out by a newer roster."""

from __future__ import annotations

import os
import threading
from datetime import UTC, datetime, timedelta
from typing import Final

from skyloop.errors import UsageError
from skyloop.network.keys.credentials import Credentials
from skyloop.network.keys.identity import Identity
from skyloop.network.keys.roster import Roster

AGAIN: Final = timedelta(hours=1)  #: how often an expiry that is near is announced


class KeyRing:
    """Reads the folder of keys from time to time. All methods may be called from any thread.

    Args:
        credentials: As loaded; their roster is the one in force.
    """

    def __init__(self, credentials: Credentials) -> None:
        self.credentials = credentials
        #: Names that were revoked, or whose rights were changed, after this process took its roster into force.
        self.shut_out: frozenset[str] = frozenset()
        self._in_force = credentials.roster
        self._listed = frozenset(credentials.roster.identities)  # by the newest roster
        self._stamp = _stamp(credentials)
        self._announced: dict[str, datetime] = {}
        self._pending: list[str] = []
        self._lock = threading.Lock()

    @property
    def roster(self) -> Roster:
        """The newest roster that was read."""
        return self.credentials.roster

    @property
    def outdated(self) -> bool:
        """Whether the newest roster differs from the one that this process took into force."""
        return self._listed != frozenset(self._in_force.identities)

    def admits(self, identity: Identity) -> bool:
        """Return whether the newest roster has this identity with these rights, and it was not shut out before."""
        return identity in self._listed and identity.name not in self.shut_out

    def refresh(self) -> None:
        """Read the roster if its file has changed; messages about that are kept for :meth:`poll`."""
        with self._lock:
            self._pending += self._read()

    def poll(self, now: datetime | None = None) -> list[str]:
        """Read the roster if its file has changed, and return what people should know now.

        That is what expires within a week, once an hour, and a newer roster. A roster that can't be read is reported
        and changes nothing.

        Args:
            now: The time in UTC; by default of this machine.

        Returns:
            A sentence for each.
        """
        now = now or datetime.now(UTC)
        with self._lock:
            changes, self._pending = [*self._pending, *self._read()], []
            return [*self._ending(now), *changes]

    def _ending(self, now: datetime) -> list[str]:
        ends = self.credentials.ends(now)
        due = [what for what in ends if what not in self._announced or now - self._announced[what] >= AGAIN]
        self._announced.update(dict.fromkeys(due, now))
        return [ends[what] for what in due]

    def _read(self) -> list[str]:
        stamp = _stamp(self.credentials)
        if stamp == self._stamp:
            return []
        self._stamp = stamp
        try:
            renewed = self.credentials.renewed()
        except UsageError as error:
            return [f"{error}; the roster that was read before stays in force"]
        if renewed is None:
            return []
        before, after = frozenset(self._in_force.identities), frozenset(renewed.roster.identities)
        self.shut_out = frozenset(identity.name for identity in before - after)
        self._listed = after
        self.credentials = renewed
        if before == after:
            return []
        gone = f"; revoked or changed: {', '.join(sorted(self.shut_out))}" if self.shut_out else ""
        number = renewed.roster.number
        return [f"the lab's roster has changed (number {number}){gone}; restart this program to apply all of it"]


def _stamp(credentials: Credentials) -> tuple[int, int, int]:
    """Return what changes with the roster's file."""
    try:
        found = os.stat(credentials.roster_file)  # noqa: PTH116  cheaper, and it is done every second
    except OSError:
        return 0, 0, 0
    return found.st_mtime_ns, found.st_size, found.st_ino
