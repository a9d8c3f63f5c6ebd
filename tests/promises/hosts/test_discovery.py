"""Discovery on a network of several hosts, and the errors for names that are missing or taken."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest

from tests.promises.hosts import flying
from tests.promises.hosts.conftest import Lan
from tests.promises.hosts.remote import Remote, RemoteError
from tests.support.processes import Process

Start = Callable[..., Process]
OnHost = Callable[..., Remote]


def test_proxies_of_other_hosts_are_listed_and_connected_to_by_name(
    lan: Lan, start: Start, proxy: Start, remote: OnHost
) -> None:
    hangar, roof, desk = (lan.host(name) for name in ("hangar", "roof", "desk"))
    proxy(hangar, "alpha")
    proxy(roof, "bravo")
    hidden = start(roof, "-m", "skyloop", "proxy", "sim://?world=empty&cameras=none", "--name", "hidden")
    hidden.until("ready")

    listed = desk.run("env", "COLUMNS=200", sys.executable, "-m", "skyloop", "list")
    rows = {line.split()[0]: line for line in listed.splitlines() if line.split()}
    assert "hangar" in rows["alpha"]
    assert "roof" in rows["bravo"]
    assert "landed" in rows["alpha"]
    assert "hidden" not in rows, "without --network nothing leaves a host"
    app = remote(desk)
    for name in ("alpha", "bravo"):
        assert app.do(flying.connect, name) == "up"
        app.do(flying.call, name, "takeoff")
        app.do(flying.wait, name, "hovering")
    with pytest.raises(RemoteError, match=r"'alphaa'.*did you mean 'alpha'"):
        app.do(flying.connect, "alphaa")
    with pytest.raises(RemoteError, match="no proxy"):
        app.do(flying.connect, "hidden")


def test_a_name_used_on_another_host_is_refused_with_its_owner(lan: Lan, start: Start, proxy: Start) -> None:
    hangar, roof = lan.host("hangar"), lan.host("roof")
    first = proxy(hangar, "alpha")
    second = start(roof, "-m", "skyloop", "proxy", "sim://?cameras=none", "--name", "alpha", "--network")
    second.until("in use")
    second.until("hangar")
    second.until(str(first.pid))
    assert second.wait() != 0
