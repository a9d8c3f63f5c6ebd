"""Whose program is at the other end of a loopback connection, as the kernel's table of sockets tells (Linux).

The table is ``/proc/net/tcp`` (``tcp6``), described in proc_pid_net(5) and the kernel's ``proc_net_tcp.txt``: columns
of local and remote address in hexadecimal, state, …, user id and inode. A socket that its program has closed already
stands there with user 0 and inode 0, so an entry without an inode says nothing of who opened it.
"""

from __future__ import annotations

import ipaddress
import struct
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

Endpoint = tuple[str, int]  #: address and port

_TABLES: Final = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
_WORD: Final = "<I" if sys.byteorder == "little" else ">I"
_LOCAL, _REMOTE, _UID, _INODE = 1, 2, 7, 9  # columns


def peer_uid(client: Endpoint, server: Endpoint) -> int | None:
    """User id of the program that holds ``client``'s end of the connection to ``server``; None if that is not known."""
    for table in _TABLES:
        with suppress(OSError):
            found = uid_in(table.read_text(), client, server)
            if found is not None:
                return found
    return None


def uid_in(table: str, client: Endpoint, server: Endpoint) -> int | None:
    """The owner of the socket from ``client`` to ``server`` in a table; None if it is not there, or nobody's."""
    wanted = {(_written(client, mapped), _written(server, mapped)) for mapped in (False, True)}
    for line in table.splitlines()[1:]:
        cells = line.split()
        if len(cells) > _INODE and (cells[_LOCAL], cells[_REMOTE]) in wanted:
            return int(cells[_UID]) if cells[_INODE] != "0" else None
    return None


def _written(end: Endpoint, mapped: bool) -> str:
    """As in the table: 32-bit words in the host's order. ``mapped``: an IPv4 address within IPv6."""
    address = ipaddress.ip_address(end[0])
    packed = address.packed
    if mapped and address.version == 4:
        packed = ipaddress.IPv6Address(f"::ffff:{address}").packed
    words = "".join(f"{word:08X}" for (word,) in struct.iter_unpack(_WORD, packed))
    return f"{words}:{end[1]:04X}"
