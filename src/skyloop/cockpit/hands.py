"""A page's hands on a drone: a pilot's connection of its own."""

from __future__ import annotations

from typing import Any

from skyloop.client import AuthorityStatus, Drone


class Hands(Drone):
    """A pilot's connection that asks for the authority when it is told to, and not when it is opened.

    Without the authority it can stop the motors in an emergency, and nothing else.
    """

    _armed = False

    def request_authority(self, priority: int | None = None, **options: Any) -> AuthorityStatus:
        """Nothing until :meth:`take` was called."""
        return super().request_authority(priority, **options) if self._armed else self.authority

    def take(self, priority: int) -> AuthorityStatus:
        """Ask for the authority, now. Raises :class:`AuthorityError` naming who has it."""
        self._armed = True
        return self.request_authority(priority)
