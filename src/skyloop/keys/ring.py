"""A process's keys while it runs: what is to be told of them, and who is shut out by a newer roster."""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from typing import Final

from skyloop.errors import UsageError
from skyloop.keys.credentials import Credentials

AGAIN: Final = timedelta(hours=1)  #: how often an end that is near is told


class KeyRing:
    """Looks at the folder of keys now and then. One thread calls :meth:`look`; ``shut_out`` may be read by any."""

    def __init__(self, credentials: Credentials) -> None:
        self.credentials = credentials
        #: Names that were revoked, or whose rights were changed, after this process took its roster into force.
        self.shut_out: frozenset[str] = frozenset()
        self._in_force = credentials.roster
        self._stamp = _stamp(credentials)
        self._told: dict[str, datetime] = {}

    def look(self, now: datetime | None = None) -> list[str]:
        """What people should know now, a sentence each: what ends within a week, once an hour, and a newer roster.

        A roster that can't be read changes nothing but that it is told.
        """
        now = now or datetime.now(UTC)
        return [*self._ends(now), *self._news()]

    def _ends(self, now: datetime) -> list[str]:
        ends = self.credentials.ends(now)
        due = [what for what in ends if what not in self._told or now - self._told[what] >= AGAIN]
        self._told.update(dict.fromkeys(due, now))
        return [ends[what] for what in due]

    def _news(self) -> list[str]:
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
        self.credentials = renewed
        before, after = set(self._in_force.identities), set(renewed.roster.identities)
        self.shut_out = frozenset(identity.name for identity in before - after)
        if before == after:
            return []
        gone = f"; revoked or changed: {', '.join(sorted(self.shut_out))}" if self.shut_out else ""
        number = renewed.roster.number
        return [f"the lab's roster has changed (number {number}){gone}; all of it counts when this is started anew"]


def _stamp(credentials: Credentials) -> tuple[int, int, int]:
    """Changes with the file."""
    try:
        found = os.stat(credentials.roster_file)  # noqa: PTH116  cheaper, and it is done every second
    except OSError:
        return 0, 0, 0
    return found.st_mtime_ns, found.st_size, found.st_ino
