"""Make Skyloop in this process, and in all its children, believe that it runs on Windows or macOS.

    SKYLOOP_PRETEND=win32 PYTHONPATH=tests/support/elsewhere python -m pytest -m "not slow"

Python imports this module at its start. Modules of ``skyloop``, and only those, get stand-ins for the modules of the
standard library that differ: names that the other system lacks are missing, and the few that only it has are imitated
where the imitation is simple (locks, named memory, pipes, ending processes, files in use). Libraries and the tests keep
the real ones. This shows what Skyloop itself needs, and nothing about other libraries, paths or file permissions there.
"""

from __future__ import annotations

import builtins
import contextlib
import errno
import importlib.abc
import importlib.machinery
import itertools
import mmap
import os
import re
import select
import selectors
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

PRETEND = os.environ.get("SKYLOOP_PRETEND", "")
_LINUX_OS = (
    "memfd_create", "MFD_CLOEXEC", "MFD_ALLOW_SEALING", "eventfd", "eventfd_read", "eventfd_write", "EFD_CLOEXEC",
    "EFD_NONBLOCK", "posix_fallocate", "sched_getaffinity", "sched_setaffinity", "sched_setscheduler", "pidfd_open",
)  # fmt: skip
_POSIX_OS = (
    "fork", "register_at_fork", "nice", "getuid", "geteuid", "getgid", "getegid", "getgroups", "chown", "fchown",
    "fchmod", "killpg", "setsid", "getpgid", "pread", "getloadavg", "uname", "setpriority", "getpriority", "mkfifo",
    "O_DIRECTORY", "O_NOFOLLOW", "O_CLOEXEC", "O_NONBLOCK", "fpathconf", "openpty", "execv",
)  # fmt: skip
_LINUX_SOCKET = ("SO_PEERCRED", "MSG_CMSG_CLOEXEC", "SO_BINDTODEVICE", "SOCK_CLOEXEC")
_POSIX_SOCKET = (
    "AF_UNIX", "SCM_RIGHTS", "CMSG_SPACE", "CMSG_LEN", "send_fds", "recv_fds", "MSG_DONTWAIT", "MSG_NOSIGNAL",
    "SO_REUSEADDR",  # exists on Windows, where it lets any program take over a port
)  # fmt: skip
_MISSING: Mapping[str, Mapping[str, Sequence[str]]] = {
    "darwin": {
        "os": _LINUX_OS,
        "socket": _LINUX_SOCKET,
        "select": ("epoll", "EPOLLIN"),
        "mmap": ("MAP_POPULATE",),
        "time": ("CLOCK_BOOTTIME",),
    },
    "win32": {
        "os": (*_LINUX_OS, *_POSIX_OS),
        "socket": (*_LINUX_SOCKET, *_POSIX_SOCKET),
        "select": ("epoll", "EPOLLIN", "poll", "POLLIN", "POLLOUT"),
        "mmap": ("MAP_POPULATE", "MAP_SHARED", "PROT_READ", "PROT_WRITE"),
        "signal": ("SIGKILL", "SIGHUP", "SIGCONT", "SIGSTOP", "SIGUSR1", "SIGUSR2", "SIGQUIT", "pthread_kill"),
        "time": ("CLOCK_BOOTTIME", "clock_gettime_ns", "clock_gettime"),
    },
}
_ABSENT = {
    "darwin": frozenset[str](),
    "win32": frozenset({"curses", "fcntl", "grp", "pty", "pwd", "resource", "termios", "tty", "_posixshmem"}),
}
_REAL_NAMES = {"os": os, "socket": socket, "select": select, "mmap": mmap, "signal": signal, "sys": sys}


class _StandIn(types.ModuleType):
    """A module with some names missing and others replaced; everything else is the real module's."""

    def __init__(self, real: types.ModuleType, missing: Sequence[str], **replaced: Any) -> None:
        super().__init__(real.__name__)
        self.__dict__.update(_real=real, _missing=frozenset(missing), _before={}, **replaced)

    def __getattr__(self, name: str) -> Any:
        if name in self._missing:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        return getattr(self._real, name)

    def __setattr__(self, name: str, value: Any) -> None:  # tests replace attributes
        if name in self.__dict__:  # differs from the real module's
            self.__dict__[name] = value
        else:
            self._before.setdefault(name, getattr(self._real, name, None))
            setattr(self._real, name, value)

    def __delattr__(self, name: str) -> None:  # tests put back what they replaced
        if name in self._before:  # not if it was replaced twice, and has been put back
            setattr(self._real, name, self._before.pop(name))

    def __dir__(self) -> list[str]:
        return [name for name in dir(self._real) if name not in self._missing]


class TaggedMemory(mmap.mmap):
    """Memory with a name, as on Windows: an unknown name makes it, and the end of its last user frees it."""

    def __new__(
        cls, number: int, length: int, *args: Any, tagname: str = "", access: int = 0, **more: Any
    ) -> TaggedMemory:
        if not tagname:
            return super().__new__(cls, number, length, *args, access=access, **more)  # type: ignore[misc]
        name = f"as-on-windows-{tagname}"
        file = _in_use(_tagged(name))
        if file is None:
            file = os.memfd_create(name)
            os.ftruncate(file, length)
        try:
            return super().__new__(cls, file, length, access=access)  # keeps a duplicate of the descriptor
        finally:
            os.close(file)


def _tagged(name: str) -> str:
    return f"/memfd:{name} (deleted)"


class _Winapi(types.ModuleType):
    """What makes and opens memory with a name: handles are descriptors."""

    INVALID_HANDLE_VALUE, NULL, PAGE_READWRITE, FILE_MAP_READ, ERROR_ALREADY_EXISTS = 2**64 - 1, 0, 4, 4, 183

    def __init__(self) -> None:
        super().__init__("_winapi")
        self._newest = threading.local()

    def CreateFileMapping(self, _file: int, _security: int, _protect: int, high: int, low: int, name: str) -> int:  # noqa: N802
        name = f"as-on-windows-{name}"
        found = _in_use(_tagged(name))
        self._newest.error = 0 if found is None else self.ERROR_ALREADY_EXISTS
        if found is None:
            found = os.memfd_create(name)
            os.ftruncate(found, (high << 32) + low)
        return found

    def OpenFileMapping(self, _access: int, _inherit: bool, name: str) -> int:  # noqa: N802
        found = _in_use(_tagged(f"as-on-windows-{name}"))
        if found is None:
            raise FileNotFoundError(errno.ENOENT, "no memory of that name (WinError 2)")
        return found

    def GetLastError(self) -> int:  # noqa: N802
        error: int = self._newest.error
        return error

    def CloseHandle(self, handle: int) -> None:  # noqa: N802
        os.close(handle)


def _in_use(link: str) -> int | None:
    """Open what any process has open under this name."""
    for path in _open_as(link):
        with contextlib.suppress(OSError):
            return os.open(path, os.O_RDWR)
    return None


def _open_as(link: str) -> list[str]:
    found = []
    for process in os.scandir("/proc"):
        with contextlib.suppress(OSError):  # no process, or one that ends
            for file in os.scandir(f"{process.path}/fd"):
                with contextlib.suppress(OSError):
                    if os.readlink(file) == link:  # noqa: PTH115  (``Path.readlink`` takes several times longer)
                        found.append(file.path)
    return found


class _WindowsPopen(subprocess.Popen):  # type: ignore[type-arg]
    """Processes have flags, and ending one is the same as killing it."""

    def __init__(self, *args: Any, creationflags: int = 0, **more: Any) -> None:
        assert not {"start_new_session", "preexec_fn", "process_group", "user"} & more.keys(), "not on Windows"
        assert not more.get("pass_fds"), "not on Windows"
        super().__init__(*args, start_new_session=bool(creationflags & 0x200), **more)

    def terminate(self) -> None:
        super().send_signal(signal.SIGKILL)

    kill = terminate

    def send_signal(self, sig: int) -> None:
        if sig == signal.SIGTERM:
            self.terminate()
        elif sig:
            raise ValueError(f"unsupported signal: {sig}")

    def _handle_exitstatus(self, sts: int, *args: Any, **more: Any) -> None:
        super()._handle_exitstatus(sts, *args, **more)  # type: ignore[misc]
        if self.returncode is not None and self.returncode < 0:
            self.returncode = 1  # as ``TerminateProcess`` is told to say


def _is_open(path: Any) -> bool:
    """Return whether any process has this file open. Python opens files on Windows so that no one can remove them."""
    return bool(_open_as(os.path.realpath(path)))


def _keep_open_files() -> None:
    """Let Skyloop neither remove nor replace a file that is open."""

    def guarded(owner: Any, name: str) -> Callable[..., Any]:
        real = getattr(owner, name)

        def call(*paths: Any, **more: Any) -> Any:
            if sys._getframe(1).f_globals.get("__name__", "").startswith("skyloop"):
                for path in paths:
                    if Path(path).is_file() and _is_open(path):
                        raise PermissionError(errno.EACCES, "in use by another process (WinError 32)", str(path))
            return real(*paths, **more)

        return call

    for owner, name in itertools.product((Path, os), ("unlink", "rename", "replace")):
        setattr(owner, name, guarded(owner, name))


_EXCLUSIVE = ~4  # ``SO_EXCLUSIVEADDRUSE``


def _share_no_ports() -> None:
    """Let no listener of Skyloop share its port with other programs, as SO_REUSEADDR would."""
    real = socket.socket.setsockopt

    def setsockopt(sock: socket.socket, level: int, option: int, *value: Any) -> None:
        if sys._getframe(1).f_globals.get("__name__", "").startswith("skyloop") and level == socket.SOL_SOCKET:
            assert option != socket.SO_REUSEADDR, "on Windows, other programs could listen on the same port"
            option = socket.SO_REUSEADDR if option == _EXCLUSIVE else option
        real(sock, level, option, *value)

    socket.socket.setsockopt = setsockopt  # type: ignore[assignment]


def _only_sockets(*waited: Any) -> Any:
    """Wait as ``select.select`` does on Windows: for sockets, of which there must be one."""
    for each in (found := [*waited[0], *waited[1]]):
        if not stat.S_ISSOCK(os.fstat(each if isinstance(each, int) else each.fileno()).st_mode):
            raise OSError(errno.ENOTSOCK, f"{each} is not a socket (WinError 10038)")
    if not found:
        raise OSError(errno.EINVAL, "no socket to wait for (WinError 10022)")
    with _uninterrupted():
        return select.select(*waited)


class _WindowsSelector(selectors.SelectSelector):
    def _select(self, readers: Any, writers: Any, _: Any, timeout: float | None = None) -> Any:
        readers, writers, failed = _only_sockets(readers, writers, writers, timeout)
        return readers, writers + failed, []


def _fsync(file: Any) -> None:
    """Flush a file that is open for writing; others can't be flushed."""
    import fcntl

    if fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))
    os.fsync(file)


def _link(source: Any, target: Any, *, follow_symlinks: bool = True) -> None:
    if not follow_symlinks:
        raise NotImplementedError("link: follow_symlinks unavailable on this platform")
    os.link(source, target)


#: Before Python 3.13: ``monotonic`` is ``GetTickCount64``, in steps of 15.6 ms, and ``perf_counter`` begins elsewhere.
_TICK_NS = 15_625_000
_WINDOWS_CLOCKS: Mapping[str, Callable[[], float]] = {
    "monotonic_ns": lambda: time.monotonic_ns() // _TICK_NS * _TICK_NS,
    "monotonic": lambda: time.monotonic_ns() // _TICK_NS * _TICK_NS / 1e9,
    "perf_counter_ns": lambda: time.perf_counter_ns() + 10**15,
    "perf_counter": lambda: time.perf_counter() + 1e6,
}


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Wait as on Windows before Python 3.14, where Ctrl-C does not end a wait for a lock."""
    signals = {signal.SIGINT, signal.SIGTERM}
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _WindowsEvent(threading.Event):
    def wait(self, timeout: float | None = None) -> bool:
        with _uninterrupted():
            return super().wait(timeout)


class _WindowsCondition(threading.Condition):
    def wait(self, timeout: float | None = None) -> bool:
        with _uninterrupted():
            return super().wait(timeout)


class _WindowsThread(threading.Thread):
    def join(self, timeout: float | None = None) -> None:
        with _uninterrupted():
            super().join(timeout)


def _tcp_pair() -> tuple[socket.socket, socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        far = socket.create_connection(server.getsockname())
        return server.accept()[0], far


def _wait_for_console(_: Any, wait_ms: int) -> int:
    """Wait for a key in the terminal, which sends each one at once from here on."""
    import termios
    import tty

    if termios.tcgetattr(0)[3] & termios.ICANON:
        tty.setcbreak(0, termios.TCSANOW)
    poll = select.poll()
    poll.register(0, select.POLLIN)
    return 0 if poll.poll(wait_ms) else 0x102


def _read_console(_: Any, records: Any, most: int, count: Any) -> int:
    """Turn what the terminal sends into records of pressed keys."""
    keys = re.findall(r"\x1b\[[A-D]|.", os.read(0, most).decode(errors="replace"), re.DOTALL)
    for record, key in zip(records, keys, strict=False):
        record.kind, record.down, record.key, record.character = 1, 1, 0, ord(key[-1])
        if len(key) > 1:
            record.key, record.character = {"A": 0x26, "B": 0x28, "C": 0x27, "D": 0x25}[key[-1]], 0
    count._obj.value = len(keys)
    return 1


def _kill(pid: int, number: int) -> None:
    """Send Ctrl-C to a group (signal 0), or end a process, whatever the signal."""
    raise AssertionError(f"os.kill({pid}, {number}) would end the process on Windows")


def _locking(descriptor: int, mode: int, _: int) -> None:
    import fcntl

    assert mode == 2
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise PermissionError(*error.args) from None


def _peek(handle: Any, _buffer: Any, _size: int, _read: Any, there: Any, _left: Any) -> int:
    poll = select.poll()
    poll.register(handle.value, select.POLLIN)
    ready = dict(poll.poll(0)).get(handle.value, 0)
    there._obj.value = 1 if ready & select.POLLIN else 0
    return 0 if ready & select.POLLHUP and not ready & select.POLLIN else 1


def _windows() -> dict[str, types.ModuleType]:
    import asyncio
    import ctypes

    kernel32 = types.SimpleNamespace(
        PeekNamedPipe=_peek,
        GetCurrentThread=lambda: 0,
        GetCurrentProcess=lambda: 0,
        SetThreadPriority=lambda *_: 1,
        SetPriorityClass=lambda *_: 1,
        SetConsoleCtrlHandler=lambda *_: 1,
        timeBeginPeriod=lambda _: 0,
        GetStdHandle=lambda _: 1,
        GetConsoleMode=lambda *_: 0,
        WaitForSingleObject=_wait_for_console,
        ReadConsoleInputW=_read_console,
    )
    console = types.ModuleType("msvcrt")
    console.__dict__.update(LK_NBLCK=2, locking=_locking, get_osfhandle=lambda descriptor: descriptor)
    return {
        "msvcrt": console,
        "_winapi": _Winapi(),
        "ctypes": _StandIn(ctypes, (), WinDLL=lambda _: kernel32, WINFUNCTYPE=ctypes.CFUNCTYPE),
        "subprocess": _StandIn(subprocess, (), Popen=_WindowsPopen),
        "asyncio": _StandIn(asyncio, ()),
        "selectors": _StandIn(selectors, (), DefaultSelector=_WindowsSelector),
        "threading": _StandIn(threading, (), Event=_WindowsEvent, Condition=_WindowsCondition, Thread=_WindowsThread),
    }


def stand_ins(system: str) -> dict[str, types.ModuleType]:
    """Return the modules that Skyloop gets in place of the real ones."""
    real = {**_REAL_NAMES, "time": time}
    found: dict[str, types.ModuleType] = {
        name: _StandIn(real[name], missing) for name, missing in _MISSING[system].items()
    }
    found["sys"] = _StandIn(sys, (), platform=system)
    if system == "darwin":  # the first counts on while the computer sleeps, as Linux's other one does not
        clocks = {"CLOCK_MONOTONIC_RAW": time.CLOCK_BOOTTIME, "CLOCK_UPTIME_RAW": time.CLOCK_MONOTONIC}
        found["time"].__dict__.update(clocks)
    if system == "win32":
        found |= _windows()
        found["socket"].__dict__["SO_EXCLUSIVEADDRUSE"] = _EXCLUSIVE
        found["mmap"].__dict__["mmap"] = TaggedMemory
        found["select"].__dict__["select"] = _only_sockets
        found["socket"].__dict__["socketpair"] = _tcp_pair
        found["time"].__dict__.update(_WINDOWS_CLOCKS)
        found["signal"].__dict__["SIGBREAK"] = signal.SIGUSR1
        found["os"].__dict__.update(fsync=_fsync, link=_link, kill=_kill)
    return found


class _Finder(importlib.abc.MetaPathFinder):
    """Finds Skyloop's modules as usual, and gives them an ``import`` that returns the stand-ins."""

    def __init__(self, system: str) -> None:
        self._found = stand_ins(system)
        self._absent = _ABSENT[system]
        self._builtins = {**vars(builtins), "__import__": self._import}

    def find_spec(self, name: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        if name != "skyloop" and not name.startswith("skyloop."):
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            real = spec.loader.exec_module

            def exec_module(module: types.ModuleType) -> None:
                module.__dict__["__builtins__"] = self._builtins
                real(module)

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec

    def _import(
        self, name: str, importer: Any = None, locals_: Any = None, wanted: Sequence[str] = (), level: int = 0
    ) -> Any:
        top = name.partition(".")[0]
        if not level and top in self._absent:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if not level and name in self._found:
            return self._found[name]
        return builtins.__import__(name, importer, locals_, wanted, level)


if PRETEND:
    if PRETEND not in _MISSING:
        sys.exit(f"SKYLOOP_PRETEND is {PRETEND!r} and must be one of {', '.join(_MISSING)}")
    sys.meta_path.insert(0, _Finder(PRETEND))
    if PRETEND == "win32":
        _keep_open_files()
        _share_no_ports()
