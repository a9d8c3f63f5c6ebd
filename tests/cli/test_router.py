"""``skyloop router --print-config`` prints a configuration for Zenoh's own router; the options of the network."""

from __future__ import annotations

import json

import pytest
import zenoh

from tests.support.commands import Run


def test_the_printed_configuration_is_one(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SKYLOOP_KEYS", raising=False)
    ended = run("router", "--print-config", "--listen", "10.0.0.5:7447", "--connect", "other.example")
    assert ended.code == 0
    zenoh.Config.from_json5(ended.out)
    printed = json.loads(ended.out)
    assert printed["mode"] == "router"
    assert printed["listen"]["endpoints"] == ["tcp/10.0.0.5:7447?rel=1", "udp/10.0.0.5:7447?rel=0"]
    assert printed["connect"]["endpoints"] == ["tcp/other.example:7447?rel=1", "udp/other.example:7447?rel=0"]
    assert printed["transport"]["link"]["protocols"] == ["tcp", "udp"]


def test_invalid_addresses_are_reported(run: Run) -> None:
    for words in (
        ("router", "--listen", "nonsense:port"),
        ("proxy", "sim://", "--network", "--connect", "host:70000"),
        ("sim", "--network", "--connect", "host:70000"),
        ("list", "--network", "host:70000"),
    ):
        ended = run(*words)
        assert ended.code == 2
        assert "is not a network address" in ended.err


@pytest.mark.parametrize(
    "option", [("--listen", "1.2.3.4:5"), ("--connect", "1.2.3.4"), ("--keys", "/x"), ("--no-multicast",)]
)
def test_options_of_the_network_need_the_network(run: Run, option: tuple[str, ...]) -> None:
    for command in (("proxy", "sim://"), ("sim",)):
        ended = run(*command, *option)
        assert ended.code == 2
        assert f"{option[0]} is for the network: give --network multicast as well" in ended.err


def test_firmware_is_not_a_proxy(run: Run) -> None:
    ended = run("sim", "--firmware", "ardrone2", "--network")
    assert ended.code == 2
    assert "--bind ADDRESS" in ended.err


def test_the_list_says_where_it_looked(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path_factory.mktemp("none")))
    said = run("list", "--network", "127.0.0.1:1").out
    assert said.startswith("No proxy is running on this host or can be reached over the network (127.0.0.1:1).")
