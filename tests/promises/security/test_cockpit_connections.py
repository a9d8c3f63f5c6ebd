"""Clients that open connections to the cockpit and say nothing, or open too many, do not affect logged-in users."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect as open_socket
from websockets.typing import Origin

DESCRIPTORS = 256  # the cockpit's limit, so that a test need not open thousands
HALF_OPEN = 400


@pytest.fixture
def cockpit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, Callable[[], str]]]:
    """A cockpit with few descriptors: its address, and its output to standard error."""
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    command = f"ulimit -n {DESCRIPTORS}; exec {sys.executable} -m skyloop.cockpit"
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            ["sh", "-c", command], stdout=subprocess.PIPE, stderr=said, cwd=tmp_path, start_new_session=True
        )
        try:
            assert process.stdout is not None
            address = process.stdout.readline().decode().strip().rstrip("/")

            def complaints() -> str:
                return os.pread(said.fileno(), 1 << 24, 0).decode()

            yield address, complaints
        finally:
            process.terminate()
            process.wait(10)
            if process.stdout is not None:
                process.stdout.close()


def ask(address: str, path: str) -> Any:
    with urllib.request.urlopen(f"{address}{path}", timeout=5) as answer:
        return json.load(answer)


@pytest.mark.process
def test_half_open_requests_neither_silence_a_page_nor_keep_a_new_one_out(
    cockpit: tuple[str, Callable[[], str]],
) -> None:
    address, complaints = cockpit
    host, port = address.removeprefix("http://").split(":")
    with ExitStack() as held:
        page = held.enter_context(open_socket(f"{address.replace('http', 'ws')}/ws/overview", origin=Origin(address)))
        assert json.loads(page.recv(5))["type"] == "overview"
        for _ in range(HALF_OPEN):
            half = held.enter_context(socket.create_connection((host, int(port)), 5))
            half.send(b"GET / HTTP/1.1\r\nHost: ")
        # Those that wait in the kernel's queue for free descriptors would be served after them.
        assert json.loads(page.recv(3))["type"] == "overview", "a page keeps working"
        assert ask(address, "/api/session")["role"] == "pilot", "another page can connect"
        fresh = held.enter_context(open_socket(f"{address.replace('http', 'ws')}/ws/overview", origin=Origin(address)))
        assert json.loads(fresh.recv(3))["type"] == "overview"
    assert len(complaints().splitlines()) < 20, "a flood causes few log lines"
