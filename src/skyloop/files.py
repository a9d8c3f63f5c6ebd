"""Access files: bounded reading and decoding with one kind of error, and atomic replacement."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from skyloop.errors import FileFormatError, UsageError
from skyloop.platform import change_file

T = TypeVar("T")

MAX_TEXT: Final = 1 << 20  #: maximum size of a hand-written list [bytes]
MAX_RESULTS: Final = 256 << 20  #: maximum size of a file of measurements [bytes]; an hour takes a few megabytes


def read_bytes(path: str | Path, what: str, most: int) -> bytes:
    """Read a file of at most ``most`` bytes. ``what`` describes the content in error messages.

    Raises :class:`FileFormatError` if the file can't be read or is larger.
    """
    try:
        with expand(path).open("rb") as file:
            content = file.read(most + 1)
    except OSError as error:
        raise FileFormatError(f"{what} {path} can't be read: {error.strerror or error}") from None
    if len(content) > most:
        raise FileFormatError(f"{what} {path} is larger than {most} bytes, the limit")
    return content


def decoded(content: bytes) -> str:
    """Decode UTF-8, and drop the byte order mark that Windows editors add. Raises :class:`UnicodeDecodeError`."""
    return content.decode("utf-8-sig")


def read_text(path: str | Path, what: str, most: int) -> str:
    """Read a text file with the limits of :func:`read_bytes`; see :func:`decoded`."""
    try:
        return decoded(read_bytes(path, what, most))
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{what} {path} is not UTF-8 text: {error}") from None


def read_json(path: str | Path, kind: type[T], what: str, most: int) -> T:
    """Read a JSON file as an instance of ``kind``, with the limits of :func:`read_bytes`."""
    content = read_bytes(path, what, most)
    try:
        return msgspec.json.decode(decoded(content), type=kind)
    except (msgspec.MsgspecError, UsageError, UnicodeDecodeError, RecursionError) as error:
        raise FileFormatError(f"{path} is not {what}: {error}") from None


def expand(path: str | Path) -> Path:
    """Expand ``~`` to the home directory; leave the path of an unknown user unchanged, so that it won't be found."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` after the block; on failure, ``path`` stays unchanged.

    Devices and pipes are written to directly. Raises :class:`UsageError` instead of ``OSError``.
    """
    place = Path(os.path.realpath(path))  # if it is a link, replace the link's target and leave the link in place
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
    """Replace a file in a single step. Raises :class:`UsageError`."""
    with replacing(path) as part:
        part.write_bytes(content)


def _settle(part: Path, place: Path) -> None:
    with part.open("r+b") as file:  # Windows flushes only files that are open for writing
        os.fsync(file.fileno())
    if place.exists():
        shutil.copymode(place, part)
    change_file(lambda: part.replace(place))
