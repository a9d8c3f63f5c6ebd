"""Measure how much of this machine a process uses."""

from __future__ import annotations

import os
import re
from pathlib import Path


def cpu_time_s(pid: int) -> float:
    """Return the processor time used so far by a process, for all threads, user and system [s]; 0 if it has ended."""
    stat = _read(f"/proc/{pid}/stat")
    if not stat:
        return 0.0
    fields = stat.rpartition(")")[2].split()  # the name may contain spaces
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_bytes(pid: int) -> int:
    """Return the unshared memory of a process [bytes]; 0 if it has ended."""
    found = re.findall(r"^Private_(?:Clean|Dirty):\s+(\d+) kB$", _read(f"/proc/{pid}/smaps_rollup"), re.MULTILINE)
    return 1024 * sum(map(int, found))


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
