"""Says why a vehicle can't be reached and what a person can do about it, from the errors of sockets and ports."""

from __future__ import annotations

import errno
import os
import socket
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_BUSY: Final = (errno.EBUSY, errno.EAGAIN)  # of a port that another program has locked
_PORTS: Final = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "ttyAMA*")  # below /dev
_MOST_PORTS: Final = 4  # that are named


@dataclass(frozen=True, slots=True)
class LinkTrouble:
    """Why a vehicle can't be reached.

    Args:
        reason: What failed; may be empty.
        remedy: What to do, as an instruction to a person; may be empty.
    """

    reason: str
    remedy: str = ""


def trouble_of(error: OSError, advice: str) -> LinkTrouble:
    """Describe a socket's error.

    Args:
        error: As the socket raised it.
        advice: What to do where there is no route to the vehicle, or no answer.
    """
    if isinstance(error, socket.gaierror):
        remedy = "correct the name in the address, or join a network that knows it"
        return LinkTrouble(f"its name is not known: {error.strerror}", remedy)
    reason = error.strerror or str(error) or type(error).__name__
    if error.errno == errno.EADDRINUSE:
        return LinkTrouble(reason, "end the other program that has this port, or give another one in the address")
    return LinkTrouble(reason, advice)


def serial_trouble(error: OSError, port: str, advice: str, devices: Path = Path("/dev")) -> LinkTrouble:
    """Describe why a serial port can't be opened, or has just gone.

    Args:
        error: As opening or reading raised it.
        port: Its path.
        advice: What to do where nothing better is known.
        devices: Where other ports are searched for, to name them.
    """
    path = Path(port)
    try:
        status = path.stat()
    except PermissionError:
        return LinkTrouble(f"{port} can't be accessed", f"let this user enter {path.parent}")
    except OSError:
        there = sorted(str(found) for pattern in _PORTS for found in devices.glob(pattern))[:_MOST_PORTS]
        known = f"; ports that are there: {', '.join(there)}" if there else ""
        return LinkTrouble(f"there is no {port}", f"plug the vehicle in, or correct the port in the address{known}")
    if not stat.S_ISCHR(status.st_mode):
        return LinkTrouble(f"{port} is no serial port", "correct the port in the address")
    if not os.access(path, os.R_OK | os.W_OK):
        return LinkTrouble(
            f"this user may not open {port} (mode {stat.S_IMODE(status.st_mode):04o})", _permission(port, status)
        )
    if error.errno in _BUSY:
        return LinkTrouble(f"another program uses {port}", "end it (a ground station, ModemManager, another proxy)")
    return LinkTrouble(error.strerror or str(error) or type(error).__name__, advice)


def _permission(port: str, status: os.stat_result) -> str:
    if not status.st_mode & stat.S_IRGRP or not status.st_mode & stat.S_IWGRP or status.st_gid == 0:
        return f"add a udev rule that lets this user open {port}"
    try:
        import grp

        group = grp.getgrgid(status.st_gid).gr_name
    except (KeyError, ImportError):  # Windows has no groups
        group = str(status.st_gid)
    return f"join the group {group}: sudo usermod -a -G {group} $USER, then log in again"
