"""The directory of sockets: where proxies are found by name, and who may enter it.

One socket a proxy, ``NAME.sock``, in a directory that only its owner (or a named group) can enter: the variable
``SKYLOOP_RUNTIME_DIR``, or else ``skyloop`` in the user's runtime directory. There is no lock file: who changes the
directory holds an advisory lock on the directory itself, which the kernel drops with its process.

A socket whose owner was killed stays as a file. Whether one listens is asked by connecting to it with the *wrong*
type of socket, which the kernel answers with ``EPROTOTYPE`` for one that lives and ``ECONNREFUSED`` for one that does
not, at once and without the owner noticing.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import os
import socket
import stat
import struct
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from skyloop.errors import LinkError, NameTakenError, UsageError
from skyloop.transport.local.sockets import Socket, credentials, user_name
from skyloop.transport.names import NAME, check_name

DIRECTORY_VARIABLE: Final = "SKYLOOP_RUNTIME_DIR"
GROUP_VARIABLE: Final = "SKYLOOP_GROUP"
MAX_PATH: Final = 107  #: bytes that Linux allows in the path of a socket
LOCK_TIMEOUT_S: Final = 2.0
CONNECT_TIMEOUT_S: Final = 1.0
_SUFFIX: Final = ".sock"
_OPEN_TO_OTHERS: Final = 0o027  # writable by the group, or anything for others


class Proxy(NamedTuple):
    """A proxy that runs on this host."""

    name: str
    pid: int | None  #: of the process; None if it is too busy to say
    path: Path  #: its socket


class Directory:
    """The directory of sockets, seen by a user: :func:`find_directory` makes one."""

    def __init__(self, path: Path, gid: int | None) -> None:
        self.path = path
        self.gid = gid

    def socket_path(self, name: str) -> Path:
        """Where the socket of a name is. Raises :class:`UsageError` for what cannot be a name, or a path too long."""
        check_name(name)
        path = self.path / (name + _SUFFIX)
        if len(os.fsencode(path)) > MAX_PATH:
            raise UsageError(
                f"the socket's path {path} has {len(os.fsencode(path))} bytes and may have {MAX_PATH}: "
                f"set {DIRECTORY_VARIABLE} to a shorter directory"
            )
        return path

    def create(self) -> None:
        """Make the directory if it is missing, give it to the group if there is one, and check it."""
        self.path.parent.mkdir(mode=0o700 if self.gid is None else 0o755, parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            self.path.mkdir(mode=0o700)
        if self.gid is not None and self.path.lstat().st_uid == os.geteuid():
            os.chown(self.path, -1, self.gid, follow_symlinks=False)
            self.path.chmod(0o750)
        self.check()

    def check(self) -> None:
        """Raise :class:`LinkError` if anybody else could put a socket here.

        Raises ``FileNotFoundError`` if there is no such directory.
        """
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
                f"{self.path.parent}, which holds {self.path.name}, can be changed by others: "
                f"set {DIRECTORY_VARIABLE} to a directory in a place of your own"
            )

    def proxies(self) -> list[Proxy]:
        """Those that run, by name; what killed ones left is removed."""
        try:
            self.check()
        except FileNotFoundError:
            return []
        found = []
        with self.lock():
            for path in sorted(self.path.glob("*" + _SUFFIX)):
                name = path.name.removesuffix(_SUFFIX)
                if not NAME.fullmatch(name):
                    continue
                if is_live(path):
                    found.append(Proxy(name, owner_pid(path), path))
                else:
                    with contextlib.suppress(OSError):  # a group's member may look, but not remove
                        path.unlink()
        return found

    def listen(self, name: str) -> tuple[Socket, int]:
        """A listening socket under this name, and the inode of its file, for :meth:`remove`.

        Raises :class:`NameTakenError` if a running proxy has the name.
        """
        path = self.socket_path(name)
        self.create()
        with self.lock():
            if is_live(path):
                pid = owner_pid(path)
                raise NameTakenError(
                    f"the name {name!r} is in use by a running proxy"
                    f"{f' (pid {pid})' if pid is not None else ''}: choose another, or stop that one"
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
        """Remove the socket of a name if it is still the one with this inode."""
        path = self.socket_path(name)
        with contextlib.suppress(OSError, LinkError), self.lock():
            if path.lstat().st_ino == inode:
                path.unlink()

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Nobody else changes the directory meanwhile. Raises :class:`LinkError` if it can't be had in 2 s."""
        descriptor = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            _lock(descriptor, self.path)
            yield
        finally:
            os.close(descriptor)

    @staticmethod
    def _lstat(path: Path) -> os.stat_result:
        try:
            return path.lstat()
        except PermissionError as error:
            raise LinkError(f"cannot look into {path.parent}: {error.strerror}; its owner or group only may") from None


def find_directory(group: str | None = None) -> Directory:
    """The directory of this user, or the one that a group shares (default: ``SKYLOOP_GROUP``). Touches nothing.

    Raises :class:`UsageError` for a group that does not exist or has no directory that its members can reach.
    """
    group = group or os.environ.get(GROUP_VARIABLE) or None
    configured = os.environ.get(DIRECTORY_VARIABLE)
    if group is not None and not configured:
        raise UsageError(
            f"the group {group!r} needs a directory that its members can reach: set {DIRECTORY_VARIABLE}, "
            f"for example to /var/tmp/skyloop-{group}"
        )
    path = Path(configured) if configured else _default_path()
    return Directory(path.absolute(), None if group is None else _group_id(group))


def _group_id(group: str) -> int:
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise UsageError(f"there is no group named {group!r} on this host (see: getent group)") from None


def _default_path() -> Path:
    import platformdirs

    with warnings.catch_warnings():
        # It warns where there is no XDG_RUNTIME_DIR; that the fallback is safe is checked here.
        warnings.simplefilter("ignore")
        return Path(platformdirs.user_runtime_dir("skyloop", appauthor=False))


def is_live(path: Path) -> bool:
    """Whether a process holds the socket at this path."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        code = probe.connect_ex(os.fspath(path))
    return code not in (errno.ECONNREFUSED, errno.ENOENT)


def owner_pid(path: Path) -> int | None:
    """The process that listens at this path; None if that can't be told at once."""
    probe = Socket()
    probe.setblocking(False)
    try:
        probe.connect(os.fspath(path))
        return credentials(probe).pid
    except OSError:
        return None


def connect(path: Path) -> Socket:
    """A connection to the socket at this path. Raises ``OSError``, within a second even if nobody accepts."""
    sock = Socket()
    # Without it a connect waits for ever where the owner is stopped and its queue of callers is full.
    set_timeout(sock, socket.SO_SNDTIMEO, CONNECT_TIMEOUT_S)
    sock.connect(os.fspath(path))
    return sock


def set_timeout(sock: socket.socket, option: int, seconds: float) -> None:
    """Limit how long the kernel blocks in a call; the call then fails with ``EAGAIN``."""
    whole = int(seconds)
    sock.setsockopt(socket.SOL_SOCKET, option, struct.pack("@ll", whole, int((seconds - whole) * 1e6)))


def _lock(descriptor: int, path: Path) -> None:
    deadline = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise LinkError(f"{path} is locked by another process, which seems to be stopped") from None
            time.sleep(0.005)
        else:
            return
