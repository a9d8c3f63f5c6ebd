"""Sessions that outlive the cockpit's process, so that after a restart a page reconnects without logging in again.

They are stored in a file that only this user may read, next to the proxies' sockets. It contains hashes of cookies and
tokens, which can't be used to log in. Its times are on the monotonic clock, so a reboot invalidates it.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from skyloop.messages import Role

MAX_BYTES: Final = 1_000_000
_BOOT: Final = Path("/proc/sys/kernel/random/boot_id")
_log = logging.getLogger(__name__)


class Session(msgspec.Struct, frozen=True):
    """One log-in."""

    cookie: bytes  #: the cookie's hash
    origin: bytes  #: hash of the token it was given for; empty if it was given for a pairing code
    role: Role
    name: str
    until_ns: int  #: expiry on the monotonic clock


class _Content(msgspec.Struct):
    boot: str
    sessions: list[Session]


class SessionFile:
    """The file that stores the sessions of one cockpit.

    Args:
        path: The file; its folder need not exist.
        boot: Identifies the current boot of the machine; by default the kernel's boot id.
    """

    def __init__(self, path: Path, boot: str | None = None) -> None:
        self._path = path
        self._boot = _boot() if boot is None else boot

    def load(self) -> list[Session]:
        """Return the sessions; none if the file is missing, damaged, another user's or from before a reboot."""
        try:
            descriptor = os.open(self._path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            with os.fdopen(descriptor, "rb") as file:
                found = os.fstat(file.fileno())
                own = found.st_uid == os.geteuid() and not found.st_mode & (stat.S_IRWXG | stat.S_IRWXO)
                content = msgspec.json.decode(file.read(MAX_BYTES), type=_Content) if own else None
        except (OSError, msgspec.DecodeError):
            return []
        return content.sessions if content is not None and self._boot and content.boot == self._boot else []

    def save(self, sessions: Iterable[Session]) -> None:
        """Replace the file. If that fails, people only have to log in again after a restart."""
        new = self._path.with_name(f"{self._path.name}.new")
        try:
            with suppress(FileNotFoundError):
                new.unlink()
            descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(msgspec.json.encode(_Content(self._boot, list(sessions))))
            new.replace(self._path)
        except OSError as error:
            _log.warning("log-ins will not survive a restart of the cockpit: %s", error)


def _boot() -> str:
    with suppress(OSError):
        return _BOOT.read_text().strip()
    return ""
