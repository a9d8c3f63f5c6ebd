"""The transport of one host: a Unix ``SOCK_SEQPACKET`` connection an application, frames in sealed shared memory.

The kernel keeps packets whole, tells at once when the other end dies, checks who may connect, and leaves nothing
behind after a crash. It needs Linux 5.1 or later: elsewhere each name here raises :class:`UnsupportedError` when used.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from skyloop.errors import UnsupportedError
from skyloop.transport.base import Dialer

if TYPE_CHECKING:
    from skyloop.transport.local.directory import Proxy
    from skyloop.transport.local.server import LocalServer

__all__ = ["LocalServer", "dial", "list_names"]


def dial(name: str, *, group: str | None = None) -> Dialer:
    """The dialer of the proxy with this name on this host.

    ``group`` is the group of users that shares the directory of sockets (default: the variable ``SKYLOOP_GROUP``).
    Raises :class:`UsageError` for what can't be a name or a group. The dialer itself raises
    :class:`UnknownNameError` where there is no such proxy, and :class:`LinkError` where it does not accept (it was
    killed, is stopped, or is another user's); it comes back within about a second.
    """
    _check_platform()
    from skyloop.transport.local.client import make_dialer

    return make_dialer(name, group)


def list_names(*, group: str | None = None) -> list[Proxy]:
    """The proxies that run on this host and that this user may reach, by name.

    Sockets left by killed ones are removed. Raises :class:`LinkError` if the directory of sockets is not safe.
    """
    _check_platform()
    from skyloop.transport.local.directory import find_directory

    return find_directory(group).proxies()


def __getattr__(name: str) -> Any:
    # Its modules cannot even be imported where there is no fcntl, so they are not until they are asked for.
    if name == "LocalServer":
        _check_platform()
        from skyloop.transport.local.server import LocalServer

        return LocalServer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _check_platform() -> None:
    if sys.platform != "linux":
        raise UnsupportedError(
            f"the local transport needs Linux (sealed shared memory and SOCK_SEQPACKET), and this is {sys.platform}: "
            "run proxy and application on Linux; a program may reach it over the network (network=True) from anywhere"
        )
