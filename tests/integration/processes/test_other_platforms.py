"""Without Linux's own functions, programs and the page reach drones on the host and the network (docs/platforms.md).

``tests/support/elsewhere`` says what that shows; ``make test-elsewhere`` runs other tests in the same way.
"""

from __future__ import annotations

import json
import os
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest

from skyloop.network.config import free_port
from tests.support.processes import Process
from tests.support.systems import only_on

pytest.importorskip("zenoh")
pytestmark = [pytest.mark.process, only_on("linux", reason="pretends to run elsewhere itself")]

LOCAL = "127.0.0.1"
TOKEN = "a-token-of-this-test-alone-0123456789"
FLY = """
import importlib, pkgutil, sys
import skyloop
for offered in dir(skyloop):
    getattr(skyloop, offered)
for package in ("client", "messages", "control", "vision", "recording", "cockpit", "network.keys", "aio", "drivers"):
    module = importlib.import_module(f"skyloop.{package}")
    for one in pkgutil.iter_modules(module.__path__):
        if one.name != "__main__":
            importlib.import_module(f"{module.__name__}.{one.name}")
with skyloop.connect(sys.argv[1], network=sys.argv[2] or False) as drone:
    drone.takeoff()
    print("flew, and saw", drone.next_frame(timeout_s=20.0).shape, flush=True)
    drone.land()
"""


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Provide a function that makes all processes that start later take this system for another one."""

    def begin(system: str) -> None:
        found = str(Path(__file__).parents[2] / "support" / "elsewhere")
        monkeypatch.setenv("SKYLOOP_PRETEND", system)
        monkeypatch.setenv("PYTHONPATH", found, prepend=os.pathsep)

    return begin


def test_programs_and_the_page_reach_drones_on_the_network(
    start: Callable[..., Process], pretend: Callable[[str], None], tmp_path: Path
) -> None:
    place = f"{LOCAL}:{free_port(LOCAL)}"
    uri = "sim://?world=empty&cameras=front&speed=3"
    network = ("--network", "--no-multicast", "--listen", place)
    start("-m", "skyloop", "proxy", uri, "--name", "alpha", *network).until("ready")

    pretend("win32")
    flight = start("-c", FLY, "alpha", place)
    flight.until("flew, and saw (240, 320, 3)", 60)
    assert flight.wait() == 0

    open_to_all = start("-m", "skyloop", "cockpit", "--port", "0", "--network", place)
    open_to_all.until("cockpit: http://127.0.0.1:", 60)
    address = open_to_all.text.partition("cockpit: ")[2].split()[0]
    with pytest.raises(urllib.error.HTTPError, match="401"):  # without peer credentials, the browser is paired first
        urllib.request.urlopen(f"{address.partition('#')[0]}api/drones")

    tokens = tmp_path / "tokens"
    tokens.write_text(f"observer {TOKEN} olga\n")
    tokens.chmod(0o600)
    page = start("-m", "skyloop", "cockpit", "--port", "0", "--token-file", str(tokens), "--network", place)
    page.until("cockpit: http://127.0.0.1:", 60)
    address = page.text.partition("cockpit: ")[2].split()[0]
    body = json.dumps({"token": TOKEN}).encode()
    headers = {"content-type": "application/json", "origin": address.rstrip("/")}
    with urllib.request.urlopen(urllib.request.Request(f"{address}api/login", body, headers)) as answer:
        assert json.load(answer)["role"] == "observer"


@pytest.mark.parametrize("system", ["win32", "darwin"])
def test_programs_reach_drones_on_their_own_host(
    start: Callable[..., Process], pretend: Callable[[str], None], system: str
) -> None:
    """Over the portable side of the local transport, frames included."""
    pretend(system)
    start("-m", "skyloop", "proxy", "sim://?world=empty&cameras=front&speed=3", "--name", "bravo").until("ready", 60)
    flight = start("-c", FLY, "bravo", "")
    flight.until("flew, and saw (240, 320, 3)", 60)
    assert flight.wait() == 0
    listing = start("-m", "skyloop", "list")
    listing.until("bravo", 60)
    assert listing.wait() == 0
