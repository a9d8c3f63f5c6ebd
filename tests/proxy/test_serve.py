"""A proxy as a process: how it reports readiness, and how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from skyloop.clock import monotonic_ns
from skyloop.errors import DriverError, UsageError
from skyloop.messages import EventKind, Takeoff
from skyloop.proxy import Proxy
from skyloop.proxy.serve import Shutdown, on_signals, run, serve
from skyloop.transport.local import LocalServer, dial
from tests.proxy.toy_process import Toy
from tests.support.proxy_bench import WAIT_S, App
from tests.support.systems import only_on

pytestmark = [pytest.mark.process, pytest.mark.skipif(sys.platform != "linux", reason="the local transport is Linux's")]

ROOT = Path(__file__).parents[2]
Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    runtime = tmp_path / "run"
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(runtime))
    processes: list[subprocess.Popen[str]] = []

    def start(*arguments: str, descriptors: tuple[int, ...] = ()) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.proxy.toy_process", "toy", *arguments]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, pass_fds=descriptors)
        processes.append(process)
        assert process.stdout is not None
        ready = process.stdout.readline()
        assert ready == f"ready toy: fake:// at local:toy, process {process.pid}\n"
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def flying() -> App:
    app = App(dial("toy"), monotonic_ns)
    app.hello("pilot")
    app.take_authority()
    app.command(Takeoff())
    return app


def rest_of(process: subprocess.Popen[str]) -> list[str]:
    out, _ = process.communicate(timeout=WAIT_S)
    return out.splitlines()


def test_a_vehicle_in_flight_is_landed_if_another_cannot_be_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A flight that the first proxy had found, or begun, was left in the air."""
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    first, second = (Proxy(Toy(monotonic_ns), LocalServer(name), name=name) for name in ("toy", "other"))
    apps: list[App] = []

    def start() -> None:
        apps.append(flying())
        raise DriverError("the port is in use")

    monkeypatch.setattr(second, "start", start)
    with pytest.raises(DriverError, match="in use"):
        run([first, second], records=False)
    told = capsys.readouterr().out.splitlines()
    assert [line for line in told if line.startswith("told")] == ["told takeoff", "told land"]
    apps[0].end.close()


@pytest.fixture
def in_terminal() -> Iterator[None]:
    """Let this process and its children hear SIGHUP, which what runs the tests without a terminal may ignore."""
    if not hasattr(signal, "SIGHUP"):
        yield
        return
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(
    "number", ["SIGTERM", "SIGINT", pytest.param("SIGHUP", marks=only_on("linux", "darwin", reason="no such signal"))]
)
@pytest.mark.usefixtures("in_terminal")
def test_a_signal_lands_first_and_has_a_reason(start: Start, number: str) -> None:
    process = start()
    app = flying()
    process.send_signal(getattr(signal, number))
    assert rest_of(process) == ["told takeoff", "told land", "closed", "served"]
    assert process.returncode == 0
    app.closed_by.get(timeout=WAIT_S)
    (closing,) = [event for event in app.events if event.kind is EventKind.PROXY_CLOSING]
    assert number in closing.text
    assert next(event for event in app.events if event.kind is EventKind.FAILSAFE).data["reason"] == "closing"
    app.end.close()


@only_on("linux", "darwin", reason="no such signal")
@pytest.mark.usefixtures("in_terminal")
def test_a_closed_terminal_does_not_shorten_a_landing() -> None:
    """It sends SIGHUP, so does its shell, and the end of a session SIGTERM; there, the second one ended the wait."""
    shutdown = Shutdown()
    with on_signals(shutdown, ignore_interrupt=False):
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGTERM, signal.SIGHUP):
            signal.raise_signal(number)
            assert shutdown.requested.is_set()
            assert not shutdown.hurry.is_set()
        signal.raise_signal(signal.SIGTERM)
        assert shutdown.hurry.is_set()


@only_on("linux", "darwin", reason="no such signal")
def test_nohup_keeps_a_proxy_without_its_terminal() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    shutdown = Shutdown()
    try:
        with on_signals(shutdown, ignore_interrupt=False):
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert not shutdown.requested.is_set()


def test_ctrl_break_is_a_signal_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """On Windows, as is the end of the console; there, it ended the proxy without a landing."""
    monkeypatch.setattr(signal, "SIGBREAK", signal.SIGUSR1, raising=False)
    shutdown = Shutdown()
    with on_signals(shutdown, ignore_interrupt=False):
        signal.raise_signal(signal.SIGUSR1)
        assert shutdown.requested.is_set()
        assert not shutdown.hurry.is_set()


def test_the_end_of_the_parent_lands_a_flying_vehicle(start: Start) -> None:
    """A program killed over its private proxy leaves no one to fly, and no one to restart it."""
    reading, writing = os.pipe()
    try:
        process = start(str(reading), descriptors=(reading,))
        app = flying()
        process.send_signal(signal.SIGINT)  # the terminal's Ctrl-C is for the parent
        app.sync()
    finally:
        os.close(reading)
        os.close(writing)
    assert rest_of(process) == ["told takeoff", "told land", "closed", "served"]
    app.closed_by.get(timeout=WAIT_S)
    app.end.close()


def test_in_this_process_it_releases_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    drivers: list[Toy] = []

    def make_driver(uri: str) -> Toy:
        drivers.append(Toy(monotonic_ns))
        return drivers[-1]

    monkeypatch.setattr("skyloop.proxy.serve.make_driver", make_driver)
    before, handler = set(threading.enumerate()), signal.getsignal(signal.SIGTERM)

    def end_it() -> None:
        os.kill(os.getpid(), signal.SIGTERM)  # its handler is in place, as applications could connect

    monkeypatch.setattr("skyloop.proxy.serve.announce", lambda line: threading.Thread(target=end_it).start())
    serve("fake://", "toy")
    assert signal.getsignal(signal.SIGTERM) is handler
    assert {thread for thread in threading.enumerate() if thread.name.startswith("skyloop")} <= before
    assert list((tmp_path / "run").iterdir()) == []


def test_a_failing_process_lands_first_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The key check raised, and the process abandoned the flying vehicle, which falls if it has no hover of its own."""
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setattr("skyloop.proxy.serve.make_driver", lambda _uri: Toy(monotonic_ns))
    apps: list[App] = []

    def look() -> list[str]:
        apps.append(flying())
        raise RuntimeError("no folder of keys any more")

    with pytest.raises(RuntimeError, match="no folder"):
        serve("fake://", "toy", poll=look)
    told = capsys.readouterr().out.splitlines()
    assert [line for line in told if not line.startswith("ready")] == ["told takeoff", "told land", "closed"]
    apps[0].end.close()


def test_a_descriptor_that_is_not_open_is_refused() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    os.close(writing)
    with pytest.raises(UsageError, match=f"{reading} is not open"):
        serve("fake://", "toy", parent_fd=reading)


def test_a_serving_process_hands_over_the_interpreter_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[float] = []
    monkeypatch.setattr("sys.setswitchinterval", told.append)

    @contextmanager
    def beside(proxies: object) -> Iterator[None]:
        raise UsageError("no")
        yield

    with pytest.raises(UsageError, match="no"):
        run([], records=False, beside=beside)
    assert told == [0.001]


@pytest.mark.parametrize("call", ["wait", "set"])
def test_a_signal_may_arrive_while_the_main_thread_waits_or_handles_another(call: str) -> None:
    """Event's lock cannot be taken twice: the main thread stopped forever, and the vehicle was never landed."""
    shutdown = Shutdown()

    def at_each_line(frame: FrameType, event: str, _: object) -> Any:
        if frame.f_code.co_filename != threading.__file__:
            return None
        if event == "line":
            shutdown.request("SIGTERM received", hurry=True)
        return at_each_line

    def interrupted() -> None:
        sys.settrace(at_each_line)
        for one in (shutdown.requested, shutdown.hurry):
            one.wait(0.01) if call == "wait" else one.set()
        sys.settrace(None)

    thread = threading.Thread(target=interrupted, daemon=True)
    thread.start()
    thread.join(2.0)
    assert not thread.is_alive()
    assert shutdown.requested.is_set()
    assert shutdown.hurry.is_set()
