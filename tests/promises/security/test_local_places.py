"""A proxy's connections on its host: silent clients, clients that open many, and locks do not keep a pilot out."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.systems import PLATFORM

if PLATFORM != "linux":
    pytest.skip("not there: the fast side of the local transport, and locks of POSIX", allow_module_level=True)

from skyloop.errors import LinkError
from skyloop.messages import EventKind, Hello, Refusal, Refused, Role, Welcome
from skyloop.proxy.requests import HELLO_NS
from skyloop.transport.local import LocalServer, dial, list_names
from skyloop.transport.local.directory import find_directory
from skyloop.transport.local.fast import Socket, connect
from skyloop.transport.local.packets import Bye, hello, parse
from skyloop.transport.local.system import Credentials
from skyloop.transport.testing import ClientLog, ServerLog, wait_until
from tests.support.proxy_bench import WAIT_S, Bench

SERVER = "skyloop.transport.local.server"
SOCKETS = "skyloop.transport.local.fast"


class Place:
    """A server, and silent connections to it."""

    def __init__(self, stack: ExitStack) -> None:
        self.log = ServerLog()
        self.server = LocalServer("alpha")
        self.server.start(self.log)
        stack.callback(self.server.stop)
        self._stack = stack

    def raw(self, *first: bytes) -> Socket:
        sock = connect(find_directory().path / "alpha.sock")
        self._stack.callback(sock.close)
        sock.settimeout(WAIT_S)
        for packet in first:
            sock.send(packet)
        return sock

    def admitted(self, *, pilot: bool) -> str:
        """Add an application that introduces itself; returns why it can't stay."""
        before = len(self.log.joined)
        self.raw(hello())
        wait_until(lambda: len(self.log.joined) > before, "it joined")
        return self.server.admit(self.log.joined[-1], pilot=pilot)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    with ExitStack() as stack:
        yield Place(stack)


def word(sock: Socket) -> str:
    """The reason for which the server ended a connection."""
    message = parse(sock.recv(1000))
    assert isinstance(message, Bye)
    return message.reason


@pytest.mark.parametrize("first", [(), (hello(),)], ids=["nothing", "no Hello"])
def test_silent_connections_keep_no_one_out(
    place: Place, monkeypatch: pytest.MonkeyPatch, first: tuple[bytes, ...]
) -> None:
    monkeypatch.setattr(f"{SERVER}.MAX_CLIENTS", 4)
    silent = [place.raw(*first) for _ in range(4)]
    wait_until(lambda: len(place.server._connections) == 4, "all places are taken")
    wait_until(lambda: len(place.log.joined) == 4 * len(first), "they were let in")
    pilot, known = ClientLog(), len(place.log.joined)
    client = dial("alpha")(pilot)
    wait_until(lambda: len(place.log.joined) == known + 1, "the pilot is in")
    assert place.server.admit(place.log.joined[-1], pilot=True) == ""
    assert "its place at local:alpha went to a newer connection" in word(silent[0])
    for _ in range(8):  # clients that have sent their Hello stay
        place.raw(*first)
    wait_until(lambda: len(place.server._connections) <= 4, "the others gave way to one another")
    assert client.send(b"still here")
    wait_until(lambda: place.log.packets, "it came")
    assert pilot.closings == []
    client.close()


def test_a_connection_without_its_first_packet_ends(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{SERVER}.HELLO_S", 0.05)
    silent = place.raw()
    assert word(silent) == "it sent no Hello within 0.05 s"
    quiet = place.raw(hello())
    wait_until(lambda: place.log.joined, "the other one is let in")
    time.sleep(0.1)  # twice that time, in which nothing may happen
    quiet.send(b"still here")
    wait_until(lambda: place.log.packets, "it came")
    wait_until(lambda: len(place.server._connections) == 1, "nothing is left of the first")


def test_a_connection_without_its_hello_is_ended_and_reported() -> None:
    with Bench() as bench:
        eye, silent = bench.join("eye"), bench.stranger()
        eye.sync()  # it is known by now
        bench.run(HELLO_NS / 1e9)
        assert silent.closed_by.empty()
        bench.run(0.04)
        assert "no Hello arrived within 5 s: connect again" in silent.closed_by.get(timeout=WAIT_S)
        texts = [event.text for event in eye.told(EventKind.APPLICATION_LINK)]
        assert any("was closed: no Hello arrived" in text for text in texts)
        assert bench.proxy._counts["connections.silent"] == 1


def test_one_process_does_not_get_all_places(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{SERVER}.MAX_PER_PROCESS", 3)
    for _ in range(3):
        assert place.admitted(pilot=True) == ""
    assert f"pid {os.getpid()} has 3 connections to local:alpha" in word(place.raw())
    code = "import sys; from skyloop.transport.local import directory as d, packets\n"
    code += "s = d.find_directory().connect('alpha'); s.send(packets.hello()); sys.stdin.read()"
    other = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
    try:
        wait_until(lambda: len(place.log.joined) == 4, "another process gets one")
    finally:
        other.communicate()


def test_one_other_user_does_not_get_all_places(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Members of a group are admitted; other tests show that they are."""
    monkeypatch.setattr(f"{SERVER}.MAX_PER_USER", 2)
    monkeypatch.setattr("skyloop.transport.local.fast.may_connect", lambda *_: True)
    pids = iter(range(100, 200))
    monkeypatch.setattr(f"{SOCKETS}.credentials", lambda _: Credentials(next(pids), 54321, 54321))
    for _ in range(2):
        place.admitted(pilot=True)
    assert "uid 54321 has 2 connections to local:alpha" in word(place.raw())
    monkeypatch.setattr(f"{SOCKETS}.credentials", lambda _: Credentials(next(pids), os.geteuid(), 0))
    assert place.admitted(pilot=True) == "", "the proxy's own user is admitted"


def test_observers_leave_places_for_pilots(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{SERVER}.MAX_CLIENTS", 6)
    monkeypatch.setattr(f"{SERVER}.PILOT_PLACES", 2)
    assert [place.admitted(pilot=False) for _ in range(4)] == [""] * 4
    assert "4 observers; the other 2 are reserved for pilots" in place.admitted(pilot=False)
    assert place.admitted(pilot=True) == ""
    assert place.admitted(pilot=True) == ""


def test_an_observer_without_a_free_place_is_refused() -> None:
    with Bench() as bench:
        bench.server.admit = lambda peer, *, pilot: "" if pilot else "full"  # type: ignore[method-assign]
        app = bench.stranger()
        answer = app.ask(Hello("eye", Role.OBSERVER))
        assert isinstance(answer, Refused)
        assert (answer.code, answer.message) == (Refusal.BUSY, "full")
        assert isinstance(app.ask(Hello("pilot", Role.PILOT)), Welcome)


def test_another_users_lock_delays_no_one(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """A member of a group can open the directory for reading, and lock it for any time."""
    import fcntl
    import grp

    group = grp.getgrgid(os.getegid()).gr_name
    monkeypatch.setenv("SKYLOOP_GROUP", group)
    bravo = LocalServer("bravo", group=group)
    bravo.start(ServerLog())
    directory = find_directory(group)
    descriptor = os.open(directory.path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        begin = time.monotonic()
        assert [proxy.name for proxy in list_names()] == ["alpha", "bravo"]
        bravo.stop()
        assert [proxy.name for proxy in list_names()] == ["alpha"]
        charlie = LocalServer("charlie", group=group)
        charlie.start(ServerLog())
        charlie.stop()
        assert time.monotonic() - begin < 5.0
    finally:
        os.close(descriptor)
    lock = directory.path / ".lock"
    assert lock.stat().st_mode & 0o777 == 0o600, "only its owner can open it"


def test_looking_waits_for_no_lock(place: Place) -> None:
    """Not even the owner's: what a killed proxy left then stays until the next time."""
    directory = find_directory()
    dead = directory.path / "dead.sock"
    with Socket() as sock:
        sock.bind(str(dead))
        sock.listen()
    with directory.lock():
        begin = time.monotonic()
        assert [proxy.name for proxy in list_names()] == ["alpha"]
        assert time.monotonic() - begin < 5.0
        assert dead.exists()
        with pytest.raises(LinkError, match="locked by another process"), directory.lock(timeout_s=0.0):
            pass
    assert [proxy.name for proxy in list_names()] == ["alpha"]
    assert not dead.exists()
