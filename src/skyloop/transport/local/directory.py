"""The directory of sockets, where proxies are found by name, and its access rules.

Each proxy has one file, ``NAME.sock`` or on the portable side ``NAME.port``, in a directory that only the directory's
owner (or a named group) can enter.
The variable ``SKYLOOP_RUNTIME_DIR`` sets the directory. The default is ``skyloop`` in the user's runtime directory. A
process that changes the directory holds an advisory lock, which the kernel releases when the process ends. The lock is
on the directory itself. If a group may read the directory, the lock is on the file ``.lock`` in it, which only the
owner can open, so that members of the group can't block a proxy. Reading needs no lock.

On Windows, the folder in the user's own profile inherits an access list that admits only that user, administrators and
the system. Modes, owners and groups are therefore not checked there, and the lock is always on the file ``.lock``.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import stat
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from skyloop.errors import LinkError, NameTakenError, UsageError
from skyloop.platform import lock_file, own_uid
from skyloop.transport.base import NAME, check_name
from skyloop.transport.local.system import (
    PROXY,
    Listener,
    PacketSocket,
    System,
    serving_side,
    systems,
    user_name,
)

DIRECTORY_VARIABLE: Final = "SKYLOOP_RUNTIME_DIR"
GROUP_VARIABLE: Final = "SKYLOOP_GROUP"
LOCK_TIMEOUT_S: Final = 2.0
_LOCK: Final = ".lock"
_SOCKET: Final = ".sock"
_OPEN_TO_OTHERS: Final = 0o027  # file permissions: writable by the group, or any access for others


class Proxy(NamedTuple):
    """A running proxy on this host."""

    name: str
    pid: int | None  #: process id; None if the process is too busy to report it
    path: Path  #: path of the server's socket


class Directory:
    """A user's view of the directory of sockets; see :func:`find_directory`. Each kind of socket has its own names."""

    def __init__(self, path: Path, gid: int | None, kind: str = PROXY) -> None:
        self.path = path
        self.gid = gid
        self._kind = kind

    @functools.cached_property
    def serving(self) -> System:
        """The side that a new server uses."""
        return systems()[serving_side()]

    def socket_path(self, name: str, system: System | None = None) -> Path:
        """Return the path of a proxy's file, by default for a new server. Raises :class:`UsageError`."""
        check_name(name)
        system = system or self.serving
        path = self.path / (name + system.SUFFIXES[self._kind])
        system.check_path(path)
        return path

    def create(self) -> None:
        """Create the directory if it is missing, give it to the group if there is one, and check it."""
        self.path.parent.mkdir(mode=0o700 if self.gid is None else 0o755, parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            self.path.mkdir(mode=0o700)
        if sys.platform != "win32" and self.gid is not None and self.path.lstat().st_uid == own_uid():
            os.chown(self.path, -1, self.gid, follow_symlinks=False)
            self.path.chmod(0o750)
        self.check()

    def check(self) -> None:
        """Check that no other user can put a socket here; ``FileNotFoundError`` if the directory does not exist."""
        here, above = self._lstat(self.path), self._lstat(self.path.parent)
        if not stat.S_ISDIR(here.st_mode):
            raise LinkError(f"{self.path} is not a directory: remove it, or set {DIRECTORY_VARIABLE} to another one")
        if sys.platform == "win32":
            return
        ours = here.st_uid == own_uid() or (self.gid is not None and here.st_gid == self.gid)
        if not ours:
            raise LinkError(
                f"{self.path} belongs to {user_name(here.st_uid)} and not to {user_name(own_uid())}: set "
                f"{DIRECTORY_VARIABLE} to a directory of your own, or {GROUP_VARIABLE} to the group that shares it"
            )
        if here.st_mode & _OPEN_TO_OTHERS:
            raise LinkError(
                f"{self.path} is open to others (mode {stat.S_IMODE(here.st_mode):04o}): "
                "give it mode 0700, or 0750 for a group"
            )
        shared = above.st_mode & 0o022 and not above.st_mode & stat.S_ISVTX
        if shared or above.st_uid not in (0, here.st_uid, own_uid()):
            raise LinkError(
                f"{self.path.parent}, the parent of {self.path.name}, can be changed by others: "
                f"set {DIRECTORY_VARIABLE} to a directory in a place that only you can change"
            )

    def proxies(self) -> list[Proxy]:
        """List the running proxies by name, and remove what killed proxies left behind."""
        try:
            self.check()
        except FileNotFoundError:
            return []
        found = []
        for name, path, system in self._files():
            if system.is_live(path):
                found.append(Proxy(name, system.owner_pid(path), path))
            else:
                self._remove_stale(path, system)
        return found

    def running(self) -> dict[str, Path]:
        """Return the running proxies' files by name, without any check or change; empty without the directory."""
        return {name: path for name, path, system in self._files() if system.is_live(path)}

    def _files(self) -> list[tuple[str, Path, System]]:
        found = []
        sides = {system.SUFFIXES[self._kind]: system for system in systems().values()}
        with contextlib.suppress(FileNotFoundError), os.scandir(self.path) as entries:
            for entry in entries:
                name, dot, suffix = entry.name.rpartition(".")
                system = sides.get(dot + suffix)
                if system is not None and NAME.fullmatch(name):
                    found.append((name, self.path / entry.name, system))
        return sorted(found, key=lambda file: file[:2])

    def _remove_stale(self, path: Path, system: System) -> None:
        """Remove the file of a killed proxy unless the lock is held, because a reader never waits."""
        if sys.platform != "win32" and self._lstat(self.path).st_uid != own_uid():
            return  # members of a group may read the directory, but can't remove anything
        with contextlib.suppress(OSError, LinkError), self.lock(timeout_s=0.0):
            if not system.is_live(path):  # a new proxy may have taken the name since then
                system.remove(path)

    def connect(self, name: str) -> PacketSocket:
        """Connect to a proxy, on whichever side it is.

        Raises ``OSError``: ``FileNotFoundError`` if there is none, ``ConnectionRefusedError`` if it was killed, and
        ``BlockingIOError`` if it does not accept.
        """
        check_name(name)
        self.check()
        killed = False
        for system in systems().values():
            path = self.path / (name + system.SUFFIXES[self._kind])
            if not path.exists():
                continue
            try:
                return system.connect(path)
            except ConnectionRefusedError:
                killed = True
            except FileNotFoundError:
                continue
        number = errno.ECONNREFUSED if killed else errno.ENOENT
        raise OSError(number, os.strerror(number))  # Python makes it one of the errors above

    def listen(self, name: str) -> tuple[Listener, int]:
        """Listen under a name, replacing a killed proxy. Return the socket, and its file's inode for :meth:`remove`."""
        path = self.socket_path(name)
        self.create()
        with self.lock():
            for system in systems().values():
                other = self.path / (name + system.SUFFIXES[self._kind])
                if other.exists() and system.is_live(other):
                    pid = system.owner_pid(other)
                    raise NameTakenError(
                        f"the name {name!r} is in use by a running {self._kind}"
                        f"{f' (pid {pid})' if pid is not None else ''}: choose another name, or stop that process"
                    )
                system.remove(other)
            return self.serving.listen(path, self.gid), path.lstat().st_ino

    def remove(self, name: str, inode: int, listener: Listener) -> None:
        """Remove a listener's file if it still has this inode, and release the name. Errors are ignored."""
        with contextlib.suppress(OSError, LinkError), self.lock():
            for system in systems().values():
                path = self.path / (name + system.SUFFIXES[self._kind])
                if path.exists() and path.lstat().st_ino == inode:  # an inode that the listener holds is no one else's
                    if sys.platform == "win32":  # where a file that is open can't be removed
                        listener.release()
                    system.remove(path)
        listener.release()

    @contextlib.contextmanager
    def lock(self, timeout_s: float = LOCK_TIMEOUT_S) -> Iterator[None]:
        """Lock the directory against changes by others; :class:`LinkError` if this takes longer than ``timeout_s``."""
        here, path = self._lstat(self.path), self.path
        flags = os.O_RDWR | os.O_CREAT
        if sys.platform != "win32":
            flags |= os.O_CLOEXEC | os.O_NOFOLLOW
        if sys.platform == "win32" or here.st_mode & stat.S_IRWXG:
            path = path / _LOCK
        else:
            flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
        descriptor = os.open(path, flags, 0o600)
        try:
            if sys.platform != "win32" and path is not self.path and own_uid() == 0:
                os.fchown(descriptor, here.st_uid, -1)  # root may have created it in another user's directory
            if not lock_file(descriptor, timeout_s):
                raise LinkError(f"{path} is locked by another process, which appears to be stopped")
            yield
        finally:
            os.close(descriptor)

    @staticmethod
    def _lstat(path: Path) -> os.stat_result:
        try:
            return path.lstat()
        except PermissionError as error:
            raise LinkError(f"cannot look into {path.parent}: {error.strerror}; only its owner or group may") from None


def find_directory(group: str | None = None, kind: str = PROXY) -> Directory:
    """Return this user's directory, or the one that a group shares (``SKYLOOP_GROUP``). No files are touched."""
    group = group or os.environ.get(GROUP_VARIABLE) or None
    configured = os.environ.get(DIRECTORY_VARIABLE)
    if group is not None and not configured:
        raise UsageError(
            f"the group {group!r} needs a directory that its members can reach: set {DIRECTORY_VARIABLE}, "
            f"for example to /var/tmp/skyloop-{group}"
        )
    path = Path(configured) if configured else _default_path()
    return Directory(path.absolute(), None if group is None else _group_id(group), kind)


def _group_id(group: str) -> int:
    if sys.platform == "win32":
        raise UsageError(f"{GROUP_VARIABLE} is {group!r}, and on Windows no group can share proxies")
    import grp

    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise UsageError(f"there is no group named {group!r} on this host (see: getent group)") from None


def _default_path() -> Path:
    import platformdirs

    with warnings.catch_warnings():
        # Ignore the warning about a missing XDG_RUNTIME_DIR: the safety of the fallback directory is checked here.
        warnings.simplefilter("ignore")
        return Path(platformdirs.user_runtime_dir("skyloop", appauthor=False))


def of_others(table: str, owner: Callable[[Path], int | None]) -> dict[str, list[str]]:
    """Return the names of other users' proxies on this host, by user. This process can't open their sockets.

    ``table``: the content of ``/proc/net/unix``, where the kernel lists the names of all sockets for every user.
    ``owner``: returns the user id of a directory's owner; None if the owner is unknown.
    """
    found: dict[str, list[str]] = {}
    for line in table.splitlines():
        path = Path(line[line.find("/") :]) if "/" in line else Path()
        name = path.name.removesuffix(_SOCKET)
        if path.parent.name != "skyloop" or name == path.name or not NAME.fullmatch(name):
            continue  # a directory with another name may belong to any program
        user = owner(path.parent)
        if user is not None and user != own_uid() and name not in found.setdefault(user_name(user), []):
            found[user_name(user)].append(name)
    return found


def directory_owner(path: Path) -> int | None:
    """Return the owner of a directory or, if the directory is not visible, the owner of its nearest visible parent."""
    for folder in (path, *path.parents):
        with contextlib.suppress(OSError):
            return folder.lstat().st_uid
    return None
