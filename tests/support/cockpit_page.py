"""A page of the cockpit as the other end of its sockets, and a cockpit that serves it on a thread."""

from __future__ import annotations

import json
import ssl
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self
from urllib.parse import quote

from skyloop.cockpit import serve_cockpit
from skyloop.messages import (
    AnyAction,
    Velocity,
)
from tests.support.cockpit import PATIENCE_S, Node, open_socket
from tests.support.testclient import TestClient, WebSocketTestSession


class Page:
    """A page's control socket."""

    def __init__(self, socket: WebSocketTestSession) -> None:
        self.socket = socket
        self.told: list[dict[str, Any]] = []

    def say(self, do: str, **values: Any) -> None:
        """Send a message as an up-to-date page; it uses the cockpit's clock, because both are in one process."""
        now_s = time.monotonic()
        seen = {"seen_s": now_s} if do == "ping" else {}
        self.socket.send_json({"do": do, "at_s": now_s, **seen, **values})

    @contextmanager
    def staying(self) -> Iterator[None]:
        """It pings all the time."""
        ended = threading.Event()

        def stay() -> None:
            while not ended.wait(0.1):
                self.say("ping")

        thread = threading.Thread(target=stay)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def wait(self, kind: str, **values: Any) -> dict[str, Any]:
        """The next message of that kind with these values."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            message: dict[str, Any] = self.socket.receive_json()
            self.told.append(message)
            if message["type"] == kind and values.items() <= message.items():
                return message
        raise AssertionError(f"no {kind} {values} but {self.told}")

    def take_off(self) -> None:
        self.say("takeoff")
        self.wait("done", do="takeoff")

    def take(self, priority: int = 4) -> Self:
        self.say("take", priority=priority)
        self.wait("authority", mine=True)
        return self


@contextmanager
def page(client: TestClient, drone: str = "alpha", name: str = "") -> Iterator[Page]:
    with open_socket(client, f"drones/{drone}/control?name={quote(name)}") as socket:
        yield Page(socket)


def count(node: Node, action: AnyAction) -> int:
    return list(node.flyer.applied).count(action)


BOX = [4.0, 4.0, 10.0, 12.0]
FORWARD = Velocity(forward=0.25)


class Marker(Page):
    """A page that marks what it sees."""

    def __init__(self, pilot: Page) -> None:
        super().__init__(pilot.socket)
        self.since_ns = 0

    def select(self) -> None:
        self.say("follow_select", camera="front")
        self.since_ns = int(self.wait("follow", state="selecting")["since_ns"])

    def mark(self, **values: Any) -> None:
        """The first frame that is kept has a box."""
        self.select()
        self.say("follow", **({"camera": "front", "captured_ns": str(self.since_ns), "box": BOX} | values))


PILOT = "pilot-token-0123456789"


@contextmanager
def served(**options: Any) -> Iterator[str]:
    """A cockpit on a thread; its address."""
    ready, stop, told = threading.Event(), threading.Event(), []

    def tell(address: str) -> None:
        told.append(address)
        ready.set()

    thread = threading.Thread(target=serve_cockpit, kwargs={"on_ready": tell, "stop": stop, **options})
    thread.start()
    try:
        assert ready.wait(10)
        yield told[0].rstrip("/")
    finally:
        stop.set()
        thread.join(10)
    assert not thread.is_alive()


def log_in(address: str) -> tuple[str, dict[str, str]]:
    """Open the address of a cockpit as a browser does; return its origin, and the headers of the browser's session."""
    origin, _, code = address.partition("/#pair=")
    if not code:
        return origin.rstrip("/"), {}
    headers = {"content-type": "application/json", "origin": origin}
    request = urllib.request.Request(f"{origin}/api/login", json.dumps({"token": code}).encode(), headers)
    with urllib.request.urlopen(request, timeout=5) as answer:
        return origin, {"cookie": answer.headers["set-cookie"].partition(";")[0]}


def ask(address: str, path: str, token: str | None = None, tls: ssl.SSLContext | None = None) -> Any:
    request = urllib.request.Request(f"{address}{path}")
    if token is not None:
        request.add_header("Authorization", f"Bearer {token}")
    with urllib.request.urlopen(request, timeout=5, context=tls) as answer:
        return json.load(answer)
