"""Determine where the page is served: its sockets, its addresses, and the lines printed on the terminal."""

from __future__ import annotations

import errno
import ipaddress
import socket
import struct
import sys
from contextlib import closing, suppress
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from skyloop.cockpit.access import PAIRING_S, Pairing
from skyloop.errors import UsageError
from skyloop.platform import allow_restart

DEFAULT_PORT: Final = 8420  #: TCP port of the page
NEXT_PORTS: Final = 9  #: number of further ports to try if the default port is in use
_TABLES: Final = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
_LISTENS: Final = "0A"  # state of a listening socket in the kernel's socket tables
_LOCAL, _STATE, _INODE = 1, 3, 9  # column indexes in these tables
_SIOCGIFADDR: Final = 0x8915  # Linux ioctl that returns an interface's IPv4 address
_MDNS: Final = Path("/run/avahi-daemon/socket")
_MAX_COMMAND: Final = 60  # number of characters shown of a command line


def bind(address: str, port: int | None) -> socket.socket:
    """Bind the socket on which to listen for pages.

    Args:
        address: The address.
        port: The TCP port; 0 selects a free one. If None, use :data:`DEFAULT_PORT` or, if that is taken, the next free
            one, and name the program that uses the default on standard error.

    Raises:
        UsageError: The port is in use or unusable.
    """
    if port is not None:
        return _bind(address, port)
    for following in range(DEFAULT_PORT, DEFAULT_PORT + NEXT_PORTS + 1):
        with suppress(UsageError):
            listening = _bind(address, following)
            if following != DEFAULT_PORT:
                taken = f"port {DEFAULT_PORT} is in use{_by(DEFAULT_PORT)}"
                print(f"cockpit: {taken}; the page is at port {following} (--port chooses one)", file=sys.stderr)
            return listening
    return _bind(address, 0)


def _bind(address: str, port: int) -> socket.socket:
    listening = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_STREAM)
    allow_restart(listening)
    try:
        listening.bind((address, port))
        listening.listen(0)  # listen immediately, because two programs may bind the same port until one of them listens
    except (OSError, OverflowError) as error:
        listening.close()
        taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        hint = f"is in use{_by(port)}; port 0 takes a free one" if taken else f"can't be used: {error}"
        raise UsageError(f"port {port} of {address} {hint}") from error
    return listening


def _by(port: int) -> str:
    found = listener_of(port)
    return f" by {found}" if found else ""


def listener_of(port: int) -> str:
    """Return the process and command line of this user's program that listens on a port; empty if there is none."""
    inodes = set()
    for table in _TABLES:
        with suppress(OSError):
            for line in table.read_text().splitlines()[1:]:
                cells = line.split()
                if cells[_STATE] == _LISTENS and int(cells[_LOCAL].rpartition(":")[2], 16) == port:
                    inodes.add(f"socket:[{cells[_INODE]}]")
    if not inodes:
        return ""
    for process in Path("/proc").iterdir():
        if process.name.isdigit():
            with suppress(OSError):  # the process belongs to another user, or it has ended
                if any(str(entry.readlink()) in inodes for entry in (process / "fd").iterdir()):
                    command = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
                    return f"process {process.name} ({command[:_MAX_COMMAND]})"
    return ""


def reachable(address: str) -> list[str]:
    """Return the addresses at which other machines can reach a service bound to ``address``, best first.

    If the machine is on no network, return its loopback address. ``address`` is an address of this machine, ``0.0.0.0``
    or ``::``.
    """
    known = ipaddress.ip_address(address)
    if not known.is_unspecified:
        return [address]
    families = [(socket.AF_INET, "192.0.2.1")]  # an address reserved for documentation (RFC 5737; below: RFC 3849)
    if known.version == 6:
        families.append((socket.AF_INET6, "2001:db8::1"))
    found = []
    for family, somewhere in families:
        with suppress(OSError), closing(socket.socket(family, socket.SOCK_DGRAM)) as probe:
            probe.connect((somewhere, 9))  # sends nothing; only selects our address on the route to other networks
            found.append(str(probe.getsockname()[0]))
    return found or own_addresses() or ["127.0.0.1" if known.version == 4 else "::1"]


def own_addresses() -> list[str]:
    """Return the IPv4 addresses of this machine on its networks, ordered by interface; empty except on Linux.

    Used on networks that have no default route, such as a drone's own Wi-Fi or a lab without internet access.
    """
    found: list[str] = []
    if sys.platform != "linux":
        return found
    import fcntl

    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as any_socket:
        for _, name in socket.if_nameindex():
            with suppress(OSError):  # the interface has no address
                answer = fcntl.ioctl(any_socket, _SIOCGIFADDR, struct.pack("256s", name.encode()))
                found.append(socket.inet_ntoa(answer[20:24]))
    return [address for address in found if not ipaddress.ip_address(address).is_loopback]


def host_names() -> tuple[str, ...]:
    """Return this machine's host name, and its multicast DNS name (``NAME.local``) if Avahi is running."""
    name = socket.gethostname()
    return (name, f"{name.partition('.')[0]}.local") if _MDNS.exists() else (name,)


def qr_code(text: str) -> str:
    """Return a QR code for a terminal, drawn in half blocks; empty if the library is missing."""
    try:
        import segno
    except ImportError:
        return ""
    from io import StringIO

    drawn = StringIO()
    segno.make(text, error="m").terminal(drawn, compact=True)
    return drawn.getvalue()


class Announcer:
    """Prints the page's address, with a QR code if other machines can reach the page and the terminal can show one.

    With pairing, the address in the QR code contains the code after the ``#``, in the part that browsers never send.
    The next code is printed as soon as the last one has been used or has expired. ``pairing``: issues the codes, or
    None if everyone is admitted or people have tokens. ``loopback``: whether only this machine can reach the page.
    """

    def __init__(self, pairing: Pairing | None, loopback: bool) -> None:
        self._pairing = pairing
        self._loopback = loopback

    def __call__(self, page: str) -> None:
        print(f"cockpit: {page}", flush=True)
        if self._pairing is not None:
            self._pairing.on_used = lambda who: self._show(page, f"paired with {who}")
            self._pairing.on_expired = lambda: self._show(page, "the pairing address has expired")
        if not self._loopback and ipaddress.ip_address(urlsplit(page).hostname or "").is_loopback:
            print("cockpit: this machine has no network: the page can't be reached from elsewhere", file=sys.stderr)
        self._show(page, "")

    def _show(self, page: str, before: str) -> None:
        if self._pairing is not None:
            if before:
                print(before, flush=True)
            page = f"{page}#pair={self._pairing.code()}"
            print(
                f"to pair a browser, open this within {PAIRING_S / 60:.0f} minutes; it works once: {page}", flush=True
            )
        if sys.stdout.isatty() and (self._pairing is not None or not self._loopback):
            print(qr_code(page), flush=True)
