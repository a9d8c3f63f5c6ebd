"""Starting and ending the cockpit: what goes wrong is told, and it goes away with its parent."""

from __future__ import annotations

import builtins
import json
import socket
import sys
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect as open_socket
from websockets.typing import Origin

from skyloop.client import connect
from skyloop.cockpit import serve_cockpit
from skyloop.cockpit.__main__ import main
from skyloop.cockpit.child import CockpitProcess
from skyloop.errors import LinkError, MissingExtraError, UnknownNameError, UsageError


def test_only_loopback() -> None:
    with pytest.raises(UsageError, match="loopback"):
        serve_cockpit("nobody-here", host="0.0.0.0")


def test_port_in_use() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=f"port {port} of 127.0.0.1 is in use"):
            serve_cockpit("nobody-here", port=port)


@pytest.mark.parametrize("port", [-1, 70000])
def test_port_that_is_none(port: int) -> None:
    with pytest.raises(UsageError, match="can't be used"):
        serve_cockpit("nobody-here", port=port)


def test_no_such_proxy(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UnknownNameError, match="nobody-here"):
        serve_cockpit("nobody-here")
    assert main(["nobody-here"]) == 2
    assert "no proxy named 'nobody-here'" in capsys.readouterr().err


def test_missing_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == "uvicorn":
            raise ImportError("No module named 'uvicorn'")
        return real(name, *args, **kwargs)

    monkeypatch.delitem(sys.modules, "uvicorn", raising=False)
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingExtraError, match=r"skyloop\[cockpit\]"):
        serve_cockpit("nobody-here")


@pytest.mark.process
def test_child_tells_why_it_did_not_start() -> None:
    with CockpitProcess("nobody-here") as page, pytest.raises(LinkError, match="no proxy named 'nobody-here'"):
        page.address()


@pytest.mark.process
def test_page_of_a_real_drone() -> None:
    with connect("sim://?cameras=front&width=64&fps=10") as drone, CockpitProcess(drone.name) as page:
        own = page.address().rstrip("/")
        streams = f"{own.replace('http', 'ws')}/ws/drones/{drone.name}"
        with open_socket(f"{streams}/telemetry", origin=Origin(own)) as telemetry:
            vehicle, state = (json.loads(telemetry.recv(5)) for _ in range(2))
            assert vehicle["cameras"] == [{"name": "front", "width": 64, "height": 48}]
            assert state["feedback"]["state"] == "landed"
            assert state["link"]["application"] == "up"
        with open_socket(f"{streams}/video/front", origin=Origin(own)) as video:
            frame = video.recv(5)
            assert isinstance(frame, bytes)
            assert frame[-2:] == b"\xff\xd9", "a whole JPEG file"
            with pytest.raises(TimeoutError):
                video.recv(0.3)  # three more were taken: none is sent before the first is acknowledged
            video.send(json.dumps({"ack": 1}))
            assert isinstance(video.recv(5), bytes)
        for foreign in (Origin("http://evil.example"), None):
            with pytest.raises(InvalidStatus) as refused:
                open_socket(f"{streams}/telemetry", origin=foreign)
            assert refused.value.response.status_code == 403
        assert page.statistics()["frames_sent"] == 2
        assert drone.authority.state == "held", "who watches takes nothing away"
