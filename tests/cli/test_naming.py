"""One way to name a drone and one to name a network, in every command; errors in the terms of the command line."""

from __future__ import annotations

import inspect
import logging
import os
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

from skyloop.cli import naming
from skyloop.cli.app import build
from skyloop.cli.commands import COMMANDS
from skyloop.cli.ending import AllOption
from skyloop.cli.text import error_text
from skyloop.errors import Hint, LinkError, SkyloopError, UnknownNameError, UsageError
from tests.support.commands import Run

#: Commands that name a running drone.
OF_DRONES = ("fly", "teleop", "land", "stop", "watch", "cockpit", "process", "param", "audit", "record")


@pytest.mark.parametrize("command", OF_DRONES)
def test_every_command_about_a_drone_takes_it_as_name_and_as_drone(command: str) -> None:
    entry = COMMANDS[command]
    names = inspect.signature(getattr(import_module(f"skyloop.cli.{entry.module}"), entry.function)).parameters
    assert "drone" in names
    group: Any = typer.main.get_command(build([command]))
    options = {word for param in group.commands[command].params for word in param.opts}
    assert "--drone" in options
    if command != "audit":  # its files are on this host
        assert {"--network", "--keys"} <= options


@pytest.mark.parametrize(
    ("name", "drone", "default", "chosen"),
    [
        ("alpha", None, None, "alpha"),
        (None, "alpha", None, "alpha"),
        ("alpha", "alpha", None, "alpha"),
        (None, None, "sim://", "sim://"),
    ],
)
def test_a_drone_is_named_by_either(name: str | None, drone: str | None, default: str | None, chosen: str) -> None:
    assert naming.one_drone(name, drone, default) == chosen


def test_a_drone_that_is_not_named_or_named_twice_is_refused(run: Run) -> None:
    with pytest.raises(UsageError, match="NAME a and --drone b name two drones"):
        naming.one_drone("a", "b")
    with pytest.raises(UsageError, match="give NAME or --drone NAME; none is running: skyloop sim"):
        naming.one_drone(None, None)
    assert naming.drones(["a", "b"], ["b", "c"]) == ["a", "b", "c"]
    for words in (["watch"], ["teleop"], ["param"], ["record"], ["land"], ["stop", "--yes"], ["camera", "calibrate"]):
        ended = run(*words)
        assert (ended.code, ended.out) == (2, "")
        assert ended.err.startswith("skyloop: no drone given: give NAME or --drone NAME; none is running")


@pytest.mark.parametrize("words", [["nobody"], ["--drone", "nobody"], ["--drone=nobody"]])
def test_a_drone_that_does_not_run_is_explained_without_python(run: Run, words: list[str]) -> None:
    ended = run("watch", *words)
    assert ended.code == 2
    assert ended.err == (
        "skyloop: no proxy named 'nobody'; none is known here; "
        "only this host was searched: --network multicast, or --network HOST:PORT, searches further\n"
    )


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["proxy", "sim://", "--network"], ["proxy", "sim://", "--network", "multicast"]),
        (["proxy", "--network", "sim://"], ["proxy", "--network", "multicast", "sim://"]),
        (["sim", "--network", "--listen", "x"], ["sim", "--network", "multicast", "--listen", "x"]),
        (["list", "--network", "a:1,multicast"], ["list", "--network", "a:1,multicast"]),
        (["param", "a", "b", "--", "--network"], ["param", "a", "b", "--", "--network"]),
    ],
)
def test_a_network_without_a_place_is_searched_by_multicast(words: list[str], meant: list[str]) -> None:
    assert naming.with_place(words) == meant


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("nonsense/x", "'nonsense/x' is not a network address, such as 10.0.0.5:7447"),
        ("host:70000", "is not a network address"),
        ("nowhere.invalid:7447", "cannot join the network: the host's name is unknown"),
    ],
)
def test_a_wrong_network_is_refused_without_a_library_s_paths(run: Run, where: str, said: str) -> None:
    ended = run("watch", "alpha", "--network", where)
    assert ended.code in (1, 2)
    assert said in ended.err
    assert ".rs" not in ended.err
    assert "cargo" not in ended.err


def test_errors_of_the_network_s_library_lose_the_places_in_its_sources() -> None:
    from skyloop.network.session import reason_of

    text = (
        "Can not create a new TCP listener bound to tcp/1.2.3.4:7447?rel=1: [1.2.3.4:7447: Cannot assign requested "
        "address (os error 99) at /root/.cargo/git/checkouts/zenoh/cc83980/io/zenoh-link-commons/src/tcp.rs:61.] at "
        "/root/.cargo/git/checkouts/zenoh/cc83980/io/zenoh-links/zenoh-link-tcp/src/unicast.rs:338."
    )
    assert reason_of(Exception(text)) == (
        "Can not create a new TCP listener bound to tcp/1.2.3.4:7447: "
        "[1.2.3.4:7447: Cannot assign requested address (os error 99)]"
    )


def test_every_hint_has_its_words_in_python_and_in_the_terminal() -> None:
    for hint in Hint:
        error = LinkError("gone").with_hint(hint)
        assert str(error).startswith("gone; ")
        assert error.reason == "gone"
        said = error_text(error)
        assert said.startswith("gone; ")
        for word in ("=True", "access=", "wait_s"):
            assert word not in said
    assert str(UnknownNameError("proxy", "x", [])) == error_text(UnknownNameError("proxy", "x", []))


def test_the_words_of_options_are_the_same_everywhere() -> None:
    """One spelling and one help text: a second would be a second way."""
    found: dict[str, set[str]] = {}
    group: Any = typer.main.get_command(build())
    for name in OF_DRONES:
        for param in group.commands[name].params:
            if "--network" in param.opts or "--keys" in param.opts:
                found.setdefault(param.opts[0], set()).add(param.help)
    assert {len(helps) for helps in found.values()} == {1}
    assert AllOption is not None


@pytest.fixture
def quiet() -> Iterator[None]:
    root, own = logging.getLogger(), logging.getLogger("skyloop")
    handlers, level, own_level = list(root.handlers), root.level, own.level
    yield
    root.handlers[:], root.level = handlers, level
    own.setLevel(own_level)


@pytest.mark.parametrize("words", [["--verbose", "watch", "nobody"], ["watch", "nobody", "--verbose"]])
@pytest.mark.usefixtures("quiet")
def test_verbose_logs_behind_and_before_a_command(run: Run, words: list[str], caplog: pytest.LogCaptureFixture) -> None:
    ended = run(*words)
    assert ended.code == 2
    assert any(record.exc_info and isinstance(record.exc_info[1], SkyloopError) for record in caplog.records)


def test_the_network_reaches_what_a_command_starts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SKYLOOP_NETWORK", "")
    naming.join_network("10.0.0.5:7447", None)
    assert os.environ["SKYLOOP_NETWORK"] == "10.0.0.5:7447"
    monkeypatch.setenv("SKYLOOP_NETWORK", "")
    monkeypatch.delenv("SKYLOOP_NETWORK")
    with pytest.raises(UsageError) as refused:
        naming.join_network(None, tmp_path)
    assert (
        error_text(refused.value) == "keys are for the network; give --network multicast or --network HOST:PORT as well"
    )
