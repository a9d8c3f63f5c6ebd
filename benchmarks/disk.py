"""Provide a disk that a recorder fills within a second."""

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
MOST_FREE_MB: Final = 16  #: maximum free space of a folder used instead


@contextmanager
def small_disk(instead: Path | None = None) -> Iterator[Path]:
    """Create a file system in memory, in a folder only this user can enter, for the ``with`` block.

    Args:
        instead: A nearly full disk to use where this user may not mount one.

    Raises:
        UsageError: Neither is available; the error gives both reasons.
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
    """Mount it; return why that failed, or an empty string."""
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
        raise UsageError(f"{problem}, and --record-to does not name a nearly full one")
    free_mb = shutil.disk_usage(instead).free / 1e6
    if free_mb > MOST_FREE_MB:
        raise UsageError(f"{problem}, and {instead} has {free_mb:.0f} MB left, more than the maximum of {MOST_FREE_MB}")
    return instead
