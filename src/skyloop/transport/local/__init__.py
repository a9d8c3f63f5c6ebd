"""The transport within one host: a Unix ``SOCK_SEQPACKET`` connection per application, and sealed shared memory.

The kernel keeps packets whole, reports the death of the other end at once, checks who may connect, and leaves nothing
behind after a crash. This needs Linux 5.1 or later. On other systems, loopback TCP and named shared memory take its
place (:mod:`skyloop.transport.local.system`).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from skyloop.errors import LinkError, UnknownNameError
from skyloop.transport.base import ClientHandler, Dialer, check_name

if TYPE_CHECKING:
    from skyloop.transport.local.client import LocalClient
    from skyloop.transport.local.directory import Proxy
    from skyloop.transport.local.server import LocalServer

__all__ = ["LocalServer", "dial", "list_names", "names_of_others"]


def dial(name: str, *, group: str | None = None) -> Dialer:
    """Return a dialer for a proxy on this host. ``group``: users who share its directory (default: ``SKYLOOP_GROUP``).

    The dialer raises :class:`UnknownNameError` if there is no such proxy, and :class:`LinkError` if the proxy does not
    accept the connection (it was killed, is stopped, or is another user's). It returns or raises within 3 s.
    """
    from skyloop.transport.local.client import LocalClient
    from skyloop.transport.local.directory import find_directory

    check_name(name)
    directory = find_directory(group)

    def dialer(handler: ClientHandler) -> LocalClient:
        try:
            sock = directory.connect(name)
        except FileNotFoundError:
            raise UnknownNameError("proxy", name, [proxy.name for proxy in directory.proxies()]) from None
        except ConnectionRefusedError:
            raise LinkError(
                f"the proxy {name!r} is not running: it was killed, and left its file in {directory.path}"
            ) from None
        except BlockingIOError:
            raise LinkError(f"the proxy {name!r} does not accept connections: it is stopped or overloaded") from None
        except OSError as error:
            raise LinkError(f"cannot connect to the proxy {name!r} in {directory.path}: {error.strerror}") from None
        return LocalClient(sock, name, handler)

    return dialer


def list_names(*, group: str | None = None) -> list[Proxy]:
    """Return the running proxies on this host that this user can reach.

    Removes what killed proxies left behind. ``group``: as for :func:`dial`. Raises :class:`LinkError` if
    the directory of sockets is not safe.
    """
    from skyloop.transport.local.directory import find_directory

    return find_directory(group).proxies()


def names_of_others() -> dict[str, list[str]]:
    """Return the names of other users' proxies on this host, by user. This user can't reach these proxies.

    Only the fast side's are known, from Linux's list of all sockets. The portable side's files are closed to others.
    """
    from skyloop.transport.local.directory import directory_owner, of_others

    try:
        table = Path("/proc/net/unix").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return {}
    return of_others(table, directory_owner)


def __getattr__(name: str) -> Any:
    # Imported on demand, because it imports NumPy.
    if name == "LocalServer":
        from skyloop.transport.local.server import LocalServer

        return LocalServer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
