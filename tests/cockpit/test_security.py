"""Which requests are answered, and for whom: as pure decisions, and through the app."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as some
from starlette.websockets import WebSocketDisconnect

from skyloop.cockpit.access import OpenGate, Person, Token, TokenGate
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.cockpit.recordings import Recordings
from skyloop.cockpit.security import bind_address, foreign, needed, own_names
from skyloop.errors import UsageError
from skyloop.messages import FlightState, Role
from tests.support.cockpit import (
    ORIGIN,
    OWN,
    SOCKETS,
    FakeDrone,
    FakeRecorder,
    Node,
    Nodes,
    cockpit,
    fake_fleet,
    open_socket,
    until,
)
from tests.support.testclient import TestClient

NAMES = own_names("127.0.0.1", 8123)
STREAMS = ["overview", "drones/alpha/telemetry", "drones/alpha/video/front", "drones/alpha/control"]
READ = ["/", "/api/session", "/api/drones", "/api/statistics", "/api/recordings", "/static/cockpit.css"]
CHANGE = ["/api/recordings", "/api/recordings/1/stop", "/api/recordings/a.mcap/replay", "/api/replays/a/stop"]
PILOT = "pilot-token-0123456789"
OBSERVER = "observer-token-0123456789"
EVIL = "http://evil.example"


def headers(**values: str) -> list[tuple[bytes, bytes]]:
    return [(name.encode(), value.encode()) for name, value in values.items()]


# From whose page -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "given", "passes"),
    [
        ("GET", {"host": "127.0.0.1:8123"}, True),
        ("GET", {"host": "localhost:8123"}, True),
        ("GET", {"Host": "LOCALHOST:8123"}, True),
        ("GET", {"host": "127.0.0.1:8123", "origin": OWN}, True),
        ("GET", {"host": "127.0.0.1:8123", "origin": EVIL}, False),
        ("GET", {"host": "127.0.0.1:8123", "origin": "null"}, False),
        ("GET", {"host": "127.0.0.1:9999"}, False),
        ("GET", {"host": "127.0.0.1"}, False),
        ("GET", {"host": "127.0.0.2:8123"}, False),
        ("GET", {"host": "rebound.example:8123"}, False),
        ("GET", {}, False),
        ("POST", {"host": "127.0.0.1:8123"}, False),
        ("POST", {"host": "127.0.0.1:8123", "origin": OWN}, True),
        ("DELETE", {"host": "127.0.0.1:8123"}, False),
        ("", {"host": "127.0.0.1:8123", "origin": OWN}, True),
        ("", {"host": "localhost:8123", "origin": "http://localhost:8123"}, True),
        ("", {"host": "localhost:8123", "origin": OWN}, False),
        ("", {"host": "127.0.0.1:8123"}, False),
        ("", {"host": "127.0.0.1:8123", "origin": "https://127.0.0.1:8123"}, False),
        ("", {"host": "127.0.0.1:8123", "origin": "http://127.0.0.1:8124"}, False),
        ("", {"host": "evil.example", "origin": EVIL}, False),
    ],
)
def test_which_pages_are_answered(method: str, given: dict[str, str], passes: bool) -> None:
    """An empty method is a WebSocket."""
    kind = "http" if method else "websocket"
    assert (foreign(kind, method, headers(**given), NAMES) == "") is passes


def test_two_hosts_or_origins_are_refused() -> None:
    own = headers(host="127.0.0.1:8123")
    assert foreign("http", "GET", own + headers(host="evil.example"), NAMES)
    assert foreign("http", "GET", own + headers(origin=OWN) + headers(origin=EVIL), NAMES)


def test_addresses_to_listen_on() -> None:
    assert bind_address("localhost") == ("127.0.0.1", True)
    assert bind_address("::1") == ("::1", True)
    assert bind_address("[::1]") == ("::1", True)
    assert bind_address("0.0.0.0") == ("0.0.0.0", False)
    assert bind_address("192.168.1.4") == ("192.168.1.4", False)
    for host in ("example.org", "", "127.0.0.1:80"):
        with pytest.raises(UsageError, match="address to listen on"):
            bind_address(host)


def test_names_of_a_server_of_this_machine() -> None:
    assert own_names("::1", 80).exact == {"localhost:80", "[::1]:80", "localhost", "[::1]"}
    assert not own_names("127.0.0.1", 8123).own("192.168.1.4:8123")


@pytest.mark.parametrize(
    ("host", "own"),
    [
        ("192.168.1.4:8123", True),
        ("[fe80::1]:8123", True),
        ("drones.lab:8123", True),
        ("192.168.1.4:8124", False),
        ("192.168.1.4", False),
        ("evil.example:8123", False),
        ("999.1.1.1:8123", False),
        ("[::g]:8123", False),
        ("192.168.1.4:8123.evil.example", False),
        ("", False),
    ],
)
def test_names_of_a_server_of_the_network(host: str, own: bool) -> None:
    assert own_names("0.0.0.0", 8123, ["Drones.Lab"]).own(host) is own


def test_usual_ports_need_not_be_named() -> None:
    names = own_names("0.0.0.0", 443, ["drones.lab"], "https")
    assert names.own("192.168.1.4")
    assert names.own("drones.lab")
    assert not own_names("0.0.0.0", 443, [], "http").own("192.168.1.4")
    told = headers(host="192.168.1.4", origin="https://192.168.1.4")
    assert foreign("websocket", "", told, names) == ""
    assert foreign("websocket", "", headers(host="192.168.1.4", origin="http://192.168.1.4"), names)


# Who may do what ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "method", "path", "role"),
    [
        ("http", "GET", "/", None),
        ("http", "GET", "/static/page.js", None),
        ("http", "GET", "/api/session", None),
        ("http", "POST", "/api/login", None),
        ("http", "GET", "/api/drones", Role.OBSERVER),
        ("http", "GET", "/api/recordings/a.mcap/report", Role.OBSERVER),
        ("http", "POST", "/api/recordings", Role.PILOT),
        ("http", "POST", "/api/what/nobody/thought/of", Role.PILOT),
        ("http", "GET", "/api/what/nobody/thought/of", Role.OBSERVER),
        ("http", "GET", "/api/sessions", Role.OBSERVER),
        ("websocket", "", "/ws/overview", Role.OBSERVER),
        ("websocket", "", "/ws/drones/alpha/telemetry", Role.OBSERVER),
        ("websocket", "", "/ws/drones/alpha/control", Role.PILOT),
        ("websocket", "", "/", Role.OBSERVER),
    ],
)
def test_the_role_that_each_request_needs(kind: str, method: str, path: str, role: Role | None) -> None:
    assert needed(kind, method, path) is role


@given(some.text(max_size=40), some.sampled_from(["POST", "PUT", "DELETE", "PATCH"]))
def test_every_change_needs_a_pilot(rest: str, method: str) -> None:
    assert needed("http", method, f"/api/recordings/{rest}") is Role.PILOT


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answer wrong tokens at once, as these tests send many. Their real delay: ``tests/promises/security``."""
    monkeypatch.setattr("skyloop.cockpit.access.LONGEST_S", 0.0)


@pytest.fixture
def guarded(node: Node, tmp_path: Path) -> Iterator[TestClient]:
    """A cockpit that asks for tokens, with a drone that can fly."""
    tokens = [Token(Person(Role.PILOT, "ann"), PILOT.encode()), Token(Person(Role.OBSERVER), OBSERVER.encode())]
    with cockpit(
        CockpitFleet(Nodes(node)), TokenGate(tokens, "skyloop-cockpit-8123"), Recordings(tmp_path, FakeRecorder)
    ) as client:
        yield client


def bearer(token: str) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


def ended(client: TestClient, path: str, **more: str) -> int:
    """Return the code with which a WebSocket was closed before any message."""
    with pytest.raises(WebSocketDisconnect) as end, open_socket(client, path, **more) as socket:
        socket.receive_json()
    return int(end.value.code)


@pytest.mark.parametrize("token", [None, "", "wrong", PILOT[:-1], PILOT + "x", PILOT.upper(), "x" * 5000])
def test_nothing_is_served_without_a_valid_token(guarded: TestClient, node: Node, token: str | None) -> None:
    given = {} if token is None else bearer(token)
    for path in ("/api/drones", "/api/statistics", "/api/recordings", "/api/drones/alpha/parameters"):
        answer = guarded.get(path, headers=given)
        assert answer.status_code == 401
        assert "alpha" not in answer.text
    for path in CHANGE:
        assert guarded.post(path, headers={**ORIGIN, **given}, json={"drones": ["alpha"]}).status_code == 401
    for path in STREAMS:
        assert ended(guarded, path, **given) == 4401
    session = guarded.get("/api/session", headers=given)
    assert session.status_code == 401 if given else session.json()["role"] is None
    assert not node.flyer.applied


def test_an_observer_sees_everything_and_changes_nothing(guarded: TestClient, node: Node, tmp_path: Path) -> None:
    mine = bearer(OBSERVER)
    assert guarded.get("/api/session", headers=mine).json()["role"] == "observer"
    assert guarded.get("/api/drones", headers=mine).json()[0]["name"] == "alpha"
    with open_socket(guarded, "drones/alpha/telemetry", **mine) as socket:
        assert socket.receive_json()["name"] == "alpha"
    with open_socket(guarded, "drones/alpha/control", **mine) as control:
        control.send_json({"do": "take", "priority": 0})
        control.send_json({"do": "takeoff"})
        control.send_json({"do": "stop"})
        control.send_json({"do": "set", "name": "limits.tilt", "value": 0.9})
        with pytest.raises(WebSocketDisconnect) as end:
            control.receive_json()
        assert end.value.code == 4403
    for path in CHANGE:
        answer = guarded.post(path, headers={**ORIGIN, **mine}, json={"drones": ["alpha"]})
        assert answer.status_code == 403
        assert "observer" in answer.text
    assert not list(tmp_path.iterdir())
    tilt = next(
        one for one in guarded.get("/api/drones/alpha/parameters", headers=mine).json() if one["name"] == "limits.tilt"
    )
    assert tilt["value"] == 0.35
    assert node.flyer.state is FlightState.LANDED
    assert not node.flyer.applied


def test_a_pilot_flies_under_a_name(guarded: TestClient, node: Node) -> None:
    with open_socket(guarded, "drones/alpha/control", **bearer(PILOT)) as control:
        control.send_json({"do": "take", "priority": 4, "at_s": time.monotonic()})
        message = control.receive_json()
        while not message.get("mine"):
            message = control.receive_json()
        assert message["holder"].startswith("ann (cockpit ")
        control.send_json({"do": "takeoff", "at_s": time.monotonic()})
        until(lambda: node.flyer.state is FlightState.HOVERING)


def test_a_token_is_sent_once(guarded: TestClient) -> None:
    assert guarded.get("/api/session").json() == {
        "role": None,
        "name": "",
        "login": True,
        "hint": "log in with a token",
    }
    assert guarded.post("/api/login", headers=ORIGIN, json={"token": "wrong"}).status_code == 401
    assert not guarded.cookies
    answer = guarded.post("/api/login", headers=ORIGIN, json={"token": PILOT})
    assert answer.json() == {"role": "pilot", "name": "ann"}
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    assert PILOT not in cookie
    assert guarded.get("/api/session").json()["role"] == "pilot"
    assert guarded.get("/api/drones").status_code == 200
    with open_socket(guarded, "drones/alpha/telemetry", cookie=f"a=b; {cookie.partition(';')[0]}") as socket:
        assert socket.receive_json()["name"] == "alpha"
    stolen = cookie.partition(";")[0]
    guarded.post("/api/logout", headers=ORIGIN, json={})
    guarded.cookies.clear()
    assert guarded.get("/api/drones", headers={"cookie": stolen}).status_code == 401, "it is worth nothing any more"


@pytest.mark.parametrize(
    ("given", "status"),
    [
        ({"content": b'{"token":"x"}', "headers": {"content-type": "text/plain"}}, 415),
        ({"content": b'{"token":"x"}', "headers": {}}, 415),
        ({"content": b"{", "headers": {"content-type": "application/json"}}, 400),
        ({"content": b'{"token":1}', "headers": {"content-type": "application/json"}}, 400),
        ({"content": b'{"token":"' + b"x" * 70_000 + b'"}', "headers": {"content-type": "application/json"}}, 413),
    ],
)
def test_logging_in_takes_one_kind_of_body(guarded: TestClient, given: dict[str, Any], status: int) -> None:
    given["headers"] |= ORIGIN
    assert guarded.post("/api/login", **given).status_code == status


def test_tokens_are_refused_if_not_configured() -> None:
    with cockpit(fake_fleet({"alpha": FakeDrone()})) as client:
        assert client.post("/api/login", headers=ORIGIN, json={"token": PILOT}).status_code == 404
        assert client.post("/api/logout", headers=ORIGIN, json={}).status_code == 200
        assert client.get("/api/session").json() == {"role": "pilot", "name": "", "login": False, "hint": ""}


def test_another_user_of_this_machine_is_a_stranger() -> None:
    gate = OpenGate(uid_of=lambda *_: 12345)
    with cockpit(fake_fleet({"alpha": FakeDrone()}), gate) as client:
        assert client.get("/api/drones").status_code == 401
        assert "another user" in client.get("/api/session").json()["hint"]
        for path in STREAMS:
            assert ended(client, path) == 4401


# Pages from elsewhere ----------------------------------------------------------------------------------------------


@pytest.fixture
def client() -> Iterator[TestClient]:
    with cockpit(fake_fleet({"alpha": FakeDrone()})) as client:
        yield client


def test_the_page_carries_a_strict_policy(client: TestClient) -> None:
    answer = client.get("/api/session")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "connect-src 'self' ws://127.0.0.1:8123" in policy
    assert "frame-ancestors 'none'" in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cross-origin-resource-policy"] == "same-origin"


@pytest.mark.parametrize("path", READ)
@pytest.mark.parametrize("elsewhere", [{"host": "evil.example:8123"}, {"origin": EVIL}, {"origin": "null"}])
def test_foreign_requests_read_nothing(client: TestClient, path: str, elsewhere: dict[str, str]) -> None:
    answer = client.get(path, headers=elsewhere)
    assert answer.status_code == 403
    assert "alpha" not in answer.text


@pytest.mark.parametrize("path", [*CHANGE, "/api/login", "/api/logout"])
@pytest.mark.parametrize("elsewhere", [{"origin": EVIL}, {"origin": "null"}, {}, {"origin": OWN, "host": "evil:8123"}])
def test_foreign_requests_change_nothing(client: TestClient, path: str, elsewhere: dict[str, str]) -> None:
    assert client.post(path, headers=elsewhere, json={"drones": ["alpha"]}).status_code == 403


def test_a_form_of_a_foreign_page_is_not_understood(client: TestClient) -> None:
    """Forms can be sent without asking first; their content types are refused even from here."""
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"):
        answer = client.post("/api/recordings", headers={**ORIGIN, "content-type": kind}, content=b'{"drones":[]}')
        assert answer.status_code == 415


@pytest.mark.parametrize("path", STREAMS)
def test_own_page_opens_sockets(client: TestClient, path: str) -> None:
    with open_socket(client, path) as socket:
        assert socket.accepted_subprotocol is None


@pytest.mark.parametrize("path", STREAMS)
@pytest.mark.parametrize(
    "elsewhere", [{"origin": EVIL}, {}, {"origin": OWN, "host": "evil.example:8123"}, {"origin": "null"}]
)
def test_foreign_sockets_are_not_opened(client: TestClient, path: str, elsewhere: dict[str, str]) -> None:
    with (
        pytest.raises(WebSocketDisconnect) as refused,
        client.websocket_connect(f"{SOCKETS}/{path}", headers=elsewhere),
    ):
        pass
    assert refused.value.code == 1008


def test_cookies_do_not_let_foreign_pages_in(guarded: TestClient) -> None:
    """A browser may send the cookie along; the origin reveals the sender."""
    guarded.post("/api/login", headers=ORIGIN, json={"token": PILOT})
    for path in STREAMS:
        with (
            pytest.raises(WebSocketDisconnect) as refused,
            guarded.websocket_connect(f"{SOCKETS}/{path}", headers={"origin": EVIL}),
        ):
            pass
        assert refused.value.code == 1008
    assert guarded.post("/api/recordings", headers={"origin": EVIL}, json={"drones": ["alpha"]}).status_code == 403
