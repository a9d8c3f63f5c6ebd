"""A host's control socket, and the commands that use it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import msgspec
import pytest

from skyloop.cli import main
from skyloop.drivers.uri import parse_uri
from skyloop.errors import LinkError, NameTakenError, RefusedError, UnknownNameError, UsageError
from skyloop.host import serve
from skyloop.host.fleet import Defaults, FlightLimits, encode_handed
from skyloop.host.serve import (
    Add,
    AddNamed,
    ControlServer,
    HostAnswer,
    Remove,
    StatusRequest,
    ask,
    chosen_host,
    respond,
    running_hosts,
)
from skyloop.transport.local.directory import find_directory
from skyloop.transport.local.system import HOST
from tests.host.fleet import Hosting


@pytest.fixture
def served(hosting: Hosting, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hosting]:
    """A host whose control socket is named ``host``."""
    monkeypatch.setattr("skyloop.host.fleet.driver_class", lambda scheme: scheme)  # fake:// has no driver
    server = ControlServer("host", partial(respond, hosting.host, Defaults(limits=FlightLimits(speed=0.5))))
    server.start()
    yield hosting
    server.stop()
    server.stop()


def skyloop(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    assert ended.value.code is None or isinstance(ended.value.code, int)
    return ended.value.code or 0


def test_vehicles_join_and_leave(served: Hosting) -> None:
    served.vehicle("alpha")
    (row,) = ask("host", AddNamed("alpha", "fake://alpha")).vehicles
    assert (row.name, row.condition, row.process) == ("alpha", "running", "shared")
    proxy = served.shared("alpha").proxy
    assert proxy is not None
    assert proxy.handler.checks.airspace.settings.limits.speed == 0.5
    assert [row.name for row in ask("host", StatusRequest()).vehicles] == ["alpha"]
    served.vehicle("bravo").fail = {"open"}
    answer = ask("host", Add(tuple(map(served.settings, ("alpha", "bravo")))))
    assert [(row.name, row.condition.value) for row in answer.vehicles] == [("alpha", "running"), ("bravo", "failed")]
    assert "open is broken" in answer.problems["bravo"]
    assert ask("host", Remove("alpha")).vehicles[0].name == "alpha"
    assert ask("host", AddNamed("alpha")).vehicles[0].condition == "running"


def test_errors_are_raised_again_at_the_client(served: Hosting) -> None:
    served.add("alpha")
    with pytest.raises(UsageError, match="did you mean 'alpha'"):
        ask("host", Remove("alpa"))
    with pytest.raises(UsageError, match="is already running"):
        ask("host", AddNamed("alpha"))
    with pytest.raises(NameTakenError, match="already has a vehicle named 'alpha'"):
        ask("host", AddNamed("alpha", "fake://alpha"))
    with pytest.raises(UsageError, match="lower-case"):
        ask("host", AddNamed("Al Pha", "fake://alpha"))
    served.airborne("alpha")
    with pytest.raises(RefusedError, match="has the authority") as refused:
        ask("host", Remove("alpha"))
    assert refused.value.code == "flown"


def test_garbage_and_silent_callers_do_no_harm(served: Hosting) -> None:
    for packet in (b"", b"{", b"[" * 5000, b'{"type":"remove"}', b'{"type":"reboot"}', b"\0" * serve.MAX_PACKET):
        sock = find_directory(None, HOST).connect("host")
        if packet:
            sock.send(packet)
            answer = msgspec.json.decode(sock.recv(1 << 16), type=HostAnswer)
            assert "malformed request" in answer.error
        sock.hang_up()
    assert ask("host", StatusRequest()).vehicles == ()


def test_a_large_answer_arrives_whole(served: Hosting) -> None:
    for number in range(600):
        name = f"vehicle-{number:04}-of-a-very-large-fleet"
        served.host.known[name] = served.settings(name)
    assert len(ask("host", StatusRequest()).vehicles) == 600


def test_other_users_may_not_use_it(served: Hosting, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(find_directory().serving, "may_connect", lambda sock, gid: False)
    with pytest.raises(RefusedError, match=f"pid {os.getpid()}.*may not use the host"):
        ask("host", Remove("alpha"))


def test_a_failing_host_reports_that(monkeypatch: pytest.MonkeyPatch) -> None:
    def answering(_: serve.Request) -> HostAnswer:
        raise RuntimeError("on purpose")

    server = ControlServer("host", answering)
    server.start()
    with pytest.raises(RefusedError, match="on purpose"):
        ask("host", StatusRequest())
    with pytest.raises(NameTakenError, match="in use by a running host"):
        ControlServer("host", answering).start()
    server.stop()
    with pytest.raises(LinkError, match="can't be reached"):
        ask("host", StatusRequest())


def test_a_host_that_ends_before_it_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ControlServer, "_answer", lambda self, sock: None)
    server = ControlServer("host", lambda _: HostAnswer())
    server.start()
    with pytest.raises(LinkError, match="ended before it answered"):
        ask("host", StatusRequest())
    server.stop()


def test_the_intended_host_is_found() -> None:
    with pytest.raises(UsageError, match=r"skyloop host fleet\.toml"):
        chosen_host()
    servers = [ControlServer(name, lambda _: HostAnswer()) for name in ("one", "two")]
    servers[0].start()
    assert chosen_host() == "one"
    servers[1].start()
    assert running_hosts() == ["one", "two"]
    with pytest.raises(UsageError, match="--host one or two"):
        chosen_host()
    assert chosen_host("two") == "two"
    with pytest.raises(UnknownNameError, match="three"):
        chosen_host("three")
    for server in servers:
        server.stop()


def test_the_commands_print_what_happens(served: Hosting, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert skyloop("host", "status") == 0
    assert "Add one: skyloop host add NAME ADDRESS" in capsys.readouterr().out
    served.vehicle("alpha")
    assert skyloop("host", "add", "alpha", "fake://alpha") == 0
    assert skyloop("host", "status", "--host", "host") == 0
    out = capsys.readouterr().out
    assert "fake://alpha" in out
    assert "running" in out
    assert skyloop("host", "status", "--json") == 0
    (row,) = msgspec.json.decode(capsys.readouterr().out)
    assert {"name", "address", "condition", "state", "link", "pilot", "uptime_s", "failed", "process"} <= row.keys()
    served.vehicle("bravo").fail = {"open"}
    (tmp_path / "more.toml").write_text('[[vehicle]]\nname = "bravo"\naddress = "fake://bravo"\n')
    assert skyloop("host", "add", str(tmp_path / "more.toml")) == 1
    assert "bravo was not added: open" not in (shown := capsys.readouterr()).out
    assert "bravo was not added" in shown.err
    assert skyloop("host", "add", str(tmp_path / "more.toml"), "--own-process") == 2
    pilot = served.airborne("alpha")
    assert skyloop("host", "remove", "alpha") == 1
    assert "--land" in capsys.readouterr().err
    assert skyloop("host", "remove", "alpha", "--land") == 0
    assert capsys.readouterr().out == "removed alpha: fake://alpha\n"
    assert pilot.closed_by.get(timeout=10.0)


@pytest.mark.parametrize("words", [(), ("status",), ("add",), ("remove",)])
def test_each_command_has_help_with_an_example(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert skyloop("host", *words, "--help") == 0
    assert "Example: skyloop host" in capsys.readouterr().out


def test_a_mistake_in_the_file_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "fleet.toml").write_text("[[vehicle]]\nname = 'a'\nadress = 'sim://'\n")
    assert skyloop("host", str(tmp_path / "fleet.toml")) == 2
    error = capsys.readouterr().err
    assert "did you mean 'address'" in error
    assert threading.active_count() >= 1


def test_a_large_fleet_is_added_in_one_request(served: Hosting) -> None:
    """`skyloop host add FILE` failed beyond 64 KiB."""
    settings = served.settings("alpha")
    zones = "; ".join(f"keep_out: polygon {number}.0 0.5, {number}.1 0.6, {number}.2 0.7" for number in range(6))
    many = tuple(
        msgspec.structs.replace(
            settings, name=f"drone-{number}", address=parse_uri("no-such://x"), presets={"safety.zones": zones}
        )
        for number in range(500)
    )
    assert len(encode_handed(Add(many))) > 1 << 17
    taken: list[serve.Request] = []
    server = ControlServer("large", lambda request: taken.append(request) or HostAnswer())  # type: ignore[func-returns-value]
    server.start()
    try:
        ask("large", Add(many))
        assert taken == [Add(many)]
        exact = AddNamed("x", "a" * (serve._CHUNK - len(msgspec.json.encode(AddNamed("x", "")))))
        assert len(msgspec.json.encode(exact)) == serve._CHUNK
        ask("large", exact)
        assert taken[1] == exact
    finally:
        server.stop()


def test_without_descriptors_the_control_socket_uses_little_cpu() -> None:
    """It used to retry accept at once, without end, and took a whole core."""

    class Full:
        tries = 0

        def accept(self) -> None:
            self.tries += 1
            raise OSError(24, "Too many open files")

        def hang_up(self) -> None: ...

        def release(self) -> None: ...

    server, full = ControlServer("full", lambda _: HostAnswer()), Full()
    server._listener = full  # type: ignore[assignment]
    thread = threading.Thread(target=server._run, args=(full,))
    thread.start()
    thread.join(0.35)
    server._thread = thread
    server.stop()
    assert not thread.is_alive()
    assert 1 <= full.tries <= 5
