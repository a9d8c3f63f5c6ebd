"""Ports for several firmware processes on one computer: find free ones, or isolate firmware that has fixed ports.

Firmware with fixed ports gets a separate network, which is possible only on Linux. A socket belongs to the network in
which it was created, whichever process holds it. The firmware's keeper therefore leaves the computer's network before
it starts the firmware, creates the datagram socket for the firmware there, and passes it to the parent. The keeper
itself relays the bytes of the firmware's TCP port, to and from an inherited listener.

``python -m skyloop.vehicles.sim.firmware.ports`` exits with 0 if separate networks are possible.
"""

from __future__ import annotations

import ctypes
import os
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Final

from skyloop.errors import UsageError

LOOPBACK: Final = "127.0.0.1"

_lock = threading.Lock()
_reserved: set[tuple[str, int]] = set()  # instances started by this process that may not have opened their ports yet


def bound(kind: socket.SocketKind, port: int = 0) -> socket.socket:
    """Return a socket bound to a loopback port; port 0 means any free one."""
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
    """Return a free UDP port."""
    with bound(socket.SOCK_DGRAM) as probe:
        port: int = probe.getsockname()[1]
        return port


def is_free(kind: socket.SocketKind, port: int) -> bool:
    """Return whether a port can be opened on all of this computer's addresses, as firmware does."""
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
    """Return the lowest of ``most`` instance numbers whose ports are free, and reserve it within this process.

    ``runs`` returns whether an instance is running, even if it has not opened its ports yet. Raises :class:`UsageError`
    if no number is free.
    """
    with _lock:
        for instance in range(most):
            if (firmware, instance) in _reserved:
                continue
            if all(is_free(kind, port) for kind, port in ports(instance)) and not runs(instance):
                _reserved.add((firmware, instance))
                return instance
    raise UsageError(f"no ports are free for another {firmware}: {most} at most can fly on one computer")


def release_instance(firmware: str, instance: int) -> None:
    """Release a number returned by :func:`reserve_instance`."""
    with _lock:
        _reserved.discard((firmware, instance))


OPTION: Final = "--network="
CONNECT_S: Final = 1.0  #: time-out for a connection to the firmware, which is on the same computer
MAX_READ: Final = 65536  #: bytes per read
_CLONE_NEWUSER, _CLONE_NEWNET = 0x10000000, 0x40000000  # linux/sched.h
_SIOCSIFFLAGS: Final = 0x8914  # linux/sockios.h
_UP_AND_RUNNING: Final = 0x41  # linux/if.h


class SeparateNetwork:
    """The parent's side of the connection to firmware in a separate network.

    ``port`` is the TCP port on this computer that is forwarded to the firmware's TCP port.
    """

    def __init__(self, udp_port: int, tcp_port: int) -> None:
        """Open the keepers' sockets; in the firmware's network, ``udp_port`` is ours, ``tcp_port`` the firmware's."""
        self._listener = socket.create_server((LOOPBACK, 0))
        self._ours, self._keepers = socket.socketpair()
        self._ours.setblocking(False)
        self._ports = udp_port, tcp_port
        self.port: int = self._listener.getsockname()[1]

    @property
    def descriptors(self) -> tuple[int, int]:
        """The file descriptors that each keeper inherits."""
        return self._listener.fileno(), self._keepers.fileno()

    @property
    def option(self) -> str:
        """The command-line option for each keeper."""
        return OPTION + ",".join(map(str, (*self.descriptors, *self._ports)))

    def receive_socket(self) -> socket.socket:
        """Return the newest keeper's UDP socket; the caller must close it. Raises OSError if there is no new one."""
        if sys.platform == "win32":
            raise NotImplementedError
        newest = None
        with suppress(BlockingIOError):
            while descriptors := socket.recv_fds(self._ours, 1, 1)[1]:
                if newest is not None:
                    newest.close()
                newest = socket.socket(fileno=descriptors[0])
        if newest is None:
            raise OSError("its keeper made no socket")
        return newest

    def close(self) -> None:
        """Close everything except the received sockets. Idempotent."""
        for each in (self._listener, self._ours, self._keepers):
            each.close()


def _hand_over(through: socket.socket, made: socket.socket) -> None:
    if sys.platform == "win32":
        raise NotImplementedError
    socket.send_fds(through, [b"."], [made.fileno()])


class Relay:
    """The keeper's end. Create it while the process has only one thread: the process leaves the computer's network.

    Raises OSError if a new network is not allowed.
    """

    def __init__(self, option: str) -> None:
        listener, channel, udp_port, self._tcp_port = map(int, option.removeprefix(OPTION).split(","))
        self._listener = socket.socket(fileno=listener)
        leave_network()
        with socket.socket(fileno=channel) as keepers, bound(socket.SOCK_DGRAM, udp_port) as made:
            _hand_over(keepers, made)

    def start(self) -> None:
        """Start the threads that relay bytes."""
        threading.Thread(target=self._serve, name="skyloop-relay", daemon=True).start()

    def _serve(self) -> None:
        while True:
            outside, _ = self._listener.accept()
            try:
                inside = socket.create_connection((LOOPBACK, self._tcp_port), CONNECT_S)
            except OSError:
                outside.close()  # there is no listener yet
                continue
            inside.settimeout(None)
            for ends in ((outside, inside), (inside, outside)):
                ends[0].setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                threading.Thread(target=_carry, args=ends, name="skyloop-relay", daemon=True).start()


def _carry(source: socket.socket, sink: socket.socket) -> None:
    with suppress(OSError):
        while data := source.recv(MAX_READ):
            sink.sendall(data)
    for end in (source, sink):
        with suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


def leave_network() -> None:
    """Move this process into a new network that has only a loopback interface.

    Raises OSError unless this process is root or the kernel allows unprivileged user namespaces.
    """
    if sys.platform != "linux":
        raise OSError("separate networks exist only on Linux")
    import fcntl

    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWNET) and libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET):
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, _SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", _UP_AND_RUNNING))


def is_possible() -> bool:
    """Return whether separate networks are possible here. This starts another process, which takes a moment."""
    command: Sequence[str] = (sys.executable, "-m", "skyloop.vehicles.sim.firmware.ports")
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


if __name__ == "__main__":
    leave_network()
