"""Disks that fill up, hang or vanish on a test's command."""

from __future__ import annotations

import errno
import threading
from pathlib import Path
from typing import Any, cast

from skyloop.recording.writer import Target


class Disk:
    """Creates files that share its room: :meth:`open` is the opener, :meth:`free` the room left."""

    def __init__(self, room: int = 10**9) -> None:
        self.room = room  #: bytes left
        self.moving = threading.Event()  #: writing waits until set
        self.moving.set()
        self.writing = threading.Event()  #: a write has begun

    def open(self, path: Path, overwrite: bool) -> Target:
        return cast(Target, _File(self, path.open("wb" if overwrite else "xb", buffering=0)))

    def free(self, folder: Path) -> int:
        if not folder.is_dir():
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", str(folder))
        return self.room


class _File:
    """Writes as much as there is room for, like a real disk, then raises "disk full"."""

    def __init__(self, disk: Disk, file: Any) -> None:
        self._disk = disk
        self._file = file

    def write(self, data: Any) -> int:
        self._disk.writing.set()
        assert self._disk.moving.wait(10.0)
        size = min(len(data), self._disk.room)
        if not size:
            raise OSError(errno.ENOSPC, "No space left on device")
        self._disk.room -= size
        return int(self._file.write(data[:size]))

    def truncate(self, size: int | None = None) -> int:
        before = self._file.seek(0, 2)
        after = int(self._file.truncate(size))
        self._disk.room += before - after
        return after

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
