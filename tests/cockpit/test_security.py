"""Who may ask, as a pure decision and through the app."""

from __future__ import annotations

import pytest
from starlette.websockets import WebSocketDisconnect

from skyloop.cockpit.app import create_app
from skyloop.cockpit.security import loopback_address, own_names, refusal
from skyloop.errors import UsageError
from tests.cockpit.fake import FakeDrone
from tests.cockpit.testclient import TestClient

NAMES = own_names("127.0.0.1", 8123)
OWN = "http://127.0.0.1:8123"
ROUTES = [f"ws://127.0.0.1:8123/ws/drones/alpha/{stream}" for stream in ("telemetry", "video/front")]


def headers(**values: str) -> list[tuple[bytes, bytes]]:
    return [(name.encode(), value.encode()) for name, value in values.items()]


@pytest.mark.parametrize(
    ("kind", "given", "passes"),
    [
        ("http", {"host": "127.0.0.1:8123"}, True),
        ("http", {"host": "localhost:8123"}, True),
        ("http", {"Host": "LOCALHOST:8123"}, True),
        ("http", {"host": "127.0.0.1:8123", "origin": OWN}, True),
        ("http", {"host": "127.0.0.1:8123", "origin": "http://evil.example"}, False),
        ("http", {"host": "127.0.0.1:8123", "origin": "null"}, False),
        ("http", {"host": "127.0.0.1:9999"}, False),
        ("http", {"host": "127.0.0.1"}, False),
        ("http", {"host": "rebound.example:8123"}, False),
        ("http", {}, False),
        ("websocket", {"host": "127.0.0.1:8123", "origin": OWN}, True),
        ("websocket", {"host": "localhost:8123", "origin": "http://localhost:8123"}, True),
        ("websocket", {"host": "localhost:8123", "origin": OWN}, False),
        ("websocket", {"host": "127.0.0.1:8123"}, False),
        ("websocket", {"host": "127.0.0.1:8123", "origin": "https://127.0.0.1:8123"}, False),
        ("websocket", {"host": "127.0.0.1:8123", "origin": "http://127.0.0.1:8124"}, False),
        ("websocket", {"host": "evil.example", "origin": "http://evil.example"}, False),
    ],
)
def test_who_may_ask(kind: str, given: dict[str, str], passes: bool) -> None:
    assert (refusal(kind, headers(**given), NAMES) is None) is passes


def test_two_hosts_or_origins_are_refused() -> None:
    own = headers(host="127.0.0.1:8123")
    assert refusal("http", own + headers(host="evil.example"), NAMES) is not None
    assert refusal("http", own + headers(origin=OWN) + headers(origin="http://evil.example"), NAMES) is not None


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.4", "::", "example.org", ""])
def test_only_loopback_is_listened_on(host: str) -> None:
    with pytest.raises(UsageError, match="loopback"):
        loopback_address(host)


def test_loopback_addresses() -> None:
    assert loopback_address("localhost") == "127.0.0.1"
    assert loopback_address("::1") == "::1"
    assert own_names("::1", 80) == {"localhost:80", "[::1]:80", "localhost", "[::1]"}


def test_page_carries_a_strict_policy() -> None:
    with TestClient(create_app({"alpha": FakeDrone()}, NAMES), base_url=OWN) as client:  # type: ignore[dict-item]
        answer = client.get("/")
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "connect-src 'self' ws://127.0.0.1:8123" in policy
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        for word in ("<style", "onclick=", 'style="', "https://", "//cdn"):
            assert word not in answer.text


@pytest.mark.parametrize("path", ["/", "/api/drones", "/api/statistics", "/static/cockpit.css"])
@pytest.mark.parametrize("foreign", [{"host": "evil.example:8123"}, {"origin": "http://evil.example"}])
def test_foreign_requests_read_nothing(path: str, foreign: dict[str, str]) -> None:
    with TestClient(create_app({"alpha": FakeDrone()}, NAMES), base_url=OWN) as client:  # type: ignore[dict-item]
        answer = client.get(path, headers=foreign)
        assert answer.status_code == 403
        assert "alpha" not in answer.text


@pytest.mark.parametrize("route", ROUTES)
def test_own_page_opens_sockets(route: str) -> None:
    with (
        TestClient(create_app({"alpha": FakeDrone()}, NAMES), base_url=OWN) as client,  # type: ignore[dict-item]
        client.websocket_connect(route, headers={"origin": OWN}) as socket,
    ):
        assert socket.accepted_subprotocol is None


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize(
    "foreign", [{"origin": "http://evil.example"}, {}, {"origin": OWN, "host": "evil.example:8123"}, {"origin": "null"}]
)
def test_foreign_sockets_are_not_opened(route: str, foreign: dict[str, str]) -> None:
    with TestClient(create_app({"alpha": FakeDrone()}, NAMES), base_url=OWN) as client:  # type: ignore[dict-item]
        with pytest.raises(WebSocketDisconnect) as refused, client.websocket_connect(route, headers=foreign):
            pass
        assert refused.value.code == 1008
