"""Log-ins that outlive the cockpit's process, so that a page comes back by itself after a restart.

They are kept in a file that only this user may read, beside the sockets of proxies. It has the hashes of cookies and
tokens, which let nobody in, and counts until the machine is started again only: times are of its monotonic clock.
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

    cookie: bytes  #: its hash
    origin: bytes  #: the hash of the token that began it; empty: a code to pair with
    role: Role
    name: str
    until_ns: int  #: on the monotonic clock


class _Content(msgspec.Struct):
    boot: str
    sessions: list[Session]


class SessionFile:
    """The file of the sessions of one cockpit.

    Args:
        path: The file; its folder may be missing.
        boot: Names the run of this machine since it was started (default: as the kernel does).
    """

    def __init__(self, path: Path, boot: str | None = None) -> None:
        self._path = path
        self._boot = _boot() if boot is None else boot

    def load(self) -> list[Session]:
        """Return the sessions; none if there is no file, or it is damaged, another user's or of before a restart."""
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
        """Replace the file; that it is not possible only means that people log in again after a restart."""
        new = self._path.with_name(f"{self._path.name}.new")
        try:
            with suppress(FileNotFoundError):
                new.unlink()
            descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(msgspec.json.encode(_Content(self._boot, list(sessions))))
            new.replace(self._path)
        except OSError as error:
            _log.warning("log-ins are not kept beyond this run of the cockpit: %s", error)


def _boot() -> str:
    with suppress(OSError):
        return _BOOT.read_text().strip()
    return ""
