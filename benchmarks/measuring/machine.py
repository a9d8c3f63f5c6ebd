"""What a process takes of this machine."""

from __future__ import annotations

import os
import re
from pathlib import Path


def cpu_time_s(pid: int) -> float:
    """Return the processor time that a process has used so far, all threads, user and system [s]; 0 if it is gone."""
    stat = _read(f"/proc/{pid}/stat")
    if not stat:
        return 0.0
    fields = stat.rpartition(")")[2].split()  # the name before it may hold blanks
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_bytes(pid: int) -> int:
    """Return the memory that a process shares with no other [bytes]; 0 if it is gone."""
    found = re.findall(r"^Private_(?:Clean|Dirty):\s+(\d+) kB$", _read(f"/proc/{pid}/smaps_rollup"), re.MULTILINE)
    return 1024 * sum(map(int, found))


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
