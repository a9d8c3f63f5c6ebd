"""What differs between Linux, macOS and Windows, for everything but the transport within one host.

Each function has a side for each system. The sides for macOS and Windows follow their documentation, as the comments
say, and have not been run on a real machine (``docs/platforms.md``); the tests run them on Linux with stand-ins.
Modules that another system lacks are imported where they are used.
"""

from __future__ import annotations

import asyncio
import functools
import math
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import IO, TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from _typeshed import FileDescriptorLike

# learn.microsoft.com/windows/win32/procthread/process-creation-flags
_CREATE_NEW_PROCESS_GROUP: Final = 0x00000200
_CREATE_NO_WINDOW: Final = 0x08000000
_BELOW_NORMAL_PRIORITY_CLASS: Final = 0x00004000
#: learn.microsoft.com/windows/win32/api/processthreadsapi/nf-processthreadsapi-setthreadpriority
_THREAD_PRIORITY_LOWEST: Final = -2
_POLL_S: Final = 0.005  # how often to ask where the system can't wait
_CHUNK: Final = 4096
_IN_USE_S: Final = 0.5  # how long to wait for programs that read a file before it is replaced or removed
_CTRL_CLOSE_EVENT: Final = 2  # this and greater ones: the console closes, the user logs off, the computer shuts down
_CLOSING_S: Final = 60.0  # longer than Windows waits for a process whose console has been closed
_STD_INPUT_HANDLE: Final = -10
_STD_OUTPUT_HANDLE: Final = -11
#: learn.microsoft.com/windows/console/setconsolemode
_ENABLE_VIRTUAL_TERMINAL_PROCESSING: Final = 0x0004
_ENABLE_QUICK_EDIT_MODE: Final = 0x0040
_ENABLE_EXTENDED_FLAGS: Final = 0x0080
_KEY_EVENT: Final = 1
#: What POSIX terminals send for the arrows, by virtual-key code (learn.microsoft.com/windows/win32/inputdev).
_ARROWS: Final = {0x26: b"\x1b[A", 0x28: b"\x1b[B", 0x27: b"\x1b[C", 0x25: b"\x1b[D"}


# Processes ------------------------------------------------------------------------------------------------------


def own_session(inherited: Sequence[int] = ()) -> dict[str, Any]:
    """Return options of ``subprocess.Popen`` for a child that Ctrl-C in the parent's terminal does not reach.

    ``inherited``: file descriptors that the child inherits, on POSIX only. A Windows child is not put into a job that
    ends with its parent: the proxy of a flying vehicle must outlive its program for as long as the landing takes.
    """
    if sys.platform != "win32":
        return {"start_new_session": True, "pass_fds": tuple(inherited)}
    # A new group disables Ctrl-C for the child (learn.microsoft.com/windows/console/generateconsolectrlevent, remarks);
    # no window keeps a console from opening for each child of a program without one, such as a notebook's.
    return {"creationflags": _CREATE_NEW_PROCESS_GROUP | _CREATE_NO_WINDOW}


def end_session(process: subprocess.Popen[Any]) -> None:
    """Terminate a child that was started with :func:`own_session`, and the children that it started."""
    if sys.platform != "win32":
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        return
    # Windows has no process groups to signal; taskkill ends the tree of children (/t), which outlives its root. Without
    # a path, a program of that name in the current directory would be preferred (CreateProcess, lpApplicationName).
    taskkill = os.path.join(os.environ.get("SYSTEMROOT", r"C:\Windows"), "System32", "taskkill.exe")  # noqa: PTH118
    subprocess.run([taskkill, "/f", "/t", "/pid", str(process.pid)], capture_output=True, check=False)


def read_tail(descriptor: int, most: int) -> bytes:
    """Return the last bytes of a file that another process is writing, without moving that process's position."""
    begin = max(0, os.fstat(descriptor).st_size - most)
    if sys.platform != "win32":
        return os.pread(descriptor, most, begin)
    # An inherited handle shares its file position. Put back where the other process writes, at the end.
    os.lseek(descriptor, begin, os.SEEK_SET)
    try:
        return os.read(descriptor, most)
    finally:
        os.lseek(descriptor, 0, os.SEEK_END)


def wait_readable(source: FileDescriptorLike, within_s: float) -> bool:
    """Wait until a descriptor is readable or closed; return False if neither happens within ``within_s`` [s].

    Works for any descriptor number; ``select.select`` raises an error from 1,024 on. On Windows, for sockets only.
    """
    if sys.platform == "win32":
        return bool(select.select([source], [], [], within_s)[0])
    if sys.platform == "darwin":  # whose poll(2) does not support devices, such as terminals and serial ports
        with suppress(ValueError):
            return bool(select.select([source], [], [], within_s)[0])
    poll = select.poll()
    poll.register(source, select.POLLIN)
    return bool(poll.poll(math.ceil(within_s * 1000.0)))


def read_within(pipe: IO[bytes], within_s: float) -> bytes | None:
    """Wait for output of a child and return what there is; empty at its end, None if nothing comes in time [s]."""
    descriptor = pipe.fileno()
    if sys.platform != "win32":
        return os.read(descriptor, _CHUNK) if wait_readable(descriptor, within_s) else None
    import ctypes
    import msvcrt

    # Windows waits with a time limit for sockets only: ask how much a read would return, and whether the end is there.
    # learn.microsoft.com/windows/win32/api/namedpipeapi/nf-namedpipeapi-peeknamedpipe, also for anonymous pipes
    handle, there = ctypes.c_void_p(msvcrt.get_osfhandle(descriptor)), ctypes.c_ulong()
    peek = ctypes.WinDLL("kernel32").PeekNamedPipe
    deadline_s = time.monotonic() + within_s
    while peek(handle, None, 0, None, ctypes.byref(there), None) and not there.value:
        if time.monotonic() >= deadline_s:
            return None
        time.sleep(_POLL_S)
    return os.read(descriptor, _CHUNK)


def usable_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def lower_priority(niceness: int, *, thread_only: bool = False) -> None:
    """Lower the priority of this process, or of the calling thread alone, so that flying takes precedence.

    ``niceness``: on Linux and macOS. On Linux it applies to the calling thread and the threads that it starts later, on
    macOS to the whole process; there, ``thread_only`` does nothing. Windows has priority classes instead.
    """
    if sys.platform != "win32":
        if sys.platform == "linux" or not thread_only:
            os.nice(niceness)
        return
    import ctypes

    kernel32 = ctypes.WinDLL("kernel32")
    this = kernel32.GetCurrentThread if thread_only else kernel32.GetCurrentProcess
    this.restype = ctypes.c_void_p  # a handle, which does not fit into an int
    if thread_only:
        kernel32.SetThreadPriority(ctypes.c_void_p(this()), _THREAD_PRIORITY_LOWEST)
    else:
        kernel32.SetPriorityClass(ctypes.c_void_p(this()), _BELOW_NORMAL_PRIORITY_CLASS)


def on_signals(numbers: Sequence[int], call: Callable[[], object]) -> None:
    """Call a function on the running event loop when a signal arrives. Main thread only.

    The event loops of Windows have no ``add_signal_handler``. Ctrl-C and Ctrl-Break arrive there as SIGINT and
    SIGBREAK, and ``TerminateProcess`` ends a process without any signal.
    """
    loop = asyncio.get_running_loop()
    if sys.platform != "win32":
        for number in numbers:
            loop.add_signal_handler(number, call)
        return

    def handle(*_: object) -> None:
        with suppress(RuntimeError):  # the loop has ended, and the process is about to
            loop.call_soon_threadsafe(call)

    for number in (*numbers, getattr(signal, "SIGBREAK", signal.SIGINT)):
        signal.signal(number, handle)


@contextmanager
def on_console_close(call: Callable[[], object]) -> Iterator[None]:
    """Call a function, on another thread, if the console is closed during the block. Only Windows needs this.

    Windows ends a process as soon as its handler for the event has returned, or after 5 s or less. Python's own handler
    would return at once. learn.microsoft.com/windows/console/ctrl-close-signal, …/setconsolectrlhandler
    """
    if sys.platform != "win32":
        yield
        return
    import ctypes

    def handle(kind: int) -> int:
        if kind >= _CTRL_CLOSE_EVENT:
            call()
            time.sleep(_CLOSING_S)
        return 0  # Ctrl-C and Ctrl-Break are for Python's handler

    handler = ctypes.WINFUNCTYPE(ctypes.c_int, ctypes.c_ulong)(handle)
    kernel32 = ctypes.WinDLL("kernel32")
    kernel32.SetConsoleCtrlHandler(handler, 1)
    try:
        yield
    finally:
        kernel32.SetConsoleCtrlHandler(handler, 0)


@functools.cache
def wait_precisely() -> None:
    """Let waits of this process end within 1 ms of their time, not in steps of 15.6 ms as on Windows by default.

    learn.microsoft.com/windows/win32/api/timeapi/nf-timeapi-timebeginperiod; it ends with the process.
    """
    if sys.platform == "win32":
        import ctypes

        ctypes.WinDLL("winmm").timeBeginPeriod(1)


# Sockets --------------------------------------------------------------------------------------------------------


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Return two connected sockets. Those of Windows are TCP's, which must not hold back a byte that wakes a thread."""
    pair = socket.socketpair()
    if pair[0].family == socket.AF_INET:
        for end in pair:
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return pair


def sees_peers() -> bool:
    """Return whether this system tells a server which user's program is at the other end of a loopback connection."""
    return sys.platform == "linux"


def claim_port(listener: socket.socket) -> None:
    """Let a TCP socket bind a port that was closed just now, but never one on which another program listens."""
    # Windows' SO_REUSEADDR would let both listen, and a stranger receive what is meant for the other:
    # learn.microsoft.com/windows/win32/winsock/using-so-reuseaddr-and-so-exclusiveaddruse
    if sys.platform == "win32":
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
    else:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)


# Files ----------------------------------------------------------------------------------------------------------


def lock_file(descriptor: int, timeout_s: float | None) -> bool:
    """Lock an open file as :func:`try_lock` does, waiting for others for up to ``timeout_s`` [s] (None: no limit)."""
    deadline_s = math.inf if timeout_s is None else time.monotonic() + timeout_s
    while not try_lock(descriptor):
        if time.monotonic() > deadline_s:
            return False
        time.sleep(_POLL_S)
    return True


def try_lock(descriptor: int, *, shared: bool = False) -> bool:
    """Lock an open file until it is closed or the process ends; return False if another one holds it.

    On Windows all locks are exclusive. There, the lock covers a byte behind the content, which stays readable.
    """
    if sys.platform != "win32":
        import fcntl

        try:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True
    import msvcrt

    os.lseek(descriptor, 1 << 30, os.SEEK_SET)
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    except PermissionError:
        return False
    return True


def change_file(change: Callable[[], object]) -> None:
    """Replace or remove a file. Windows refuses this while a program reads the file, so try again for a moment there.

    Python opens files without FILE_SHARE_DELETE (learn.microsoft.com/windows/win32/fileio/creating-and-opening-files).
    """
    deadline_s = time.monotonic() + (_IN_USE_S if sys.platform == "win32" else 0.0)
    while True:
        try:
            change()
        except PermissionError:
            if time.monotonic() >= deadline_s:
                raise
            time.sleep(_POLL_S)
        else:
            return


def own_uid() -> int:
    """Return this process's effective user; 0 on Windows, which has no such numbers."""
    if sys.platform == "win32":
        return 0
    return os.geteuid()


def is_own_user(user: int | None, *, or_root: bool = False) -> bool:
    """Return whether a user id is this process's own; always False on Windows, which has no such ids."""
    return sys.platform != "win32" and (user == own_uid() or (or_root and user == 0))


def is_open_to_others(mode: int) -> bool:
    """Return whether a file's mode gives access to its group or to others. False on Windows, whose modes say nothing.

    Files in a Windows user's profile are closed to other users by the access list that they inherit from it.
    """
    return sys.platform != "win32" and bool(mode & 0o077)


# Terminals ------------------------------------------------------------------------------------------------------


@contextmanager
def single_keys(terminal: int) -> Iterator[Callable[[float], bytes | None]]:
    """Let a terminal report single keys in the block, without Enter, and restore it afterwards. Main thread only.

    Yields a function that waits for keys, up to a time limit [s], and returns their bytes as POSIX terminals send them,
    None if there were none, or nothing if the terminal has been closed. Ctrl-C still interrupts; Ctrl-Z does not
    suspend a flight, and Ctrl-S has no effect.
    """
    if sys.platform == "win32":
        with _without_quick_edit():
            yield _console_keys
        return
    import termios
    import tty

    before = termios.tcgetattr(terminal)

    def set_mode(*_: object) -> None:
        tty.setcbreak(terminal, termios.TCSANOW)
        mode = termios.tcgetattr(terminal)
        mode[0] &= ~termios.IXON
        for name in ("VSUSP", "VDSUSP"):
            if hasattr(termios, name):
                mode[6][getattr(termios, name)] = bytes((os.fpathconf(terminal, "PC_VDISABLE"),))
        termios.tcsetattr(terminal, termios.TCSANOW, mode)

    def keys(within_s: float) -> bytes | None:
        return os.read(terminal, 1024) if wait_readable(terminal, within_s) else None

    set_mode()
    continued = signal.signal(signal.SIGCONT, set_mode)  # a shell may have set its own mode during a suspension
    try:
        yield keys
    finally:
        signal.signal(signal.SIGCONT, continued)
        termios.tcsetattr(terminal, termios.TCSANOW, before)


def show_escapes() -> None:
    """Let a console of Windows interpret escape sequences instead of showing them."""
    if sys.platform == "win32":
        kernel32, console, mode = _console(_STD_OUTPUT_HANDLE)
        if mode is not None:
            kernel32.SetConsoleMode(console, mode | _ENABLE_VIRTUAL_TERMINAL_PROCESSING)


@contextmanager
def _without_quick_edit() -> Iterator[None]:
    """Keep a click into a console of Windows from selecting text, which would stop the program at its next output."""
    kernel32, console, mode = _console(_STD_INPUT_HANDLE)
    if mode is not None:
        kernel32.SetConsoleMode(console, mode & ~_ENABLE_QUICK_EDIT_MODE | _ENABLE_EXTENDED_FLAGS)
    try:
        yield
    finally:
        if mode is not None:
            kernel32.SetConsoleMode(console, mode)


def _console(number: int) -> tuple[Any, Any, int | None]:
    """Return the library, the console's handle and its mode; None if this handle is of no console."""
    import ctypes

    if sys.platform != "win32":
        raise NotImplementedError
    kernel32, mode = ctypes.WinDLL("kernel32"), ctypes.c_ulong()
    kernel32.GetStdHandle.restype = ctypes.c_void_p
    console = ctypes.c_void_p(kernel32.GetStdHandle(number))
    return kernel32, console, mode.value if kernel32.GetConsoleMode(console, ctypes.byref(mode)) else None


def _console_keys(within_s: float) -> bytes | None:
    """Wait for keys in a console of Windows, by its input records.

    learn.microsoft.com/windows/console/readconsoleinput describes them. ``msvcrt.getwch`` would not do: it announces an
    arrow by the character ``à``, which French keyboards have as a key, and then waits for another one. Ctrl-C
    interrupts the program as usual and is not reported as a record.
    """
    import ctypes

    kernel32, console, _ = _console(_STD_INPUT_HANDLE)
    count = ctypes.c_ulong()
    records = (_input_record() * 64)()
    deadline_s, keys = time.monotonic() + within_s, b""
    while not keys:  # records of other kinds wake this, too: of the mouse, of keys that are released
        left_ms = max(0, math.ceil((deadline_s - time.monotonic()) * 1e3))
        if kernel32.WaitForSingleObject(console, left_ms) != 0:
            return None
        kernel32.ReadConsoleInputW(console, records, len(records), ctypes.byref(count))
        for record in records[: count.value]:
            if record.kind == _KEY_EVENT and record.down:
                arrow = _ARROWS.get(record.key)
                keys += arrow or chr(record.character).encode(errors="replace").strip(b"\0")
        if not left_ms and not keys:
            return None
    return keys


def _input_record() -> Any:
    """Return the layout of a console's input record (learn.microsoft.com/windows/console/input-record-str)."""
    import ctypes

    class Record(ctypes.Structure):
        _fields_ = (
            ("kind", ctypes.c_uint16),
            ("down", ctypes.c_int32),
            ("repeats", ctypes.c_uint16),
            ("key", ctypes.c_uint16),
            ("scan", ctypes.c_uint16),
            ("character", ctypes.c_uint16),
            ("modifiers", ctypes.c_uint32),
        )

    return Record
