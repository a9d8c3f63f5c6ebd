"""What the parts of a drone share."""

from __future__ import annotations

from skyloop.client.link import Link
from skyloop.client.reception import Reception
from skyloop.errors import ClosedError, UsageError


class Handle:
    """An open link and what arrives over it; a drone is made of this, of its commands and of its readings."""

    _app: str  # name of the application
    _link: Link
    _reception: Reception

    def __init__(self) -> None:
        self._closed = False

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedError("this drone was closed: connect again")

    def _check_may_wait(self) -> None:
        if self._link.receiving:
            raise UsageError("an inline listener can't wait for what it would itself have to receive")
