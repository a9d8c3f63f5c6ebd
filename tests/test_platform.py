"""The sides of :mod:`skyloop.platform` for other systems, run here with stand-ins for what those systems have."""

from __future__ import annotations

import asyncio
import ctypes
import os
import select
import signal
import socket
import subprocess
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from skyloop import platform
from skyloop.child_process import ChildProcess
from skyloop.clock import slept_ns
from tests.support.systems import only_on

pytestmark = only_on("linux", reason="compares the sides of Linux and Windows, and pretends that itself")


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Become Windows, with these names in ``msvcrt`` and these functions in ``kernel32``."""

    def become(msvcrt: dict[str, Any] | None = None, **kernel32: Callable[..., Any]) -> None:
        monkeypatch.setitem(sys.modules, "msvcrt", types.SimpleNamespace(**(msvcrt or {})))
        library = types.SimpleNamespace(**kernel32)
        monkeypatch.setattr(ctypes, "WinDLL", lambda _: library, raising=False)
        monkeypatch.setattr(ctypes, "WINFUNCTYPE", ctypes.CFUNCTYPE, raising=False)
        monkeypatch.setattr(sys, "platform", "win32")

    return become


def test_ctrl_c_reaches_no_child(windows: Callable[..., None]) -> None:
    assert platform.own_session((7,)) == {"start_new_session": True, "pass_fds": (7,)}
    windows()
    flags = platform.own_session()["creationflags"]
    assert flags & 0x200, "a group of its own"
    assert flags & 0x08000000, "no window"


def test_a_session_is_ended_with_its_children(windows: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'print(1, flush=True); input()'])"
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, **platform.own_session()
    )
    assert child.stdin is not None
    assert child.stdout is not None
    with child.stdin, child.stdout:
        assert child.stdout.readline() == b"1\n"
        platform.end_session(child)
        assert child.stdout.read() == b"", "the grandchild, which had the same output, has ended, too"
        child.wait()
    platform.end_session(child)

    windows()
    ran: list[list[str]] = []
    monkeypatch.setattr(subprocess, "run", lambda command, **_: ran.append(command))
    platform.end_session(child)
    assert ran[0][0].endswith("System32/taskkill.exe"), "none of the current directory"
    assert ran[0][1:] == ["/f", "/t", "/pid", str(child.pid)]


def test_a_listener_shares_its_port_with_no_program(
    windows: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "SO_EXCLUSIVEADDRUSE", ~4, raising=False)
    options: list[tuple[int, int, int]] = []
    listener: Any = types.SimpleNamespace(setsockopt=lambda *values: options.append(values))
    platform.claim_port(listener)
    windows()
    platform.claim_port(listener)
    assert options == [(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1), (socket.SOL_SOCKET, ~4, 1)]


@pytest.mark.parametrize("system", ["here", "windows"])
def test_the_tail_of_a_file_leaves_its_writers_position_alone(
    system: str, windows: Callable[..., None], tmp_path: Path
) -> None:
    with (tmp_path / "errors").open("w+b", buffering=0) as file:
        file.write(b"0123456789")
        if system == "windows":
            windows()
        assert platform.read_tail(file.fileno(), 4) == b"6789"
        assert platform.read_tail(file.fileno(), 40) == b"0123456789"
        file.write(b"x")
        assert platform.read_tail(file.fileno(), 4) == b"789x"


def test_output_of_a_child_is_waited_for() -> None:
    child = ChildProcess([sys.executable, "-c", "import os; os.write(1, b'ready'); input()"])
    try:
        assert platform.read_within(child.stdout, 30.0) == b"ready"
        assert platform.read_within(child.stdout, 0.0) is None
        child.part()
        assert platform.read_within(child.stdout, 30.0) == b""
    finally:
        child.close()


def test_output_of_a_child_is_waited_for_on_windows(windows: Callable[..., None]) -> None:
    reader, writer = os.pipe()
    asked: list[int] = []
    with os.fdopen(reader, "rb", buffering=0) as pipe:

        def peek(handle: Any, _buffer: None, _size: int, _read: None, there: Any, _left: None) -> int:
            assert handle.value == reader + 1000
            asked.append(1)
            if len(asked) == 3:
                os.write(writer, b"ready")
            there._obj.value = 5 if len(asked) == 3 else 0
            return len(asked) < 6  # fails once the other end is closed

        windows({"get_osfhandle": lambda descriptor: descriptor + 1000}, PeekNamedPipe=peek)
        assert platform.read_within(pipe, 10.0) == b"ready"
        assert platform.read_within(pipe, 0.0) is None
        os.close(writer)
        assert platform.read_within(pipe, 10.0) == b""


def test_priorities(windows: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[tuple[object, ...]] = []
    monkeypatch.setattr(os, "nice", lambda by: done.append(("nice", by)))
    platform.lower_priority(10, thread_only=True)
    monkeypatch.setattr(sys, "platform", "darwin")
    platform.lower_priority(10, thread_only=True)  # would slow the whole process
    platform.lower_priority(5)
    windows(
        GetCurrentThread=lambda: -2,
        GetCurrentProcess=lambda: -1,
        SetThreadPriority=lambda thread, priority: done.append((thread.value, priority)),
        SetPriorityClass=lambda process, kind: done.append((process.value, kind)),
    )
    platform.lower_priority(10, thread_only=True)
    platform.lower_priority(10)
    assert done == [("nice", 10), ("nice", 5), (2**64 - 2, -2), (2**64 - 1, 0x4000)]


@pytest.mark.parametrize("system", ["here", "windows"])
def test_a_signal_reaches_the_event_loop(system: str, windows: Callable[..., None]) -> None:
    async def run() -> None:
        ending = asyncio.Event()
        if system == "windows":
            windows()
        platform.on_signals([signal.SIGUSR1], ending.set)
        signal.raise_signal(signal.SIGUSR1)
        await asyncio.wait_for(ending.wait(), 10.0)

    before = {number: signal.getsignal(number) for number in (signal.SIGUSR1, signal.SIGINT)}
    try:
        asyncio.run(run())
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_lock_ends_with_its_file(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with path.open("wb") as first, path.open("wb") as second:
        assert platform.lock_file(first.fileno(), 0.0)
        assert not platform.lock_file(second.fileno(), 0.0)
        first.close()
        assert platform.lock_file(second.fileno(), None)


def test_a_lock_of_windows(windows: Callable[..., None], tmp_path: Path) -> None:
    answers: list[BaseException | None] = [PermissionError(13, "denied"), None, OSError(9, "bad file"), None]
    asked: list[tuple[int, ...]] = []

    def locking(*given: int) -> None:
        asked.append(given)
        answer = answers.pop(0)
        if answer is not None:
            raise answer

    with (tmp_path / "lock").open("wb") as file:
        number = file.fileno()
        windows({"locking": locking, "LK_NBLCK": 2})
        assert not platform.lock_file(number, -1.0)
        assert platform.lock_file(number, None)
        with pytest.raises(OSError, match="bad file"):
            platform.lock_file(number, None)
        assert asked == [(number, 2, 1)] * 3


def test_modes_of_files_say_nothing_on_windows(windows: Callable[..., None]) -> None:
    assert platform.is_open_to_others(0o640)
    assert not platform.is_open_to_others(0o100600)
    windows()
    assert not platform.is_open_to_others(0o666)


def test_keys_of_a_windows_console(windows: Callable[..., None]) -> None:
    w, grave, shift, up, escape = (0x57, "w"), (0x30, "à"), (0x10, "\0"), (0x26, "\0"), (0x1B, "\x1b")
    typed = [(1, True, *w), (1, False, *w), (1, True, *shift), (1, True, *up), (16, True, 0, "\0")]
    typed += [(1, True, *grave), (1, True, *escape), (1, True, 0, "\ud83d")]

    def read(console: Any, records: Any, most: int, count: Any) -> int:
        assert console.value == 3
        count._obj.value = min(most, len(typed))
        for record in records[: count._obj.value]:
            record.kind, record.down, record.key, character = typed.pop(0)
            record.character = ord(character)
        return 1

    waits: list[int] = []

    def wait(_console: Any, wait_ms: int) -> int:
        waits.append(wait_ms)
        return 0 if typed else 0x102

    windows(
        GetStdHandle=lambda number: 3 if number == -10 else None,
        GetConsoleMode=lambda *_: 0,
        WaitForSingleObject=wait,
        ReadConsoleInputW=read,
    )
    with platform.single_keys(0) as keys:
        assert keys(1.0) == b"w\x1b[A" + "à".encode() + b"\x1b?"
        assert keys(0.5) is None
        assert waits == [1000, 500]
        typed += [(1, False, *w)]
        assert keys(0.0) is None, "a released key is none"


def test_an_input_record_has_the_layout_of_windows() -> None:
    assert ctypes.sizeof(platform._input_record()) == 20
    assert platform._input_record().character.offset == 14


@pytest.mark.parametrize("is_console", [True, False])
def test_a_click_into_a_windows_console_stops_no_flight(windows: Callable[..., None], is_console: bool) -> None:
    """By default it selects text, and output then waits until the selection ends."""
    modes = {3: 0x1F7, 4: 0x3}

    def get(console: Any, mode: Any) -> int:
        mode._obj.value = modes[console.value]
        return is_console

    windows(
        GetStdHandle=lambda number: {-10: 3, -11: 4}[number],
        GetConsoleMode=get,
        SetConsoleMode=lambda console, mode: modes.update({console.value: mode}),
    )
    with platform.single_keys(0):
        assert modes[3] == (0x1B7 if is_console else 0x1F7)
    assert modes[3] == 0x1F7
    platform.show_escapes()
    assert modes[4] == (0x7 if is_console else 0x3)


def test_a_closed_console_of_windows_leaves_time_to_land(
    windows: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows ends the process when the handler returns."""
    handlers: list[Callable[[int], int]] = []
    called: list[str] = []

    def handle(handler: Callable[[int], int], on: int) -> int:
        (handlers.append if on else handlers.remove)(handler)
        return 1

    windows(SetConsoleCtrlHandler=handle)
    monkeypatch.setattr(time, "sleep", lambda seconds: called.append(f"waits {seconds:g} s"))
    with platform.on_console_close(lambda: called.append("lands")):
        assert handlers[0](0) == handlers[0](1) == 0, "Ctrl-C and Ctrl-Break are Python's"
        assert called == []
        assert handlers[0](2) == 0
        assert called == ["lands", "waits 60 s"]
    assert handlers == []


def test_waits_are_precise(windows: Callable[..., None]) -> None:
    asked: list[int] = []
    windows(timeBeginPeriod=asked.append)
    platform.wait_precisely.cache_clear()
    platform.wait_precisely()
    platform.wait_precisely()
    assert asked == [1]


def test_a_file_that_is_read_can_be_changed_a_moment_later(windows: Callable[..., None]) -> None:
    tries: list[int] = []

    def change() -> None:
        tries.append(1)
        if len(tries) < 4:
            raise PermissionError(13, "in use")

    with pytest.raises(PermissionError):
        platform.change_file(change)
    assert len(tries) == 1, "elsewhere, this is no matter of time"
    windows()
    platform.change_file(change)
    assert len(tries) == 4

    def refuse() -> None:
        raise PermissionError(13, "not yours")

    with pytest.raises(PermissionError, match="not yours"):
        platform.change_file(refuse)


def test_a_terminal_of_macos_is_waited_for_with_select(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(select, "poll", None)
    reader, writer = os.pipe()
    try:
        assert not platform.wait_readable(reader, 0.0)
        os.write(writer, b"x")
        assert platform.wait_readable(reader, 10.0)
        monkeypatch.undo()
        monkeypatch.setattr(sys, "platform", "darwin")
        os.dup2(reader, 1500)
        try:
            assert platform.wait_readable(1500, 10.0), "select takes descriptors up to 1,023"
        finally:
            os.close(1500)
    finally:
        os.close(reader)
        os.close(writer)


def test_macos_says_how_long_it_has_slept(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = {"CLOCK_MONOTONIC_RAW": 4, "CLOCK_UPTIME_RAW": 8}
    for name, number in clocks.items():
        monkeypatch.setattr(time, name, number, raising=False)
    monkeypatch.setattr(time, "clock_gettime_ns", lambda clock: {4: 500, 8: 200}[clock])
    monkeypatch.setattr(sys, "platform", "darwin")
    assert slept_ns() == 300


def test_bytes_that_wake_a_thread_of_windows_are_not_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        pair = socket.create_connection(server.getsockname()), server.accept()[0]
    monkeypatch.setattr(socket, "socketpair", lambda: pair)
    for end in platform.socket_pair():
        with end:
            assert end.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
