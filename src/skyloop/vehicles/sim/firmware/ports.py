"""Ports of several firmwares on one computer: which numbers are free."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterable
from typing import Final

from skyloop.errors import UsageError

LOOPBACK: Final = "127.0.0.1"

_lock = threading.Lock()
_reserved: set[tuple[str, int]] = set()  # instances of this process that may not have opened their ports yet


def bound(kind: socket.SocketKind, port: int = 0) -> socket.socket:
    """Return a socket that is bound to a port of this computer alone; 0: any free one.

    Raises:
        OSError: The port is taken.
    """
    made = socket.socket(socket.AF_INET, kind)
    try:
        if kind is socket.SOCK_STREAM:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((LOOPBACK, port))
    except BaseException:
        made.close()
        raise
    return made


def free_udp_port() -> int:
    """Return a UDP port that nobody has now."""
    with bound(socket.SOCK_DGRAM) as probe:
        port: int = probe.getsockname()[1]
        return port


def is_free(kind: socket.SocketKind, port: int) -> bool:
    """Return whether a port can be opened on all addresses of this computer, as firmware opens its own."""
    with socket.socket(socket.AF_INET, kind) as probe:
        if kind is socket.SOCK_STREAM:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True


def reserve_instance(
    firmware: str,
    most: int,
    ports: Callable[[int], Iterable[tuple[socket.SocketKind, int]]],
    runs: Callable[[int], bool] = lambda _: False,
) -> int:
    """Return the first instance number that is free, and reserve it within this process.

    Args:
        firmware: Its name.
        most: How many instances its ports allow on a computer.
        ports: The ports of an instance.
        runs: Whether an instance runs that may not have opened its ports.

    Raises:
        UsageError: There is none.
    """
    with _lock:
        for instance in range(most):
            if (firmware, instance) in _reserved:
                continue
            if all(is_free(kind, port) for kind, port in ports(instance)) and not runs(instance):
                _reserved.add((firmware, instance))
                return instance
    raise UsageError(f"no ports are free for another {firmware}: {most} at most fly on one computer; end one of them")


def release_instance(firmware: str, instance: int) -> None:
    """Give a number back that :func:`reserve_instance` returned."""
    with _lock:
        _reserved.discard((firmware, instance))
