"""Hosts of network namespaces, and segments that join them."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from types import TracebackType
from typing import Final, Self, TypeVar

from skyloop.errors import UnsupportedError, UsageError

_Entered = TypeVar("_Entered")
_PROGRAMS: Final = {"ip": "iproute2", "nsenter": "util-linux", "unshare": "util-linux"}
_TUN: Final = Path("/dev/net/tun")
_WITHIN_S: Final = 20.0  # time allowed for what takes milliseconds on a healthy machine
# It prints its number and ends with the pipe, and thus with its creator; then the kernel removes the namespaces.
_HOLD: Final = 'echo "$1" > /proc/sys/kernel/hostname && echo $$ && exec cat'


def problem() -> str:
    """Return why no hosts can be created here; empty if they can."""
    if sys.platform != "linux":
        return f"network namespaces need Linux, and this is {sys.platform}"
    if os.geteuid() != 0:
        return "network namespaces need root"
    for program, package in _PROGRAMS.items():
        if shutil.which(program) is None:
            return f"there is no program {program!r}: install {package}"
    if not os.access(_TUN, os.R_OK | os.W_OK):
        return f"{_TUN} cannot be opened"
    tried = subprocess.run(
        ["unshare", "--net", "--uts", "--time", "--monotonic", "1", "--fork", "true"],
        capture_output=True,
        text=True,
        timeout=_WITHIN_S,
        check=False,
    )
    return "" if tried.returncode == 0 else f"this kernel makes no namespaces: {tried.stderr.strip()}"


class Host:
    """A host with its own interfaces, name and directory of local sockets.

    Files and processes are shared by all hosts.
    """

    def __init__(self, name: str, environment: Mapping[str, str], clock_ahead_s: float) -> None:
        """Create the host.

        Args:
            name: Its host name.
            environment: Extra environment variables of its programs.
            clock_ahead_s: How far its monotonic clock is ahead of this machine's, in whole seconds.

        Raises:
            UnsupportedError: The host can't be created.
        """
        self.name = name
        self.interfaces: list[str] = []
        kinds = ["--net", "--uts"]
        clock = []
        if clock_ahead_s:
            kinds.append("--time")
            clock = ["--monotonic", str(int(clock_ahead_s)), "--boottime", str(int(clock_ahead_s)), "--fork"]
        self._holder = subprocess.Popen(
            ["unshare", *kinds, *clock, "sh", "-c", _HOLD, "hold", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._holder.stdout is not None
        said = self._holder.stdout.readline().strip()
        if not said.isdecimal():
            self.close()
            raise UnsupportedError(f"no host {name!r} could be made: {problem() or 'its shell ended'}")
        self.pid = int(said)  #: of a process that only holds the namespaces
        #: A prefix that runs a command here, as the very process that was started.
        self.prefix: Sequence[str] = ("nsenter", "--target", said, *kinds, "env", *map("=".join, environment.items()))
        self.ip("link set lo up")

    def run(self, *arguments: str, said: str = "") -> str:
        """Run a short program here.

        Args:
            *arguments: The command.
            said: Its standard input.

        Returns:
            Its standard output.

        Raises:
            UnsupportedError: The program fails.
        """
        ended = subprocess.run(
            [*self.prefix, *arguments], input=said, capture_output=True, text=True, timeout=_WITHIN_S, check=False
        )
        if ended.returncode != 0:
            raise UnsupportedError(f"{' '.join(arguments)} failed on host {self.name!r}: {ended.stderr.strip()}")
        return ended.stdout

    def ip(self, *lines: str) -> None:
        """Run commands of ``ip``, which are given without that word."""
        self.run("ip", "-batch", "-", said="\n".join(lines))

    def add_interface(self) -> str:
        """Return a name for another interface, which is yet to be created."""
        self.interfaces.append(f"eth{len(self.interfaces)}")
        return self.interfaces[-1]

    def forward(self) -> None:
        """Forward packets between interfaces."""
        self.run("sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")

    def masquerade(self, interface: str) -> None:
        """Rewrite the sender of outgoing packets to this host's address, like a NAT router. Needs ``nft``."""
        self.run(
            "nft",
            "add table ip nat; add chain ip nat out { type nat hook postrouting priority 100; }; "
            f"add rule ip nat out oifname {interface} masquerade",
        )

    def close(self) -> None:
        """Release the namespaces; they end with the last process in them. Idempotent."""
        for stream in (self._holder.stdin, self._holder.stdout):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):  # the holder has already ended
                    stream.close()
        self._holder.wait(_WITHIN_S)


class Segment:
    """A switch, and the subnet of its hosts.

    Args:
        switch: A host of its own.
        subnet: The subnet, such as ``10.77.1.0/24``.
    """

    def __init__(self, switch: Host, subnet: str) -> None:
        self._switch = switch
        self._network = ipaddress.ip_network(subnet)
        self._addresses = self._network.hosts()
        self._ports: dict[Host, str] = {}
        # Multicast packets go to all, even before anyone has joined the group.
        switch.ip("link add name switch type bridge mcast_snooping 0", "link set switch up")

    def join(self, host: Host) -> str:
        """Plug a host in; return its address on this segment.

        Raises:
            UsageError: The host is already plugged in.
        """
        if host in self._ports:
            raise UsageError(f"host {host.name!r} is plugged in already")
        port, interface = f"port{len(self._ports)}", host.add_interface()
        address = str(next(self._addresses))
        self._switch.ip(
            f"link add name {port} type veth peer name {interface} netns {host.pid}",
            f"link set {port} master switch up",
        )
        host.ip(
            f"link set {interface} up",
            f"address add {address}/{self._network.prefixlen} dev {interface}",
        )
        self._ports[host] = port
        return address

    def cut(self, host: Host) -> None:
        """Block everything from now on, as if out of radio range: the host is not notified."""
        self._switch.ip(f"link set {self._ports[host]} nomaster")

    def restore(self, host: Host) -> None:
        """Unblock everything."""
        self._switch.ip(f"link set {self._ports[host]} master switch")

    def unplug(self, host: Host) -> None:
        """Pull the cable: the host's interface loses its carrier."""
        self._switch.ip(f"link set {self._ports[host]} down")

    def plug(self, host: Host) -> None:
        """Put the cable back."""
        self._switch.ip(f"link set {self._ports[host]} up")


class Lab:
    """Hosts and segments that end with the ``with`` block.

    Raises:
        UnsupportedError: No hosts can be created here; see :func:`problem`.
    """

    def __init__(self) -> None:
        if why := problem():
            raise UnsupportedError(f"no hosts can be made here: {why}")
        self._stack = ExitStack()
        self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="skyloop-")))
        self._count = 0

    def host(self, name: str, *, clock_ahead_s: float = 0.0, environment: Mapping[str, str] | None = None) -> Host:
        """Create a host.

        Args:
            name: Its host name.
            clock_ahead_s: How far its monotonic clock is ahead of all others, in whole seconds.
            environment: Environment variables of its programs.
        """
        self._count += 1
        sockets = {"SKYLOOP_RUNTIME_DIR": str(self._folder / str(self._count))}
        host = Host(name, sockets | dict(environment or {}), clock_ahead_s)
        self._stack.callback(host.close)
        return host

    def segment(self, subnet: str) -> Segment:
        """Create a switch with a subnet, such as ``10.77.1.0/24``."""
        return Segment(self.host("switch"), subnet)

    def enter(self, context: AbstractContextManager[_Entered]) -> _Entered:
        """Enter a context that ends before the hosts created so far."""
        return self._stack.enter_context(context)

    def close(self) -> None:
        """Take everything down in reverse order. Idempotent."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
