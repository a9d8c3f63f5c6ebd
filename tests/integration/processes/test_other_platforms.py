"""Without Linux's own functions, programs and the page reach drones on the host and the network (docs/platforms.md).

As on Windows, which lacks more than macOS does; ``other_platform.py`` says what that shows.
"""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest

from skyloop.network.config import free_port
from tests.support.processes import Process

pytest.importorskip("zenoh")
pytestmark = pytest.mark.process

LOCAL = "127.0.0.1"
TOKEN = "a-token-of-this-test-alone-0123456789"


def test_programs_and_the_page_reach_drones_on_the_network(start: Callable[..., Process], tmp_path: Path) -> None:
    place = f"{LOCAL}:{free_port(LOCAL)}"
    there = ("-m", "tests.integration.processes.other_platform", "win32")
    uri = "sim://?world=empty&cameras=front&speed=3"
    network = ("--network", "--no-multicast", "--listen", place)
    start("-m", "skyloop", "proxy", uri, "--name", "alpha", *network).until("ready")

    flight = start(*there, "fly", "alpha", place)
    flight.until("flew, and saw (240, 320, 3)", 60)
    assert flight.wait() == 0

    refused = start(*there, "cockpit", "--network", place)
    refused.until("--token-file FILE", 60)
    assert refused.wait() == 2, "without peer credentials no one is let in without a token"

    tokens = tmp_path / "tokens"
    tokens.write_text(f"observer {TOKEN} olga\n")
    tokens.chmod(0o600)
    page = start(*there, "cockpit", "--port", "0", "--token-file", str(tokens), "--network", place)
    page.until("cockpit: http://127.0.0.1:", 60)
    address = page.text.partition("cockpit: ")[2].split()[0]
    body = json.dumps({"token": TOKEN}).encode()
    headers = {"content-type": "application/json", "origin": address.rstrip("/")}
    with urllib.request.urlopen(urllib.request.Request(f"{address}api/login", body, headers)) as answer:
        assert json.load(answer)["role"] == "observer"


@pytest.mark.parametrize("platform", ["win32", "darwin"])
def test_programs_reach_drones_on_their_own_host(start: Callable[..., Process], platform: str) -> None:
    """Over the portable side of the local transport, frames included."""
    there = ("-m", "tests.integration.processes.other_platform", platform)
    start(*there, "proxy", "sim://?world=empty&cameras=front&speed=3", "--name", "bravo").until("ready", 60)
    flight = start(*there, "fly", "bravo", "")
    flight.until("flew, and saw (240, 320, 3)", 60)
    assert flight.wait() == 0
    listing = start(*there, "list")
    listing.until("bravo", 60)
    assert listing.wait() == 0
    for left in Path("/dev/shm").glob("as-on-windows-*"):  # Windows would free it
        left.unlink()
