"""Lines that processes append to a file as things happen, and that outlive their death: ``TIME_NS WORD [NUMBERS]``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from skyloop.clock import monotonic_ns


@dataclass(frozen=True, slots=True)
class Entry:
    """An event at a time of this host's monotonic clock."""

    at_ns: int
    what: str
    number: int = 0


class Journal:
    """The writing end. Each line is one ``write``, so that a killed process leaves whole lines."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def write(self, what: str, number: int = 0, at_ns: int | None = None) -> None:
        """Append an entry, with the present time if none is given."""
        os.write(self._file, f"{monotonic_ns() if at_ns is None else at_ns} {what} {number}\n".encode())

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def read(path: Path) -> list[Entry]:
    """All entries, oldest first; none if the file does not exist yet."""
    if not path.exists():
        return []
    entries = []
    for line in path.read_text().splitlines():
        at_ns, what, number = line.split()
        entries.append(Entry(int(at_ns), what, int(number)))
    return sorted(entries, key=lambda entry: entry.at_ns)
