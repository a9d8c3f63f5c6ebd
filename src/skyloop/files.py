"""Files at the edge: read up to a limit and decoded with one kind of error, written whole or not at all, waited for."""

from __future__ import annotations

import math
import os
import select
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Protocol, TypeVar

import msgspec

from skyloop.errors import FileFormatError, UsageError

T = TypeVar("T")

MAX_TEXT: Final = 1 << 20  #: bytes of a list that a person writes
MAX_RESULTS: Final = 256 << 20  #: bytes of a file of measurements; those of an hour take some megabytes


def read_bytes(path: str | Path, what: str, most: int) -> bytes:
    """The content of a file of at most so many bytes. ``what`` says for people what is in it.

    Raises :class:`FileFormatError` for one that can't be read, or that is larger.
    """
    try:
        with expand(path).open("rb") as file:
            content = file.read(most + 1)
    except OSError as error:
        raise FileFormatError(f"{what} {path} can't be read: {error.strerror or error}") from None
    if len(content) > most:
        raise FileFormatError(f"{what} {path} is larger than {most} bytes: it is something else")
    return content


def decoded(content: bytes) -> str:
    """A text in UTF-8, without the byte order mark that editors of Windows begin it with.

    Raises :class:`UnicodeDecodeError`.
    """
    return content.decode("utf-8-sig")


def read_text(path: str | Path, what: str, most: int) -> str:
    """The same of a text; see :func:`decoded`."""
    try:
        return decoded(read_bytes(path, what, most))
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{what} {path} is not UTF-8 text: {error}") from None


def read_json(path: str | Path, kind: type[T], what: str, most: int) -> T:
    """The same of JSON, as this type."""
    content = read_bytes(path, what, most)
    try:
        return msgspec.json.decode(decoded(content), type=kind)
    except (msgspec.MsgspecError, UsageError, UnicodeDecodeError, RecursionError) as error:
        raise FileFormatError(f"{path} is not {what}: {error}") from None


class Descriptor(Protocol):
    """Something open."""

    def fileno(self) -> int: ...


def wait_readable(source: Descriptor | int, within_s: float) -> bool:
    """Wait until a descriptor, whatever its number, can be read from or has ended. False: not within ``within_s`` [s].

    ``select.select`` raises for numbers from 1,024 on.
    """
    if not hasattr(select, "poll"):  # Windows
        return bool(select.select([source], [], [], within_s)[0])
    poll = select.poll()
    poll.register(source, select.POLLIN)
    return bool(poll.poll(math.ceil(within_s * 1000.0)))


def expand(path: str | Path) -> Path:
    """With the home directory for ``~``; one of nobody stays as it is, and is not found."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Where to write what is to be at ``path``: it is there, whole, after the block, and if that fails untouched.

    A device or a pipe is written to directly. Raises :class:`UsageError` for an ``OSError``.
    """
    place = Path(os.path.realpath(path))  # what a link points to is replaced, and the link stays
    special = place.exists() and not place.is_file()
    part = place if special else place.with_name(f".{place.stem}.{os.getpid()}{place.suffix}")
    try:
        yield part
        if not special:
            _settle(part, place)
    except OSError as error:
        raise UsageError(f"{path} can't be written: {error.strerror or error}") from error
    finally:
        if not special:
            part.unlink(missing_ok=True)


def write(path: Path, content: bytes) -> None:
    """Replace a file in one step. Raises :class:`UsageError`."""
    with replacing(path) as part:
        part.write_bytes(content)


def _settle(part: Path, place: Path) -> None:
    with part.open("rb") as file:
        os.fsync(file.fileno())
    if place.exists():
        shutil.copymode(place, part)
    part.replace(place)
