"""The directory of sockets: names, access, and leftovers of killed proxies."""

from __future__ import annotations

import os
import socket
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from skyloop.errors import LinkError, NameTakenError, UnknownNameError, UsageError
from skyloop.transport.local import LocalServer, dial, list_names, names_of_others
from skyloop.transport.local.directory import directory_owner, find_directory, of_others
from skyloop.transport.local.system import FAST, PORTABLE, serving_side, systems, user_name
from skyloop.transport.testing import ClientLog, ServerLog, wait_until
from tests.support.systems import has_modes, only_root, served_files

pytestmark = pytest.mark.usefixtures("side")


@pytest.fixture
def suffix(side: str) -> str:
    return ".sock" if side == FAST else ".port"


@pytest.mark.parametrize("name", ["", "Alpha", "-a", ".a", "a/b", "a" * 49, "a b", "ä", "a\n"])
def test_invalid_names_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match="cannot be the name of a proxy"):
        LocalServer(name)
    with pytest.raises(UsageError, match="cannot be the name of a proxy"):
        dial(name)


def test_running_proxies_are_listed(runtime_dir: Path, suffix: str) -> None:
    assert list_names() == []
    servers = [LocalServer(name) for name in ("bravo", "alpha", "a" * 48)]
    logs = [ServerLog() for _ in servers]
    for server, log in zip(servers, logs, strict=True):
        server.start(log)
    try:
        found = list_names()
        assert [proxy.name for proxy in found] == ["a" * 48, "alpha", "bravo"]
        assert {proxy.pid for proxy in found} == {os.getpid()}
        assert found[1].path == runtime_dir / f"alpha{suffix}"
    finally:
        for server in servers:
            server.stop()
    assert list_names() == []
    assert served_files(runtime_dir) == []
    assert [log.joined for log in logs] == [[], [], []], "listing does not connect"


def test_only_the_owner_may_enter(runtime_dir: Path, suffix: str) -> None:
    server = LocalServer("alpha")
    server.start(ServerLog())
    try:
        assert stat.S_IMODE(runtime_dir.stat().st_mode) == 0o700
        assert stat.S_IMODE((runtime_dir / f"alpha{suffix}").stat().st_mode) == 0o600
    finally:
        server.stop()


@has_modes
@pytest.mark.parametrize("mode", [0o701, 0o704, 0o720, 0o777])
def test_a_directory_open_to_others_is_refused(runtime_dir: Path, mode: int) -> None:
    runtime_dir.mkdir()
    runtime_dir.chmod(mode)
    with pytest.raises(LinkError, match=f"open to others .mode {mode:04o}"):
        LocalServer("alpha").start(ServerLog())
    with pytest.raises(LinkError, match="open to others"):
        dial("alpha")(ClientLog())
    with pytest.raises(LinkError, match="open to others"):
        list_names()


@has_modes
def test_a_directory_in_an_open_place_is_refused(runtime_dir: Path) -> None:
    runtime_dir.parent.chmod(0o777)
    with pytest.raises(LinkError, match="can be changed by others"):
        LocalServer("alpha").start(ServerLog())


@has_modes
@only_root("create another user's directory")
def test_another_users_directory_is_refused(runtime_dir: Path) -> None:
    runtime_dir.mkdir(mode=0o700)
    os.chown(runtime_dir, 65534, 65534)
    with pytest.raises(LinkError, match=r"belongs to .* and not to"):
        LocalServer("alpha").start(ServerLog())


def test_a_file_in_place_of_the_directory_is_refused(runtime_dir: Path) -> None:
    runtime_dir.write_text("")
    with pytest.raises(LinkError, match="not a directory"):
        LocalServer("alpha").start(ServerLog())
    runtime_dir.unlink()
    runtime_dir.symlink_to("/tmp")
    with pytest.raises(LinkError, match="not a directory"):
        LocalServer("alpha").start(ServerLog())


@pytest.mark.side(FAST)
def test_a_group_may_share_the_directory(runtime_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import grp

    group = grp.getgrgid(os.getegid())
    server = LocalServer("alpha", group=group.gr_name)
    server.start(ServerLog())
    try:
        assert stat.S_IMODE(runtime_dir.stat().st_mode) == 0o750
        assert stat.S_IMODE((runtime_dir / "alpha.sock").stat().st_mode) == 0o660
        assert (runtime_dir / "alpha.sock").stat().st_gid == group.gr_gid
        assert [proxy.name for proxy in list_names(group=group.gr_name)] == ["alpha"]
        monkeypatch.setenv("SKYLOOP_GROUP", group.gr_name)
        assert [proxy.name for proxy in list_names()] == ["alpha"]
    finally:
        server.stop()


@has_modes
def test_a_group_must_exist_and_have_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    import grp

    with pytest.raises(UsageError, match="no group named 'no-such-group'"):
        LocalServer("alpha", group="no-such-group")
    monkeypatch.delenv("SKYLOOP_RUNTIME_DIR")
    with pytest.raises(UsageError, match="set SKYLOOP_RUNTIME_DIR"):
        LocalServer("alpha", group=grp.getgrgid(os.getegid()).gr_name)


def test_the_default_is_the_users_runtime_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SKYLOOP_RUNTIME_DIR")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/4711")
    assert find_directory().path == Path("/run/user/4711/skyloop")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert find_directory().path.name == "skyloop"


@pytest.mark.side(FAST)
def test_a_path_too_long_for_a_socket_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", "/tmp/" + "x" * 100)
    with pytest.raises(UsageError, match="over the limit of 107"):
        LocalServer("alpha")


def test_a_taken_name_is_refused_with_its_owner() -> None:
    first, log = LocalServer("alpha"), ServerLog()
    first.start(log)
    try:
        with pytest.raises(NameTakenError, match=rf"'alpha' is in use by a running proxy .pid {os.getpid()}."):
            LocalServer("alpha").start(ServerLog())
        client = dial("alpha")(ClientLog())
        wait_until(lambda: log.joined, "the first one keeps serving")
        client.close()
    finally:
        first.stop()


def test_an_unknown_name_gets_a_suggestion() -> None:
    with pytest.raises(UnknownNameError, match="none is known here"):
        dial("alpha")(ClientLog())
    server = LocalServer("alpha")
    server.start(ServerLog())
    try:
        with pytest.raises(UnknownNameError, match="no proxy named 'alpa'; did you mean 'alpha'"):
            dial("alpa")(ClientLog())
    finally:
        server.stop()


def leave_stale_file(runtime_dir: Path, side: str) -> Path:
    """Leave a file as a killed proxy does."""
    find_directory().create()
    if side == PORTABLE:
        code = "import os, sys; from skyloop.transport.local.directory import find_directory as find\n"
        code += "listener = find().listen('alpha'); os._exit(0)"
        subprocess.run([sys.executable, "-c", code], check=True)
        return runtime_dir / "alpha.port"
    from skyloop.transport.local.fast import Socket

    path = runtime_dir / "alpha.sock"
    dead = Socket()
    dead.bind(str(path))
    dead.listen()
    dead.close()
    assert path.exists()
    return path


def test_a_stale_file_is_refused_unlisted_and_replaced(runtime_dir: Path, side: str) -> None:
    path = leave_stale_file(runtime_dir, side)
    with pytest.raises(LinkError, match="'alpha' is not running: it was killed"):
        dial("alpha")(ClientLog())
    assert list_names() == []
    assert not path.exists()
    leave_stale_file(runtime_dir, side)
    server, log = LocalServer("alpha"), ServerLog()
    server.start(log)
    client = dial("alpha")(ClientLog())
    wait_until(lambda: log.joined, "the client has joined")
    client.close()
    server.stop()
    assert served_files(runtime_dir) == []


def test_stopping_leaves_the_file_of_a_successor(runtime_dir: Path, suffix: str) -> None:
    first, second = LocalServer("alpha"), LocalServer("alpha")
    first.start(ServerLog())
    (runtime_dir / f"alpha{suffix}").unlink()
    second.start(ServerLog())
    try:
        first.stop()
        assert [proxy.name for proxy in list_names()] == ["alpha"]
    finally:
        second.stop()


def test_a_server_end_is_started_once() -> None:
    server = LocalServer("alpha")
    server.stop()
    server.start(ServerLog())
    with pytest.raises(UsageError, match="was started before"):
        server.start(ServerLog())
    server.stop()


@pytest.mark.side(FAST)
@pytest.mark.parametrize("missing", [(socket, "SOCK_SEQPACKET"), (socket, "SCM_RIGHTS"), (os, "memfd_create")])
def test_a_system_without_the_fast_sides_functions_uses_the_portable_side(
    monkeypatch: pytest.MonkeyPatch, missing: tuple[object, str]
) -> None:
    monkeypatch.delattr(*missing)
    systems.cache_clear()
    try:
        assert list(systems()) == [PORTABLE]
        check_that_both_sides_meet()
    finally:
        systems.cache_clear()


def test_an_unknown_side_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_TRANSPORT", "tcp")
    with pytest.raises(UsageError, match="SKYLOOP_TRANSPORT is 'tcp'; it must be 'portable', or 'auto'"):
        LocalServer("alpha")
    assert list_names() == [], "clients reach both sides"


@pytest.mark.parametrize("clients", ["auto", PORTABLE])
def test_clients_find_servers_of_both_sides(monkeypatch: pytest.MonkeyPatch, side: str, clients: str) -> None:
    assert serving_side() == side
    check_that_both_sides_meet(lambda: monkeypatch.setenv("SKYLOOP_TRANSPORT", clients))


def check_that_both_sides_meet(change: Callable[[], object] = lambda: None) -> None:
    server, log, there = LocalServer("alpha"), ServerLog(), ClientLog()
    server.start(log)
    change()
    client = dial("alpha")(there)
    wait_until(lambda: log.joined, "it joined")
    assert [proxy.name for proxy in list_names()] == ["alpha"]
    assert list(find_directory().running()) == ["alpha"]
    with pytest.raises(NameTakenError, match=rf"in use by a running proxy .pid {os.getpid()}."):
        LocalServer("alpha").start(ServerLog())
    client.close()
    server.stop()
    assert list_names() == []


def test_a_file_of_the_other_side_is_replaced(runtime_dir: Path, side: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = leave_stale_file(runtime_dir, side)
    monkeypatch.setenv("SKYLOOP_TRANSPORT", "auto" if side == PORTABLE else PORTABLE)
    check_that_both_sides_meet()
    assert not path.exists()


def test_proxies_of_other_users_are_known_by_name_but_unreachable() -> None:
    """The kernel names all sockets, yet ``skyloop list`` reported no proxies on this host."""
    own = os.geteuid()
    table = f"""Num       RefCount Protocol Flags    Type St Inode Path
0000000000000000: 00000002 00000000 00010000 0005 01 11 /run/user/{own + 1}/skyloop/alpha.sock
0000000000000000: 00000003 00000000 00000000 0005 03 12 /run/user/{own + 1}/skyloop/alpha.sock
0000000000000000: 00000002 00000000 00010000 0005 01 13 /run/user/{own + 1}/skyloop/beta.sock
0000000000000000: 00000002 00000000 00010000 0005 01 14 /run/user/{own + 1}/skyloop/fleet.host
0000000000000000: 00000002 00000000 00010000 0005 01 15 /run/user/{own}/skyloop/mine.sock
0000000000000000: 00000002 00000000 00010000 0001 01 16 /run/user/{own + 1}/pulse/native.sock
0000000000000000: 00000002 00000000 00010000 0005 01 17 /gone/skyloop/nobodys.sock
0000000000000000: 00000002 00000000 00000000 0002 01 18
0000000000000000: 00000002 00000000 00000000 0002 01 19 @abstract/skyloop/x.sock
"""
    owners = {Path(f"/run/user/{number}/skyloop"): number for number in (own, own + 1)}
    assert of_others(table, owners.get) == {user_name(own + 1): ["alpha", "beta"]}
    assert isinstance(names_of_others(), dict)
    assert directory_owner(Path("/proc/self/no/such")) == Path("/proc/self").stat().st_uid


def test_a_proxy_of_this_user_belongs_to_no_other(runtime_dir: Path) -> None:
    server = LocalServer("mine")
    server.start(ServerLog())
    try:
        assert [proxy.name for proxy in list_names()] == ["mine"]
        assert user_name(os.geteuid()) not in names_of_others()
    finally:
        server.stop()
