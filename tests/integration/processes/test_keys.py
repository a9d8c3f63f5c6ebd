"""A lab from the command line: a proxy with keys, who may find, see and fly it, and what it reports about its keys."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from skyloop.errors import AuthorityError, UnknownNameError
from skyloop.messages import EventKind
from skyloop.network.config import free_port
from skyloop.network.keys import Lab
from skyloop.network.keys.identity import make_identity
from tests.support.processes import Process, eventually

pytestmark = pytest.mark.process
LOCAL = "127.0.0.1"


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    lab = Lab.make(tmp_path / "lab")
    for name, role, drones, days in (
        ("alpha", "proxy", "alpha", 5),
        ("jane", "pilot", "alpha*", 30),
        ("bob", "pilot", "bravo", 30),
        ("olga", "observer", "*", 5),
    ):
        lab.issue(make_identity(name, role, drones), days=days)
    return lab


@pytest.fixture
def place(start: Callable[..., Process], lab: Lab, sockets: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The address of a proxy with keys that can't be reached by its socket from here."""
    place = f"{LOCAL}:{free_port(LOCAL)}"
    with monkeypatch.context() as elsewhere:
        elsewhere.setenv("SKYLOOP_RUNTIME_DIR", str(sockets.parent / "elsewhere"))
        options = ("--network", "--no-multicast", "--listen", place, "--keys", str(lab.folder("alpha")))
        process = start("-m", "skyloop", "proxy", "sim://?world=empty&cameras=none", "--name", "alpha", *options)
        process.until("ready")
        process.until("the key of alpha expires in 5 days")
    assert "WARNING: --network without keys" not in process.text
    return place


def skyloop_list(place: str, keys: Path | None) -> tuple[list[str], str]:
    """The proxies that ``skyloop list`` shows, and its other output."""
    words = [sys.executable, "-m", "skyloop", "list", "--json", "--network", place]
    words += [] if keys is None else ["--keys", str(keys)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60)
    return [row["name"] for row in json.loads(done.stdout)], done.stderr


def test_permissions(place: str, lab: Lab) -> None:
    with skyloop.connect("alpha", network=skyloop.Network(place, keys=lab.folder("jane"))) as jane:
        jane.takeoff()
        jane.wait("hovering")
    with skyloop.connect("alpha", network=skyloop.Network(place, keys=lab.folder("olga")), access="observe") as olga:
        assert olga.feedback() is not None
        with pytest.raises(AuthorityError, match=r"the keys of olga, observer of \*: they give no right"):
            olga.config["limits.tilt"] = 0.1
    with pytest.raises(AuthorityError, match="the keys of bob, pilot of bravo: they give no right to fly"):
        skyloop.connect("alpha", network=skyloop.Network(place, keys=lab.folder("bob")))
    with pytest.raises(UnknownNameError):
        skyloop.connect("alpha", network=place, timeout_s=1.0)


def test_the_list_shows_what_a_key_can_find_and_what_ends(place: str, lab: Lab) -> None:
    eventually(lambda: skyloop_list(place, lab.folder("jane")) == (["alpha"], ""), "the list of a pilot", 30.0)
    found, said = skyloop_list(place, lab.folder("olga"))
    assert found in (["alpha"], []), "it may be empty on a busy machine: the search lasts one second"
    assert "the key of olga expires in 5 days" in said
    assert skyloop_list(place, None)[0] == []


def test_a_proxy_reports_that_its_roster_has_changed(place: str, lab: Lab) -> None:
    with skyloop.connect("alpha", network=skyloop.Network(place, keys=lab.folder("olga")), access="observe") as olga:
        lab.revoke("bob")

        def told() -> bool:
            return any(event.kind is EventKind.KEYS for event in olga.recent_events())

        eventually(told, "the event")
        event = next(event for event in olga.recent_events() if event.kind is EventKind.KEYS)
        assert "revoked or changed: bob" in event.text


def test_through_a_router_with_keys(
    start: Callable[..., Process], lab: Lab, sockets: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    lab.issue(make_identity("hub", "router"))
    place = f"{LOCAL}:{free_port(LOCAL)}"
    keys = ("--no-multicast", "--keys")
    hub = start("-m", "skyloop", "router", "--listen", place, *keys, str(lab.folder("hub")))
    hub.until("ready")
    assert "WARNING" not in hub.text
    with monkeypatch.context() as elsewhere:
        elsewhere.setenv("SKYLOOP_RUNTIME_DIR", str(sockets.parent / "elsewhere"))
        network = ("--network", "--listen", f"{LOCAL}:0", "--connect", place, *keys, str(lab.folder("alpha")))
        alpha = start("-m", "skyloop", "proxy", "sim://?world=empty&cameras=none", "--name", "alpha", *network)
        alpha.until("ready")
    with skyloop.connect("alpha", network=skyloop.Network(place, keys=lab.folder("jane"))) as jane:
        jane.takeoff()
        with skyloop.connect(
            "alpha", network=skyloop.Network(place, keys=lab.folder("olga")), access="observe"
        ) as olga:
            olga.wait("hovering")
    with pytest.raises(UnknownNameError):
        skyloop.connect("alpha", network=place, timeout_s=1.0)
    lab.revoke("bob")
    hub.until("revoked or changed: bob")
    stolen = Path(shutil.copytree(lab.folder("olga"), tmp_path / "stolen"))
    with skyloop.connect("alpha", network=skyloop.Network(place, keys=stolen), access="observe") as olga:
        lab.revoke("olga")
        hub.until("reconnecting without olga")
        eventually(lambda: olga.link.application == "lost", "olga is shut out")
    with skyloop.connect("alpha", network=skyloop.Network(place, keys=lab.folder("jane")), access="observe") as jane:
        assert jane.feedback() is not None
