"""``skyloop keys``: a lab created, shown and changed from the command line."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from skyloop.network.keys import Lab, load
from skyloop.network.keys.identity import make_identity
from tests.support.commands import Run
from tests.support.systems import has_modes

DAY = timedelta(days=1)


@pytest.fixture
def folder(run: Run, tmp_path: Path) -> Path:
    assert run("keys", "init", "--dir", str(tmp_path / "lab")).code == 0
    return tmp_path / "lab"


def test_a_lab_from_its_beginning(run: Run, folder: Path) -> None:
    first = run("keys", "issue", "alpha", "--role", "proxy", "--drones", "alpha", "--dir", str(folder))
    assert first.code == 0
    assert f"copy {folder / 'issued' / 'alpha'} to its machine" in first.out
    assert "roster" not in first.out  # no one else has one
    second = run("keys", "issue", "jane", "--role", "pilot", "--drones", "alpha*", "--dir", str(folder))
    assert second.out.startswith("jane, pilot of alpha*: valid until 2")
    assert f"copy {folder / 'roster.json'} into the keys of the others: alpha" in second.out
    assert load(folder / "issued" / "jane").name == "jane"
    shown = run("keys", "show", "--dir", str(folder))
    assert (shown.code, shown.err) == (0, "")
    assert "roster number 3" in shown.out
    assert [line.split()[:3] for line in shown.out.splitlines()[2:]] == [
        ["alpha", "proxy", "alpha"],
        ["jane", "pilot", "alpha*"],
    ]
    gone = run("keys", "revoke", "jane", "--dir", str(folder))
    assert gone.out.startswith("jane is revoked")
    assert "into the keys of the others: alpha" in gone.out
    assert run("keys", "show", "--dir", str(folder)).out.splitlines()[-1].endswith("revoked")


def test_the_default_folder_is_in_the_users_configuration(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert run("keys", "init").code == 0
    assert run("keys", "issue", "jane", "--role", "observer").code == 0
    assert load(tmp_path / "skyloop" / "keys" / "issued" / "jane").role == "observer"


def test_an_identity_shows_its_copy_of_the_list_also_to_programs(run: Run, folder: Path) -> None:
    run("keys", "issue", "jane", "--role", "pilot", "--dir", str(folder))
    shown = run("keys", "show", "--dir", str(folder / "issued" / "jane"), "--json")
    found = json.loads(shown.out)
    assert (found["number"], [key["name"] for key in found["keys"]]) == (2, ["jane"])


def test_keys_that_expire_within_a_week_are_listed(run: Run, tmp_path: Path) -> None:
    now = datetime.now(UTC)
    lab = Lab.make(tmp_path / "lab", now=now - 10 * DAY)
    lab.issue(make_identity("old", "pilot"), days=1, now=now - 2 * DAY + timedelta(hours=1))
    lab.issue(make_identity("soon", "pilot"), days=6.9, now=now)
    lab.issue(make_identity("later", "pilot"), days=9, now=now)
    lab.issue(make_identity("gone", "pilot"), days=1, now=now)
    lab.revoke("gone")
    ended = run("keys", "show", "--dir", str(lab.directory))
    assert [line.split(": ")[1][:24] for line in ended.err.splitlines()] == [
        "the key of old expired o",
        "the key of soon expires ",
    ]
    states = {line.split()[0]: line.split()[-1] for line in ended.out.splitlines()[2:]}
    assert states == {"old": "expired", "soon": "valid", "later": "valid", "gone": "revoked"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["init"], "already has an authority"),
        (["issue", "Jane", "--role", "pilot"], "cannot be the name of a key"),
        (["issue", "jane", "--role", "captain"], "pilot, observer, proxy, router"),
        (["issue", "jane", "--role", "pilot", "--drones", "a/b"], "names no drones"),
        (["issue", "jane", "--role", "pilot", "--days", "1000"], "at most 366 days"),
        (["issue", "jane"], "--role"),
        (["revoke", "jane"], "no key named 'jane'"),
    ],
)
def test_unknown_words_exit_with_2_and_get_a_suggestion(run: Run, folder: Path, words: list[str], said: str) -> None:
    ended = run("keys", *words, "--dir", str(folder))
    assert (ended.code, ended.out) == (2, "")
    assert said in ended.err


@pytest.mark.parametrize("command", [["issue", "jane", "--role", "pilot"], ["show"], ["revoke", "jane"]])
def test_a_missing_lab_is_reported_with_the_command_that_makes_one(
    run: Run, tmp_path: Path, command: list[str]
) -> None:
    ended = run("keys", *command, "--dir", str(tmp_path / "nowhere"))
    assert ended.code == 2
    assert "skyloop keys init" in ended.err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--keys", "KEYS/alpha"], "give --network multicast as well"),
        (["--network", "--keys", "KEYS/jane"], "a proxy needs keys created with --role proxy"),
        (["--network", "--keys", "KEYS/bravo"], "not for the name 'alpha'"),
        (["--network", "--keys", "KEYS/nobody"], "there is no folder"),
        (["--network", "--keys", "KEYS/alpha", "--listen", "tcp/127.0.0.1:0"], "must begin with quic/ or tls/"),
        pytest.param(
            ["--network", "--keys", "KEYS/open"],
            "open to others",
            marks=has_modes,
        ),
    ],
)
def test_a_proxy_starts_with_its_own_keys_only(run: Run, tmp_path: Path, options: list[str], said: str) -> None:
    lab = Lab.make(tmp_path / "lab")
    for name, role, drones in (
        ("alpha", "proxy", "alpha"),
        ("bravo", "proxy", "bravo"),
        ("open", "proxy", "*"),
        ("jane", "pilot", "*"),
    ):
        lab.issue(make_identity(name, role, drones))
    (lab.folder("open") / "identity.key").chmod(0o644)
    words = [option.replace("KEYS", str(lab.directory / "issued")) for option in options]
    ended = run("proxy", "sim://?cameras=none&world=empty", "--name", "alpha", "--no-multicast", *words)
    assert (ended.code, ended.out) == (2, "")
    assert said in ended.err


def test_a_router_starts_with_a_routers_keys_only(run: Run, tmp_path: Path) -> None:
    lab = Lab.make(tmp_path / "lab")
    for name, role in (("hub", "router"), ("jane", "pilot")):
        lab.issue(make_identity(name, role))
    ended = run("router", "--print-config", "--keys", str(lab.folder("jane")))
    assert (ended.code, ended.out) == (2, "")
    assert "a router needs keys created with --role router" in ended.err
    printed = json.loads(run("router", "--print-config", "--keys", str(lab.folder("hub"))).out)
    assert [subject["id"] for subject in printed["access_control"]["subjects"]] == ["hub", "jane"]
    assert printed["transport"]["link"]["tls"]["enable_mtls"] is True
