"""The directory of sockets, where proxies are found by name, and its access rules.

Each proxy has one socket, ``NAME.sock``, in a directory that only the directory's owner (or a named group) can enter.
The variable ``SKYLOOP_RUNTIME_DIR`` sets the directory. The default is ``skyloop`` in the user's runtime directory. A
process that changes the directory holds an advisory lock, which the kernel releases when the process ends. The lock is
on the directory itself. If a group may read the directory, the lock is on the file ``.lock`` in it, which only the
owner can open, so that members of the group can't block a proxy. Reading needs no lock.

The socket of a killed proxy remains as a file. A connection attempt with the *wrong* type of socket reveals whether a
process is still listening. The kernel answers at once, without the owner noticing: ``EPROTOTYPE`` for a live socket and
``ECONNREFUSED`` for a dead one.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import os
import socket
import stat
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

from skyloop.errors import LinkError, NameTakenError, UsageError
from skyloop.transport.base import NAME, check_name
from skyloop.transport.local.sockets import Socket, credentials, set_timeout, user_name

DIRECTORY_VARIABLE: Final = "SKYLOOP_RUNTIME_DIR"
GROUP_VARIABLE: Final = "SKYLOOP_GROUP"
MAX_PATH: Final = 107  #: Linux's limit for a socket's path [bytes]
LOCK_TIMEOUT_S: Final = 2.0  #: how long to wait for another process that changes the directory
CONNECT_TIMEOUT_S: Final = 1.0  #: time limit for a proxy to accept a connection
PROXY: Final = "proxy"
HOST: Final = "host"  #: a host for many proxies; its socket accepts requests to add and remove vehicles
_SUFFIXES: Final = {PROXY: ".sock", HOST: ".host"}
_LOCK: Final = ".lock"
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
        self._suffix = _SUFFIXES[kind]

    def socket_path(self, name: str) -> Path:
        """Return the path of a proxy's socket. The path must not be longer than :data:`MAX_PATH`."""
        check_name(name)
        path = self.path / (name + self._suffix)
        if len(os.fsencode(path)) > MAX_PATH:
            raise UsageError(
                f"the socket's path {path} has {len(os.fsencode(path))} bytes, over the limit of {MAX_PATH}: "
                f"set {DIRECTORY_VARIABLE} to a shorter directory"
            )
        return path

    def create(self) -> None:
        """Create the directory if it is missing, give it to the group if there is one, and check it."""
        self.path.parent.mkdir(mode=0o700 if self.gid is None else 0o755, parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            self.path.mkdir(mode=0o700)
        if self.gid is not None and self.path.lstat().st_uid == os.geteuid():
            os.chown(self.path, -1, self.gid, follow_symlinks=False)
            self.path.chmod(0o750)
        self.check()

    def check(self) -> None:
        """Check that no other user can put a socket here; ``FileNotFoundError`` if the directory does not exist."""
        here, above = self._lstat(self.path), self._lstat(self.path.parent)
        if not stat.S_ISDIR(here.st_mode):
            raise LinkError(f"{self.path} is not a directory: remove it, or set {DIRECTORY_VARIABLE} to another one")
        ours = here.st_uid == os.geteuid() or (self.gid is not None and here.st_gid == self.gid)
        if not ours:
            raise LinkError(
                f"{self.path} belongs to {user_name(here.st_uid)} and not to {user_name(os.geteuid())}: set "
                f"{DIRECTORY_VARIABLE} to a directory of your own, or {GROUP_VARIABLE} to the group that shares it"
            )
        if here.st_mode & _OPEN_TO_OTHERS:
            raise LinkError(
                f"{self.path} is open to others (mode {stat.S_IMODE(here.st_mode):04o}): "
                "give it mode 0700, or 0750 for a group"
            )
        shared = above.st_mode & 0o022 and not above.st_mode & stat.S_ISVTX
        if shared or above.st_uid not in (0, here.st_uid, os.geteuid()):
            raise LinkError(
                f"{self.path.parent}, the parent of {self.path.name}, can be changed by others: "
                f"set {DIRECTORY_VARIABLE} to a directory in a place that only you can change"
            )

    def proxies(self) -> list[Proxy]:
        """List the running proxies by name, and remove the sockets that killed proxies left behind."""
        try:
            self.check()
        except FileNotFoundError:
            return []
        found = []
        for path in sorted(self.path.glob("*" + self._suffix)):
            name = path.name.removesuffix(self._suffix)
            if not NAME.fullmatch(name):
                continue
            if is_live(path):
                found.append(Proxy(name, owner_pid(path), path))
            else:
                self._remove_stale(path)
        return found

    def _remove_stale(self, path: Path) -> None:
        """Remove the socket of a killed proxy unless the lock is held, because a reader never waits."""
        if self._lstat(self.path).st_uid != os.geteuid():
            return  # members of a group may read the directory, but can't remove anything
        with contextlib.suppress(OSError, LinkError), self.lock(timeout_s=0.0):
            if not is_live(path):  # a new proxy may have taken the name since then
                path.unlink()

    def listen(self, name: str) -> tuple[Socket, int]:
        """Listen under a name, replacing a killed proxy. Return the socket, and its file's inode for :meth:`remove`."""
        path = self.socket_path(name)
        self.create()
        with self.lock():
            if is_live(path):
                pid = owner_pid(path)
                raise NameTakenError(
                    f"the name {name!r} is in use by a running {self._kind}"
                    f"{f' (pid {pid})' if pid is not None else ''}: choose another name, or stop that process"
                )
            path.unlink(missing_ok=True)
            listener = Socket()
            listener.bind(os.fspath(path))
            if self.gid is not None:
                os.chown(path, -1, self.gid)
            path.chmod(0o600 if self.gid is None else 0o660)
            listener.listen(128)
            return listener, path.lstat().st_ino

    def remove(self, name: str, inode: int) -> None:
        """Remove the socket with this name if its file still has this inode. Errors are ignored."""
        path = self.socket_path(name)
        with contextlib.suppress(OSError, LinkError), self.lock():
            if path.lstat().st_ino == inode:
                path.unlink()

    @contextlib.contextmanager
    def lock(self, timeout_s: float = LOCK_TIMEOUT_S) -> Iterator[None]:
        """Lock the directory against changes by others; :class:`LinkError` if this takes longer than ``timeout_s``."""
        here, path = self._lstat(self.path), self.path
        flags = os.O_RDONLY | os.O_DIRECTORY
        if here.st_mode & stat.S_IRWXG:
            path, flags = path / _LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
        descriptor = os.open(path, flags | os.O_CLOEXEC, 0o600)
        try:
            if path is not self.path and os.geteuid() == 0:  # root may have created it in another user's directory
                os.fchown(descriptor, here.st_uid, -1)
            _lock(descriptor, path, timeout_s)
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


def is_live(path: Path) -> bool:
    """Return whether a process still holds the socket at this path."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        code = probe.connect_ex(os.fspath(path))
    return code not in (errno.ECONNREFUSED, errno.ENOENT)


def of_others(table: str, owner: Callable[[Path], int | None]) -> dict[str, list[str]]:
    """Return the names of other users' proxies on this host, by user. This process can't open their sockets.

    ``table``: the content of ``/proc/net/unix``, where the kernel lists the names of all sockets for every user.
    ``owner``: returns the user id of a directory's owner; None if the owner is unknown.
    """
    found: dict[str, list[str]] = {}
    for line in table.splitlines():
        path = Path(line[line.find("/") :]) if "/" in line else Path()
        name = path.name.removesuffix(_SUFFIXES[PROXY])
        if path.parent.name != "skyloop" or name == path.name or not NAME.fullmatch(name):
            continue  # a directory with another name may belong to any program
        user = owner(path.parent)
        if user is not None and user != os.geteuid() and name not in found.setdefault(user_name(user), []):
            found[user_name(user)].append(name)
    return found


def directory_owner(path: Path) -> int | None:
    """Return the owner of a directory or, if the directory is not visible, the owner of its nearest visible parent."""
    for folder in (path, *path.parents):
        with contextlib.suppress(OSError):
            return folder.lstat().st_uid
    return None


def owner_pid(path: Path) -> int | None:
    """Return the id of the process that listens at this path; None if it can't be determined immediately."""
    probe = Socket()
    probe.setblocking(False)
    try:
        probe.connect(os.fspath(path))
        return credentials(probe).pid
    except OSError:
        return None


def connect(path: Path) -> Socket:
    """Connect to the socket at this path; ``OSError`` if no process accepts within :data:`CONNECT_TIMEOUT_S`."""
    sock = Socket()
    # Without a time-out, connecting to a stopped process with a full queue would block forever.
    set_timeout(sock, socket.SO_SNDTIMEO, CONNECT_TIMEOUT_S)
    sock.connect(os.fspath(path))
    return sock


def _lock(descriptor: int, path: Path, timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise LinkError(f"{path} is locked by another process, which appears to be stopped") from None
            time.sleep(0.005)
        else:
            return
