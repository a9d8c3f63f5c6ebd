"""The files in the recordings folder: rename and annotate them, move them to the trash and restore them. Blocking.

Notes on ``flight.mcap`` are stored next to it in ``flight.notes.json``. Deleted recordings are moved to the folder
``trash``, where they stay until the trash is emptied. No file is ever overwritten.
"""

from __future__ import annotations

import math
import os
import unicodedata
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from skyloop import files
from skyloop.errors import RefusedError, UnknownNameError, UsageError
from skyloop.messages import Refusal
from skyloop.recording.listing import ENDING

TRASH: Final = "trash"
NOTES_ENDING: Final = ".notes.json"
MAX_NAME: Final = 100  #: maximum length of a name [characters]
MAX_NAME_BYTES: Final = 200  #: maximum length of a name; file systems allow 255 bytes, including prefixes and suffixes
MAX_TEXT: Final = 4000  #: maximum length of a note [characters]
MAX_MARK: Final = 200  #: maximum length of a mark [characters]
MAX_MARKS: Final = 200  #: maximum number of marks per recording
MAX_AT_S: Final = 1e6  #: latest position of a mark; longer than any recording
_MOST_BYTES: Final = 1 << 20  #: maximum size of a notes file
_NOT_IN_NAMES: Final = frozenset('/\\<>:"|?*')  #: separators, and characters that other systems forbid


class Mark(msgspec.Struct, frozen=True):
    """A marked position in a recording."""

    at_s: float  #: position in the recording, like ``replay.position_s``
    text: str = ""


class Notes(msgspec.Struct, frozen=True):
    """The notes people have written about a recording."""

    text: str = ""
    marks: tuple[Mark, ...] = ()


def check_name(text: str) -> str:
    """Return the file name, with suffix, for a name typed by a person; raise ``UsageError`` if the name is invalid."""
    name = unicodedata.normalize("NFC", text).strip()
    name = name.removesuffix(ENDING).rstrip()
    for character in name:
        if character in _NOT_IN_NAMES:
            raise UsageError(f"a name can't contain {character!r}: letters, digits, spaces and -_.,()+ are fine")
        if unicodedata.category(character)[0] == "C":
            raise UsageError(f"a name can't contain the invisible character U+{ord(character):04X}")
    if not name:
        raise UsageError("the name is empty")
    if name[0] in ".-":
        raise UsageError(f"a name can't begin with {name[0]!r}")
    if len(name) > MAX_NAME or len(name.encode()) > MAX_NAME_BYTES:
        raise UsageError(f"a name has at most {MAX_NAME} characters ({MAX_NAME_BYTES} bytes), not {len(name)}")
    return name + ENDING


def notes_path(path: Path) -> Path:
    return path.with_name(path.name.removesuffix(ENDING) + NOTES_ENDING)


def read_notes(path: Path) -> Notes:
    """Return the notes of a recording. Raise ``FileFormatError`` if the notes file can't be read."""
    if not notes_path(path).exists():
        return Notes()
    return files.read_json(notes_path(path), Notes, "notes of a recording", _MOST_BYTES)


def write_text(path: Path, text: str) -> Notes:
    """Write a recording's note; an empty note removes the existing one.

    Raise ``UsageError`` if the note is too long or can't be written, and ``FileFormatError`` if the existing notes file
    can't be read, in which case it is not overwritten.
    """
    if len(text) > MAX_TEXT:
        raise UsageError(f"a note has at most {MAX_TEXT} characters, not {len(text)}")
    return _write(path, msgspec.structs.replace(read_notes(path), text=text.strip()))


def add_mark(path: Path, at_s: float, text: str) -> Notes:
    """Add a mark to a recording.

    Raise ``UsageError`` if the position is invalid, the text is too long, or there are too many marks.
    """
    if not (math.isfinite(at_s) and 0.0 <= at_s <= MAX_AT_S):
        raise UsageError(f"a mark is at 0 to {MAX_AT_S:g} s of the recording, not at {at_s!r}")
    check_mark(text)
    notes = read_notes(path)
    if len(notes.marks) >= MAX_MARKS:
        raise UsageError(f"this recording already has {MAX_MARKS} marks, the maximum: remove one first")
    marks = sorted((*notes.marks, Mark(round(at_s, 3), text.strip())), key=lambda mark: mark.at_s)
    return _write(path, msgspec.structs.replace(notes, marks=tuple(marks)))


def remove_mark(path: Path, mark: Mark) -> Notes:
    """Remove a mark. Raise ``UsageError`` if its text is too long, ``UnknownNameError`` if there is no such mark."""
    check_mark(mark.text)
    notes = read_notes(path)
    if mark not in notes.marks:
        raise UnknownNameError("mark", f"{mark.at_s:g} s {mark.text}", [f"{m.at_s:g} s {m.text}" for m in notes.marks])
    marks = list(notes.marks)
    marks.remove(mark)
    return _write(path, msgspec.structs.replace(notes, marks=tuple(marks)))


def check_mark(text: str) -> None:
    """Check that the text of a mark is valid. Raise ``UsageError`` if the text is too long."""
    if len(text) > MAX_MARK:
        raise UsageError(f"a mark has at most {MAX_MARK} characters, not {len(text)}")


def rename(path: Path, name: str) -> str:
    """Rename a recording and its notes.

    Raise ``UsageError`` if the name is invalid or the file can't be moved, and ``RefusedError`` if a file with that
    name already exists.
    """
    target = path.with_name(check_name(name))
    if target != path:
        _move(path, target)
    return target.name


def throw_away(path: Path) -> str:
    """Move a recording and its notes to the trash.

    Return the recording's name in the trash, with a number appended if its own name is taken. Raise ``UsageError`` if a
    file can't be moved.
    """
    trash = path.parent / TRASH
    try:
        trash.mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(f"the folder {trash} can't be created: {error.strerror}") from None
    for target in _numbered(trash / path.name):
        if not target.exists() and not notes_path(target).exists():
            _move(path, target)
            return target.name
    raise AssertionError("unreachable: numbers don't run out")


def bring_back(folder: Path, name: str) -> str:
    """Move a recording and its notes from the trash back into the folder.

    Raise ``UnknownNameError`` if the recording is not in the trash, ``RefusedError`` if the folder already has a file
    with that name, and ``UsageError`` if a file can't be moved.
    """
    thrown = {path.name: path for path in _recordings(folder / TRASH)}
    if name not in thrown:
        raise UnknownNameError("recording in the trash", name, thrown)
    _move(thrown[name], folder / name)
    return name


def trash_of(folder: Path) -> dict[str, int]:
    """Return the number of recordings in the trash and their total size [bytes]."""
    sizes = []
    for path in _recordings(folder / TRASH):
        with suppress(OSError):
            sizes.append(path.stat().st_size)
    return {"count": len(sizes), "bytes": sum(sizes)}


def empty_trash(folder: Path) -> None:
    """Permanently delete everything in the trash. Raise ``UsageError`` if a file can't be deleted."""
    for path in list(_recordings(folder / TRASH)):
        try:
            path.unlink(missing_ok=True)
            notes_path(path).unlink(missing_ok=True)
        except OSError as error:
            raise UsageError(f"{path} can't be deleted: {error.strerror}") from None


def _recordings(folder: Path) -> Iterator[Path]:
    with suppress(FileNotFoundError, NotADirectoryError):
        yield from (path for path in folder.iterdir() if path.suffix == ENDING)


def _numbered(path: Path) -> Iterator[Path]:
    yield path
    number = 2
    while True:
        yield path.with_name(f"{path.name.removesuffix(ENDING)} ({number}){ENDING}")
        number += 1


def _write(path: Path, notes: Notes) -> Notes:
    if notes == Notes():
        notes_path(path).unlink(missing_ok=True)
    else:
        files.write(notes_path(path), msgspec.json.format(msgspec.json.encode(notes), indent=2) + b"\n")
    return notes


def _move(path: Path, target: Path) -> None:
    """Move a recording and its notes without overwriting anything."""
    if notes_path(target).exists():
        raise RefusedError(f"notes for {target.name} already exist", code=Refusal.BUSY)
    try:
        _move_one(path, target)
        if notes_path(path).exists():
            _move_one(notes_path(path), notes_path(target))
    except FileExistsError:
        raise RefusedError(
            f"a recording {target.name} already exists: choose another name", code=Refusal.BUSY
        ) from None
    except OSError as error:
        raise UsageError(f"{path.name} can't be moved: {error.strerror}") from None


def _move_one(path: Path, target: Path) -> None:
    try:
        os.link(path, target, follow_symlinks=False)  # never overwrites, unlike a rename
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):  # the file system or the platform does not support such hard links
        if target.exists():
            raise FileExistsError from None
        path.rename(target)
    else:
        path.unlink()
