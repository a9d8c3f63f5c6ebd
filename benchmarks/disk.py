"""A disk that a recorder fills within moments."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from skyloop.errors import UsageError

DISK_MB: Final = 3  #: noise of 640x480, recorded as JPEG 30 times a second, fills it within half a second
MOST_FREE_MB: Final = 16  #: of a folder that stands in for it


@contextmanager
def small_disk(instead: Path | None = None) -> Iterator[Path]:
    """Make a file system in memory, in a folder that only this user can enter, for the time of the ``with`` block.

    Args:
        instead: Used where this user may not mount one, if it is nearly full already.

    Raises:
        UsageError: There is neither; with both reasons.
    """
    folder = Path(tempfile.mkdtemp(prefix="bench-disk-"))
    mounted = False
    try:
        problem = _mount(folder)
        mounted = not problem
        yield folder if mounted else _checked(instead, problem)
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=False, capture_output=True)
        folder.rmdir()


def _mount(folder: Path) -> str:
    """Mount it; return why that is not possible, empty if it is mounted."""
    if os.geteuid() != 0:
        return "only root may mount a small disk"
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m,mode=0700", "tmpfs", str(folder)]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return "there is no mount command"
    return f"mounting a small disk failed: {ended.stderr.strip()}" if ended.returncode else ""


def _checked(instead: Path | None, problem: str) -> Path:
    if instead is None:
        raise UsageError(f"{problem}, and --record-to names no nearly full one")
    free_mb = shutil.disk_usage(instead).free / 1e6
    if free_mb > MOST_FREE_MB:
        raise UsageError(f"{problem}, and {instead} has {free_mb:.0f} MB left, more than the {MOST_FREE_MB} to fill")
    return instead
