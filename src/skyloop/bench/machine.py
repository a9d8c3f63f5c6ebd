"""The machine that figures were taken on, without anything that names it or its user."""

from __future__ import annotations

import os
import platform
import re
from importlib import metadata
from pathlib import Path

import msgspec

PACKAGES = ("skyloop", "numpy", "msgspec", "opencv-python-headless")


class Machine(msgspec.Struct, frozen=True):
    """The machine that the figures were taken on."""

    cpu: str
    cores: int  #: that this process may use
    system: str
    kernel: str
    python: str
    packages: dict[str, str] = {}  #: versions
    load: float | None = None  #: average number of processes that wanted a core in the minute before

    @classmethod
    def here(cls) -> Machine:
        """Describe this machine."""
        return cls(
            cpu=cpu_model(_read("/proc/cpuinfo")) or platform.machine(),
            cores=len(os.sched_getaffinity(0)),
            system=f"{os_name(_read('/etc/os-release')) or platform.system()} {platform.machine()}",
            kernel=f"{platform.system()} {numbers_of(platform.release())}",
            python=platform.python_version(),
            packages={name: version for name in PACKAGES if (version := _version(name))},
            load=round(os.getloadavg()[0], 1),
        )

    def __str__(self) -> str:
        busy = "" if self.load is None else f", load {self.load:.1f} before"
        return f"{self.cpu}, {self.cores} cores, {self.system}, {self.kernel}, Python {self.python}{busy}"


def cpu_model(cpuinfo: str) -> str:
    """Return the model's name in ``/proc/cpuinfo``; empty if there is none."""
    found = re.search(r"^model name\s*:\s*(.+)$", cpuinfo, re.MULTILINE)
    return " ".join(found[1].split()) if found else ""


def os_name(os_release: str) -> str:
    """Return the name for people in ``/etc/os-release``; empty if there is none."""
    found = re.search(r'^PRETTY_NAME="?([^"\n]+)"?$', os_release, re.MULTILINE)
    return found[1] if found else ""


def numbers_of(release: str) -> str:
    """Return a kernel's release without what its builder added, which may name a machine."""
    found = re.match(r"\d+(\.\d+)*", release)
    return found[0] if found else ""


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


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
