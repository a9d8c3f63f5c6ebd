"""The local transport between processes: killed ones, stopped ones, and many."""

from __future__ import annotations

import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skyloop.errors import LinkError
from skyloop.transport.base import FEEDBACK, video
from skyloop.transport.local import LocalServer, dial, list_names, packets
from skyloop.transport.local.directory import find_directory
from skyloop.transport.local.system import FAST
from skyloop.transport.testing import FRONT, ClientLog, ServerLog, header, picture, wait_until
from tests.support.systems import only_root, served_files

pytestmark = [pytest.mark.process, pytest.mark.usefixtures("side")]


@contextmanager
def process(role: str, name: str = "alpha") -> Iterator[subprocess.Popen[str]]:
    """Start another process and wait for it; kill it at the end if it still runs."""
    command = [sys.executable, str(Path(__file__).with_name("other_process.py")), role, name]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout is not None
            assert child.stdout.readline() == "ready\n"
            yield child
        finally:
            child.kill()


def ask(child: subprocess.Popen[str]) -> list[str]:
    """Return what a watching process has seen."""
    assert child.stdin is not None
    assert child.stdout is not None
    child.stdin.write("?\n")
    child.stdin.flush()
    return child.stdout.readline().split(maxsplit=2)


@contextmanager
def serving() -> Iterator[tuple[LocalServer, ServerLog]]:
    server, log = LocalServer("alpha"), ServerLog()
    server.start(log)
    try:
        yield server, log
    finally:
        server.stop()


def test_a_killed_proxy_is_noticed_at_once_and_its_name_is_free(runtime_dir: Path, side: str) -> None:
    log = ClientLog(keep=False)
    with process("serve") as child:
        client = dial("alpha")(log)
        client.subscribe(video(FRONT))
        wait_until(lambda: len(log.seen) > 10, "frames come")
        assert f"(pid {child.pid})" in client.address
        killed = time.monotonic()
        child.kill()
        wait_until(lambda: log.closings, "the client is notified")
        assert time.monotonic() - killed < 2.0
        child.wait()
        assert log.closings == ["the proxy is gone"]
        assert log.torn == []
        assert not client.send(b"x")
        client.close()
    left = ["alpha.sock" if side == FAST else "alpha.port"]
    assert served_files(runtime_dir) == left, "one stale file, and nothing else"
    with pytest.raises(LinkError, match="it was killed"):
        dial("alpha")(log)
    with serving() as (_, server_log):
        client = dial("alpha")(ClientLog())
        wait_until(lambda: server_log.joined, "a new proxy took the name")
        client.close()
    assert served_files(runtime_dir) == []


def test_a_stopping_proxy_notifies_its_clients() -> None:
    log = ClientLog()
    with process("serve") as child:
        client = dial("alpha")(log)
        client.subscribe(FEEDBACK)
        wait_until(lambda: log.packets, "the proxy serves this client")
        assert child.stdin is not None
        child.stdin.close()
        wait_until(lambda: log.closings, "the client is notified")
        assert log.closings == ["the proxy stopped"]
        client.close()
        assert child.wait() == 0
    assert list_names() == []


def test_a_killed_application_is_noticed_at_once() -> None:
    with serving() as (server, log), process("watch") as child:
        wait_until(lambda: server.subscribers(FEEDBACK) == 1, "it is subscribed")
        assert log.joined[0].address.startswith(f"pid {child.pid} (")
        for seq in range(10):
            server.publish_frame(header(seq), picture(header(seq)))
        killed = time.monotonic()
        child.kill()
        wait_until(lambda: log.left, "the server is notified")
        assert time.monotonic() - killed < 2.0
        assert log.left == [(log.joined[0], f"the application is gone ({log.joined[0].address})")]
        assert server.subscribers(FEEDBACK) == 0


def test_a_stopped_observer_delays_no_one_and_resumes_with_the_newest() -> None:
    fast = ClientLog(keep=False)
    with serving() as (server, log), process("watch") as child:
        wait_until(lambda: server.subscribers(FEEDBACK) == 1, "the observer is subscribed")
        client = dial("alpha")(fast)
        client.subscribe(video(FRONT))
        wait_until(lambda: server.subscribers(video(FRONT)) == 2, "the other is subscribed")
        child.send_signal(signal.SIGSTOP)
        missed, durations = 0, []
        for seq in range(600):
            began = time.perf_counter()
            missed += server.publish(FEEDBACK, bytes(300))
            missed += server.publish_frame(header(seq), picture(header(seq)))
            durations.append(time.perf_counter() - began)
            wait_until(lambda: fast.saw(seq), "the other client got the frame")  # noqa: B023
        assert missed > 600, "its buffers are full"
        assert sorted(durations)[len(durations) // 2] < 0.002
        assert log.left == []
        child.send_signal(signal.SIGCONT)
        wait_until(lambda: ask(child) == ["599", "0"], "it got the newest frame, and none was torn")
        assert fast.torn == []
        client.close()


@pytest.mark.side(FAST)
def test_a_proxy_that_does_not_accept_does_not_block_a_caller() -> None:
    from skyloop.transport.local.fast import Socket

    directory = find_directory()
    directory.create()
    with Socket() as listener:
        listener.bind(str(directory.path / "alpha.sock"))
        listener.listen(0)  # never accepts, like a stopped process
        waiting = dial("alpha")(ClientLog())
        began = time.monotonic()
        with pytest.raises(LinkError, match="does not accept"):
            dial("alpha")(ClientLog())
        assert time.monotonic() - began < 2
        assert [proxy.name for proxy in list_names()] == ["alpha"], "it is listed, although busy"
        waiting.close()


def test_a_thousand_connections_leave_nothing(runtime_dir: Path) -> None:
    rng = random.Random(3)
    with serving() as (server, log):
        stop = threading.Event()
        publisher = threading.Thread(target=publish_until, args=(server, stop))
        come_and_go(log, rng)
        before = resources()
        publisher.start()
        for _ in range(1000):
            come_and_go(log, rng)
        for _ in range(3):
            with process("watch") as child:
                wait_until(lambda: server.subscribers(video(FRONT)), "it watches")
                child.kill()
        wait_until(lambda: len(log.left) == len(log.joined), "all left")
        stop.set()
        publisher.join()
        wait_until(lambda: not (resources() - before), f"resources return to {before} from {resources()}")
        assert len(log.joined) == 1004
    assert served_files(runtime_dir) == []


def publish_until(server: LocalServer, stop: threading.Event) -> None:
    seq = 0
    while not stop.wait(0.002):
        seq += 1
        server.publish_frame(header(seq), picture(header(seq)))
        server.publish(FEEDBACK, b"x")


def come_and_go(log: ServerLog, rng: random.Random) -> None:
    """Open one connection and end it in one of several ways."""
    known = len(log.joined)
    if rng.random() < 0.5:
        client = dial("alpha")(ClientLog())
        client.subscribe(video(FRONT))
        client.subscribe(FEEDBACK)
        if rng.random() < 0.5:
            wait_until(lambda: len(log.joined) > known, "it joined")
        client.close()
    else:  # without a goodbye, and with unread packets
        raw = find_directory().connect("alpha")
        raw.send(packets.hello())
        raw.send(packets.subscribe(video(FRONT), True))
        if rng.random() < 0.5:
            raw.send(rng.randbytes(50))
        raw.close()
    wait_until(lambda: len(log.joined) > known, "it joined")


def resources() -> Counter[str]:
    """Count descriptors by kind, threads by name, and mappings of shared memory."""
    held: Counter[str] = Counter()
    for path in Path("/proc/self/fd").iterdir():
        try:
            held[str(path.readlink()).split(":")[0]] += 1
        except FileNotFoundError:
            continue
    maps = Path("/proc/self/maps").read_text()
    held["mapping"] = maps.count("memfd:skyloop") + maps.count("/dev/shm/sky-") + maps.count("/memfd:as-on-windows-")
    held.update(thread.name for thread in threading.enumerate() if not thread.name.startswith("Thread-"))
    return held


CALL_AS_NOBODY = """
import os, socket, sys
os.setgroups([int(group) for group in sys.argv[2:]])
os.setgid(65534)
os.setuid(65534)
sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
sock.connect(sys.argv[1])
try:
    sock.send(bytes.fromhex("534b594c 01 40 0000 02000000 0100"))
except BrokenPipeError:
    pass  # already rejected; the reason can still be read
try:
    answer = sock.recv(1000)
except ConnectionResetError:
    answer = sock.recv(1000)
print(answer[12:].decode())
"""


def call_as_nobody(path: Path, *groups: int) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", CALL_AS_NOBODY, str(path), *map(str, groups)]
    return subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)


@pytest.mark.side(FAST)
@only_root("become another user")
def test_another_user_is_rejected_even_with_access_to_the_directory(runtime_dir: Path) -> None:
    with serving() as (_, log):
        path = runtime_dir / "alpha.sock"
        runtime_dir.parent.chmod(0o755)
        assert "Permission denied" in call_as_nobody(path).stderr
        runtime_dir.chmod(0o755)
        path.chmod(0o666)
        assert "may not connect to local:alpha" in call_as_nobody(path).stdout
        assert log.joined == []


@pytest.mark.side(FAST)
@only_root("become another user")
def test_a_member_of_the_group_is_accepted(runtime_dir: Path) -> None:
    import grp

    group = next(group for group in grp.getgrall() if group.gr_gid not in (0, 65534))
    runtime_dir.parent.chmod(0o755)
    server, log = LocalServer("alpha", group=group.gr_name), ServerLog()
    server.start(log)
    try:
        path = runtime_dir / "alpha.sock"
        assert "Permission denied" in call_as_nobody(path).stderr
        member = threading.Thread(target=call_as_nobody, args=(path, group.gr_gid))
        member.start()
        wait_until(lambda: log.joined, "the member joined")
        server.disconnect(log.joined[0], "enough")
        member.join()
    finally:
        server.stop()


def test_a_default_timeout_of_sockets_changes_nothing() -> None:
    socket.setdefaulttimeout(0.01)
    try:
        with serving() as (server, log):
            client_log = ClientLog()
            client = dial("alpha")(client_log)
            wait_until(lambda: log.joined, "it joined")
            time.sleep(0.05)  # longer than that time-out
            assert server.send(log.joined[0], b"x")
            wait_until(lambda: client_log.packets, "the packet arrived")
            assert client_log.closings == []
            client.close()
    finally:
        socket.setdefaulttimeout(None)
