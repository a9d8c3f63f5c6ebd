"""Read and write files that hold keys: access rights and atomic replacement."""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from skyloop.errors import UnsupportedError, UsageError
from skyloop.files import read_bytes

MAX_BYTES: Final = 16 << 20  #: maximum size of a file; a roster with 10 000 identities has 3 MB
_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO


def make_directory(path: Path) -> None:
    """Create a directory that only its owner can enter, or check an existing one."""
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        mode = path.stat().st_mode
    except OSError as error:
        raise UsageError(f"{path} can't be made: {error.strerror}") from None
    if mode & _OTHERS:
        raise UsageError(f"{path} is open to others (mode {stat.S_IMODE(mode):04o}): chmod 700 it")


def write(path: Path, content: bytes, *, private: bool = False) -> None:
    """Replace a file atomically. A private one is readable only by its owner, from the first byte on."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600 if private else 0o644)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UsageError(f"{path} can't be written: {error.strerror}") from None


def read(path: Path, what: str) -> bytes:
    """Read a file of at most :data:`MAX_BYTES`."""
    return read_bytes(path, what, MAX_BYTES)


def read_private(path: Path, what: str) -> bytes:
    """Read a file that must not be accessible to others, because they might have copied the key."""
    content = read(path, what)
    mode = path.stat().st_mode
    if mode & _OTHERS:
        raise UsageError(
            f"{what} {path} is open to others (mode {stat.S_IMODE(mode):04o}): chmod 600 it, and issue a new one if "
            "others may have read it"
        )
    return content


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Lock a directory against changes by other processes; wait while one of them holds the lock.

    The kernel releases the lock when the process ends.
    """
    try:
        import fcntl
    except ImportError:
        raise UnsupportedError(
            f"keys are made and revoked on Linux or macOS, but this is {sys.platform}; copy issued keys to this machine"
        ) from None
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
