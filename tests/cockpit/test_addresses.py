"""The page's port, its addresses for others, and the code that admits a phone once."""

from __future__ import annotations

import errno
import os
import socket
from contextlib import ExitStack
from pathlib import Path

import pytest

from skyloop.cockpit import addresses
from skyloop.cockpit.access import PAIRING_S, Pairing, Token, TokenGate
from skyloop.cockpit.addresses import Announcer, bind, listener_of, own_addresses, qr_code, reachable
from skyloop.cockpit.security import own_names
from skyloop.cockpit.server import Access
from skyloop.errors import UsageError
from skyloop.messages import Role
from tests.support.cockpit import ORIGIN, FakeDrone, cockpit, fake_fleet

HERE = "127.0.0.1"


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> tuple[int, int]:
    """The default port and the next one in this test: two consecutive free ports."""
    while True:
        with ExitStack() as stack:
            first = stack.enter_context(bind(HERE, 0)).getsockname()[1]
            try:
                stack.enter_context(bind(HERE, first + 1))
            except UsageError:
                continue
        break
    monkeypatch.setattr(addresses, "DEFAULT_PORT", first)
    return first, first + 1


def test_the_port_is_the_same_each_time(ports: tuple[int, int], capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        with bind(HERE, None) as listening:
            assert listening.getsockname()[1] == ports[0]
    assert capsys.readouterr().err == ""


def test_a_taken_port_names_its_process(ports: tuple[int, int], capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server((HERE, ports[0])), bind(HERE, None) as listening:
        assert listening.getsockname()[1] == ports[1]
    said = capsys.readouterr().err
    assert f"port {ports[0]} is in use by process {os.getpid()} (" in said
    assert f"at port {ports[1]}" in said


def test_any_free_port_is_used_if_all_defaults_are_taken(
    ports: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(addresses, "NEXT_PORTS", 0)
    with socket.create_server((HERE, ports[0])), bind(HERE, None) as listening:
        assert listening.getsockname()[1] not in ports


def test_a_free_port_has_no_listener() -> None:
    with bind(HERE, 0) as listening:
        port = listening.getsockname()[1]
    assert listener_of(port) == ""


def test_the_printed_address_answers() -> None:
    assert reachable("192.0.2.7") == ["192.0.2.7"]
    for everywhere in ("0.0.0.0", "::"):
        names = own_names(everywhere, 8420, addresses.host_names())
        for address in reachable(everywhere):
            assert names.own(f"[{address}]:8420" if ":" in address else f"{address}:8420")
        for name in addresses.host_names():
            assert names.own(f"{name.lower()}:8420")
        assert not names.own("elsewhere.local:8420")


def test_interface_addresses_are_printed_without_a_default_route(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket.socket, "connect", no_route)
    monkeypatch.setattr(addresses, "own_addresses", lambda: ["192.0.2.9", "198.51.100.9"])
    assert reachable("0.0.0.0") == ["192.0.2.9", "198.51.100.9"]
    monkeypatch.setattr(addresses, "own_addresses", list)
    assert reachable("0.0.0.0") == [HERE]


def no_route(*_: object) -> None:
    raise OSError(errno.ENETUNREACH, "Network is unreachable")


def test_the_addresses_of_the_interfaces_can_be_bound() -> None:
    for address in own_addresses():
        with bind(address, 0) as listening:
            assert listening.getsockname()[0] == address != HERE


def test_a_missing_network_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    Announcer(None, loopback=False)("http://127.0.0.1:8123/")
    assert "this machine has no network" in capsys.readouterr().err
    Announcer(None, loopback=True)("http://127.0.0.1:8123/")
    Announcer(None, loopback=False)("http://[2001:db8::1]:8123/")
    assert capsys.readouterr().err == ""


def test_a_code_works_once_and_expires() -> None:
    now_ns = 0
    used: list[str] = []
    pairing = Pairing(Role.OBSERVER, lambda: now_ns)
    pairing.on_used = used.append
    assert pairing.person("", HERE) is None, "none was shown yet"
    first, code = pairing.code(), pairing.code()
    assert pairing.person(first, HERE) is None, "a newer one was shown"
    assert pairing.person(code + "x", HERE) is None
    person = pairing.person(code, HERE)
    assert person is not None
    assert (person.role, used) == (Role.OBSERVER, [f"{HERE} as observer"])
    assert pairing.person(code, HERE) is None
    late = pairing.code()
    now_ns = round(PAIRING_S * 1e9)
    assert pairing.person(late, HERE) is None


def test_an_expired_code_is_replaced(capsys: pytest.CaptureFixture[str]) -> None:
    now_ns = 0
    pairing = Pairing(Role.PILOT, lambda: now_ns)
    Announcer(pairing, loopback=False)("http://127.0.0.1:8123/")
    first = capsys.readouterr().out.splitlines()[1].rpartition("#pair=")[2]
    pairing.expire()
    assert capsys.readouterr().out == "", "it works still"
    now_ns = round(PAIRING_S * 1e9)
    for _ in range(2):
        pairing.expire()
    told, shown = capsys.readouterr().out.splitlines()
    assert told == "the pairing address has expired"
    second = shown.rpartition("#pair=")[2]
    assert pairing.person(first, HERE) is None
    assert pairing.person(second, HERE) is not None


def test_a_browser_is_paired(capsys: pytest.CaptureFixture[str]) -> None:
    pairing = Pairing(Role.PILOT)
    gate = TokenGate(list[Token](), "c", pairing=pairing)
    with cockpit(fake_fleet({"alpha": FakeDrone()}), gate) as client:
        Announcer(pairing, loopback=False)("http://127.0.0.1:8123/")
        said = capsys.readouterr().out.splitlines()
        assert said[0] == "cockpit: http://127.0.0.1:8123/"
        code = said[1].rpartition("#pair=")[2]
        assert client.get("/api/session").json()["role"] is None
        answer = client.post("/api/login", json={"token": code}, headers=ORIGIN)
        assert (answer.status_code, answer.json()["role"]) == (200, "pilot")
        assert client.get("/api/session").json()["role"] == "pilot", "by its cookie"
        said = capsys.readouterr().out.splitlines()
        assert "as pilot" in said[0]
        assert code not in said[1], "the next one is shown"
        client.cookies.clear()
        refused = client.post("/api/login", json={"token": code}, headers=ORIGIN)
        assert (refused.status_code, "already used" in refused.json()["error"]) == (401, True)


def test_pairing_and_certificates_exclude_each_other() -> None:
    one = Path("one")
    with pytest.raises(UsageError, match="--pair or --client-ca"):
        Access(client_ca=one, tls_cert=one, tls_key=one, pair=True)


def test_a_qr_code_in_half_blocks() -> None:
    pytest.importorskip("segno")
    drawn = qr_code("http://192.168.178.123:8420/#pair=0dXbq3T2mW0uJm3iT5nIYbWfZ0b0v8Kq")
    lines = drawn.splitlines()
    assert 15 < len(lines) < 24, "it fits a small terminal"
    assert "▀" in drawn or "▄" in drawn
