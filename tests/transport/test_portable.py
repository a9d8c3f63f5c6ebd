"""The portable side: who is let in, packets in pieces, and memory that killed processes leave behind."""

from __future__ import annotations

import _thread
import errno
import hashlib
import hmac
import itertools
import os
import selectors
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import LinkError, UsageError
from skyloop.transport.base import MAX_PACKET, NOBODY, video
from skyloop.transport.local import LocalServer, dial, list_names, named_memory, packets, portable
from skyloop.transport.local.portable import Registration, StreamSocket
from skyloop.transport.local.reactor import Reactor, SharedLocalServer
from skyloop.transport.local.server import ServerConnection
from skyloop.transport.local.system import PORTABLE, SEND_FLAGS, Credentials, System, systems
from skyloop.transport.testing import FRONT, ClientLog, ServerLog, header, picture, wait_until
from tests.support.systems import PLATFORM, only_on, only_root, served_files

pytestmark = [pytest.mark.side(PORTABLE), pytest.mark.usefixtures("side")]
SYSTEM: System = portable
has_keepers = only_on("linux", "darwin", reason="the system frees memory with its last user")
OTHER = str(Path(__file__).with_name("other_process.py"))


@contextmanager
def serving(name: str = "alpha") -> Iterator[tuple[LocalServer, ServerLog]]:
    server, log = LocalServer(name), ServerLog()
    server.start(log)
    try:
        yield server, log
    finally:
        server.stop()


def registration(path: Path) -> Registration:
    return portable._read(path / "alpha.port")


# --- who is let in ---


@contextmanager
def stranger(port: int) -> Iterator[tuple[socket.socket, bytes]]:
    """Connect without a word; return the server's nonce."""
    with socket.create_connection(("127.0.0.1", port), 5) as sock:
        nonce = sock.recv(1000)
        assert len(nonce) == 32
        yield sock, nonce


def proof(ours: Registration, nonce: bytes, version: int = 1, mac: bytes | None = None) -> bytes:
    said = b"skyloop client" + struct.pack("<HI", version, 7) + nonce + bytes(32)
    mac = hmac.digest(ours.secret, said, hashlib.sha256) if mac is None else mac
    return struct.pack("<4sHI32s32s", b"SKYL", version, 7, bytes(32), mac)


def test_a_proof_as_the_page_says_is_accepted(runtime_dir: Path) -> None:
    with serving() as (_, log):
        ours = registration(runtime_dir)
        with stranger(ours.port) as (sock, nonce):
            sock.send(proof(ours, nonce))
            said = b"skyloop server" + struct.pack("<HI", 1, 7) + nonce + bytes(32)
            assert sock.recv(1000) == hmac.digest(ours.secret, said, hashlib.sha256)
            hello = packets.hello()
            sock.send(len(hello).to_bytes(4, "little") + hello)
            wait_until(lambda: log.joined, "it joined")
            assert log.joined[0].address.startswith("pid 7 (")
        wait_until(lambda: log.left, "it left")
        assert log.refusals == []


@pytest.mark.parametrize(
    ("kind", "complaint"),
    [
        ("wrong secret", "does not know the proxy's secret"),
        ("replayed", "does not know the proxy's secret"),
        ("old version", "does not speak version 1 of the local transport's handshake"),
        ("garbage", "does not speak"),
        ("little garbage", "did not prove within 0.05 s"),
        ("slow", "did not prove within 0.05 s"),
        ("silent", "did not prove within 0.05 s"),
    ],
)
def test_strangers_are_turned_away_without_a_word(
    runtime_dir: Path, kind: str, complaint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kind in ("slow", "silent", "little garbage"):
        monkeypatch.setattr(portable, "HANDSHAKE_S", 0.05)
    with serving() as (_, log):
        ours = registration(runtime_dir)
        with stranger(ours.port) as (sock, nonce):
            said = {
                "wrong secret": proof(ours._replace(secret=bytes(32)), nonce),
                "replayed": proof(ours, bytes(32)),
                "old version": proof(ours, nonce, version=0),
                "garbage": b"GET / HTTP/1.1\r\n" * 10,
                "little garbage": b"\xff" * 10,
                "slow": proof(ours, nonce)[:-1],
                "silent": b"",
            }[kind]
            sock.send(said)
            with suppress(ConnectionResetError):  # it had not read everything
                assert sock.recv(1000) == b""
        wait_until(lambda: log.refusals, "it is reported")
        (peer, reason) = log.refusals[0]
        assert peer is NOBODY
        assert complaint in reason
        assert log.joined == []
        monkeypatch.setattr(portable, "HANDSHAKE_S", 5.0)
        client = dial("alpha")(ClientLog())
        wait_until(lambda: log.joined, "others are let in")
        client.close()


def test_a_program_that_only_looks_is_no_stranger(runtime_dir: Path) -> None:
    with serving() as (_, log):
        with stranger(registration(runtime_dir).port):
            pass
        client = dial("alpha")(ClientLog())
        wait_until(lambda: log.joined, "others are let in")
        client.close()
        assert log.refusals == []


def test_silent_strangers_keep_no_one_out(runtime_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(portable, "MAX_STRANGERS", 3)
    with serving() as (_, log):
        port = registration(runtime_dir).port
        silent = [socket.create_connection(("127.0.0.1", port)) for _ in range(5)]
        client = dial("alpha")(ClientLog())
        wait_until(lambda: log.joined, "it is let in")
        client.close()
        assert [reason.rpartition(": ")[2] for _, reason in log.refusals] == ["others wanted to connect"] * 3
        for sock in silent:
            sock.close()


def test_an_evicted_client_learns_that_it_may_try_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def give_way(sock: socket.socket, *_: object) -> int:
        sock.sendall(bytes(32))
        sock.recv(1000)
        sock.shutdown(socket.SHUT_RDWR)
        raise ConnectionAbortedError

    with serving():
        with monkeypatch.context() as patch:
            patch.setattr(portable, "_challenge", give_way)
            with pytest.raises(LinkError, match="perhaps too many others are connecting, so try again"):
                dial("alpha")(ClientLog())
        dial("alpha")(ClientLog()).close()


def test_the_server_listens_on_the_loopback_interface_only(runtime_dir: Path) -> None:
    with serving():
        listening = Path("/proc/net/tcp").read_text() + Path("/proc/net/tcp6").read_text()
        port = f":{registration(runtime_dir).port:04X} "
        assert [line.split()[1] for line in listening.splitlines() if port in line and " 0A " in line] == [
            f"0100007F{port.strip()}"
        ]


def test_an_impostor_at_the_port_is_refused_and_learns_nothing(runtime_dir: Path) -> None:
    """A program that listens at the port of the registration, without the secret."""
    with serving(), socket.create_server(("127.0.0.1", 0)) as impostor:
        path = runtime_dir / "alpha.port"
        ours = registration(runtime_dir)
        content = bytearray(path.read_bytes())
        struct.pack_into("<H", content, 10, impostor.getsockname()[1])
        with path.open("r+b") as file:
            file.write(content)
        assert registration(runtime_dir) == ours._replace(port=impostor.getsockname()[1])
        heard: list[bytes] = []

        def answer() -> None:
            sock, _ = impostor.accept()
            with sock:
                sock.send(bytes(32))
                heard.append(sock.recv(1000))
                sock.send(bytes(32))
                sock.recv(1)

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(LinkError, match="the process at its port is not this proxy"):
            dial("alpha")(ClientLog())
        thread.join()
        assert len(heard[0]) == 74
        assert ours.secret not in heard[0]


@pytest.mark.parametrize("damage", ["short", "version"])
def test_a_registration_of_another_version_is_refused(runtime_dir: Path, damage: str) -> None:
    with serving():
        path = runtime_dir / "alpha.port"
        content = path.read_bytes()
        with path.open("r+b") as file:
            if damage == "short":
                file.truncate(20)
            else:
                file.write(content[:8] + b"\x09\0")
        with pytest.raises(LinkError, match=r"not complete|not of version 1"):
            dial("alpha")(ClientLog())
        assert [(proxy.name, proxy.pid) for proxy in list_names()] == [("alpha", None)]


def test_a_stopped_proxy_does_not_block_a_caller() -> None:
    with process("serve") as child:
        child.send_signal(signal.SIGSTOP)
        wait_until(lambda: Path(f"/proc/{child.pid}/stat").read_text().split()[2] == "T", "it is stopped")
        began = time.monotonic()
        with pytest.raises(LinkError, match="does not accept"):
            dial("alpha")(ClientLog())
        assert time.monotonic() - began < 6.0
        assert [proxy.name for proxy in list_names()] == ["alpha"], "it is listed, although busy"


@only_on("linux", "darwin", reason="groups of users are unknown there")
def test_a_group_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import grp

    server = LocalServer("alpha", group=grp.getgrgid(os.getegid()).gr_name)
    with pytest.raises(UsageError, match="a group can't share proxies over the portable transport"):
        server.start(ServerLog())


AS_NOBODY = """
import os, socket, sys
from _posixshmem import shm_open
os.setgroups([])
os.setgid(65534)
os.setuid(65534)
for read in (lambda: open(sys.argv[1], "rb"), lambda: shm_open("/" + sys.argv[3], os.O_RDONLY, mode=0)):
    try:
        read()
    except PermissionError:
        print("refused")
sock = socket.socket()
sock.connect(("127.0.0.1", int(sys.argv[2])))
sock.sendall(sock.recv(100) * 4)
try:
    print(sock.recv(100))
except ConnectionResetError:
    print(b"")
"""


@only_on("linux", "darwin", reason="accounts and memory are those of this system")
@pytest.mark.process
@only_root("become another user")
def test_another_user_can_neither_connect_nor_read_frames(runtime_dir: Path) -> None:
    there = ClientLog()
    with serving() as (server, log):
        client = dial("alpha")(there)
        client.subscribe(video(FRONT))
        wait_until(lambda: server.subscribers(video(FRONT)), "it watches")
        server.publish_frame(header(1), picture(header(1)))
        wait_until(lambda: there.frames, "there is a frame")
        runtime_dir.parent.chmod(0o755)
        runtime_dir.chmod(0o755)  # even if they could enter
        (memory,) = named(named_memory.prefix())
        command = [sys.executable, "-c", AS_NOBODY, str(runtime_dir / "alpha.port")]
        ended = subprocess.run(
            [*command, str(registration(runtime_dir).port), memory],
            capture_output=True,
            text=True,
            timeout=20,
            check=False,
        )
        assert ended.returncode == 0, ended.stderr
        assert ended.stdout.splitlines() == ["refused", "refused", "b''"]
        wait_until(lambda: log.refusals, "it is reported")
        assert len(log.joined) == 1
        runtime_dir.chmod(0o700)
        client.close()


# --- packets in pieces ---


@pytest.fixture
def pair() -> Iterator[Pair]:
    """A client's end and its server's, and the raw socket of the first."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        portable._limit_received(listener, portable._TO_SERVER)
        raw = socket.create_connection(listener.getsockname())
        there, _ = listener.accept()
    ends = [StreamSocket(sock, Credentials(1, 1, 1), portable._TO_SERVER) for sock in (raw, there)]
    for end in ends:
        end.limit_backlog()
        end.limit_wait(5.0)
    yield ends[0], ends[1], ends[0]._socket
    for end in ends:
        end.close()


def is_refused(call: Callable[[], object]) -> bool:
    try:
        call()
    except BlockingIOError:
        return True
    return False


Pair = tuple[StreamSocket, StreamSocket, portable._TcpSocket]


def test_a_packet_in_pieces_arrives_whole(pair: Pair) -> None:
    _, there, raw = pair
    for cut in (1, 3, 4, 5, 8):
        content = (6).to_bytes(4, "little") + b"packet"
        raw.send(content[:cut])
        for _ in range(2):
            assert is_refused(lambda: there.recv(100, 1))
        raw.send(content[cut:] + (3).to_bytes(4, "little") + b"end")
        assert there.recv(100) == b"packet"
        assert there.recv(100) == b"end"
    with pytest.raises(BlockingIOError):
        there.recv(100, 1)
    raw.shutdown(socket.SHUT_WR)
    assert there.recv(100) == b""
    assert there.recv(100, 1) == b""


class Pieces(socket.socket):
    """A socket that receives a piece more whenever nothing is left of what came before."""

    def __init__(self, pieces: list[bytes]) -> None:
        super().__init__()
        self._pieces, self._arrived = pieces, b""

    def recv(self, size: int, flags: int = 0) -> bytes:
        if not self._arrived:
            if not self._pieces:
                return b""
            self._arrived = self._pieces.pop(0)
            raise BlockingIOError
        found = self._arrived[:size]
        if not flags & socket.MSG_PEEK:
            self._arrived = self._arrived[size:]
        return found


@given(st.lists(st.binary(min_size=1, max_size=300), max_size=8), st.lists(st.integers(0, 2000), max_size=12))
def test_packets_cut_anywhere_arrive_whole(sent: list[bytes], cuts: list[int]) -> None:
    content = b"".join(len(packet).to_bytes(4, "little") + packet for packet in sent)
    places = sorted({0, len(content), *(cut for cut in cuts if cut < len(content))})
    pieces = [content[begin:end] for begin, end in itertools.pairwise(places)]
    with socket.socket() as unused, Pieces(pieces) as raw:
        end = StreamSocket(unused, Credentials(1, 1, 1), 0)
        end._socket.close()
        end._socket = raw  # type: ignore[assignment]
        received: list[bytes] = []
        while b"" not in received:
            with suppress(BlockingIOError):
                received.append(end.recv(300, 1))
    assert received == [*sent, b""]


@given(st.binary(max_size=200))
def test_any_bytes_are_packets_or_the_end(content: bytes) -> None:
    with socket.socket() as unused, Pieces([content] if content else []) as raw:
        end = StreamSocket(unused, Credentials(1, 1, 1), 0)
        end._socket.close()
        end._socket = raw  # type: ignore[assignment]
        for _ in range(60):
            with suppress(BlockingIOError):
                if not end.recv(300, 1):
                    return
    raise AssertionError("it has no end")


@given(st.binary(max_size=120) | st.binary(max_size=70).map(lambda tail: b"SkyPort\n\1\0" + tail))
def test_any_file_is_a_registration_or_an_error(content: bytes) -> None:
    with tempfile.NamedTemporaryFile(suffix=".port") as file:
        file.write(content)
        file.flush()
        try:
            found = portable._read(Path(file.name))
        except OSError:
            return
        assert len(found.secret) == 32
        named_memory.remove_names("not a prefix/../")


def test_a_packet_sent_in_part_is_completed_without_its_sender(pair: Pair) -> None:
    here, there, _ = pair
    packet, sent = os.urandom(MAX_PACKET), 0
    began = time.monotonic()
    while not is_refused(lambda: here.send(packet)):
        sent += 1
    assert time.monotonic() - began < 2.0
    assert 1 <= sent <= 8, "the backlog is bounded"
    assert here._rest, "the last one was sent in part"
    room = threading.Event()
    here.on_room(room.set)
    here.send(b"next", here.post_flags)
    with pytest.raises(BlockingIOError):
        here.send(b"another", here.post_flags)
    assert [there.recv(MAX_PACKET) == packet for _ in range(sent)] == [True] * sent
    assert there.recv(MAX_PACKET) == b"next"
    with pytest.raises(BlockingIOError):
        there.recv(MAX_PACKET, 1)
    assert room.wait(5.0)
    assert not here._rest
    here.send(b"another")
    assert there.recv(100) == b"another"


def test_a_rest_ends_with_its_connection(pair: Pair) -> None:
    here, _, _ = pair
    while not is_refused(lambda: here.send(bytes(MAX_PACKET))):
        pass
    here.hang_up(b"bye")
    wait_until(lambda: not is_refused(lambda: here.recv(100)), "the connection has ended")
    assert here.recv(100) == b""


def test_the_rest_is_sent_when_there_is_room(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same on this thread instead of its own."""
    monkeypatch.setattr(_thread, "start_new_thread", lambda *_: None)
    here, there, _ = pair
    sent = 0
    while not is_refused(lambda: here.send(bytes(MAX_PACKET))):
        sent += 1
    room: list[bool] = []
    here.on_room(lambda: room.append(True))
    reader = threading.Thread(target=lambda: [there.recv(MAX_PACKET) for _ in range(sent)])
    reader.start()
    here._complete()
    reader.join()
    assert room == [True]
    assert not here._rest


def test_a_packet_can_wait_for_room(pair: Pair) -> None:
    here, there, _ = pair
    while not is_refused(lambda: here.send(bytes(MAX_PACKET))):
        pass
    here.send(b"next")
    assert is_refused(lambda: here.send_within(b"late", 0.02))
    reader = threading.Timer(0.05, lambda: [there.recv(MAX_PACKET) for _ in range(2)])
    reader.start()
    here.send_within(b"in time", 5.0)
    reader.join()


def test_without_threads_a_packet_in_part_ends_its_connection(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(_thread, "start_new_thread", fail)
    here, _, _ = pair
    with pytest.raises(ConnectionAbortedError, match="can't start new thread"):
        [here.send(bytes(MAX_PACKET)) for _ in range(100)]
    assert here.recv(100) == b""


def test_descriptors_are_for_the_other_side(pair: Pair) -> None:
    here, _, _ = pair
    with pytest.raises(OSError, match="no descriptors"):
        here.send_descriptor(b"x", 0)
    with pytest.raises(LinkError, match="a descriptor over TCP"):
        here.map_sealed(0, 100)


def test_a_gate_out_of_descriptors_accepts_once_there_are_some(caplog: pytest.LogCaptureFixture) -> None:
    class Full:
        def accept(self) -> None:
            raise OSError(24, "Too many open files")

    with serving() as (server, log):
        gate = server._listener
        assert isinstance(gate, portable.Gate)
        real, gate._listener = gate._listener, Full()  # type: ignore[assignment]
        first, second = dial("alpha"), dial("alpha")
        early = first(ClientLog())  # the thread is in the listener's call until then
        wait_until(lambda: "cannot accept" in caplog.text, "it is reported")
        gate._listener = real
        late = second(ClientLog())
        wait_until(lambda: len(log.joined) == 2, "both joined")
        early.close()
        late.close()


def test_a_registration_that_can_not_be_made_leaves_nothing(runtime_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> bool:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", fail)
        with pytest.raises(OSError, match="No space"):
            LocalServer("alpha").start(ServerLog())
    assert served_files(runtime_dir) == []
    with monkeypatch.context() as patch:
        patch.setattr("skyloop.platform.try_lock", lambda _: False)
        patch.setattr(portable, "_LOCKED_WITHIN_S", 0.01)
        with pytest.raises(LinkError, match="locked by another process"):
            LocalServer("alpha").start(ServerLog())
    assert served_files(runtime_dir) == []
    with monkeypatch.context() as patch:
        patch.setattr(os, "open", fail)
        live = portable.is_live(runtime_dir / "alpha.port")
    assert live, "what can't be looked at is left alone"


def test_a_stalled_readers_backlog_is_bounded(pair: Pair) -> None:
    here, there, _ = pair
    sent = 0
    while not is_refused(lambda: here.send(sent.to_bytes(300, "little"))):  # noqa: B023
        sent += 1
    assert 32 < sent < 300
    for number in range(sent):
        assert there.recv(300) == number.to_bytes(300, "little")


def test_a_send_within_a_send_is_refused(pair: Pair) -> None:
    """The garbage collector and signals' handlers may send at any point of another call."""
    here, there, raw = pair

    class Interrupted:
        def send(self, content: bytes) -> int:
            with pytest.raises(BlockingIOError):
                here.send(b"inside", SEND_FLAGS)
            with pytest.raises(BlockingIOError):
                here.send(b"inside", here.post_flags)
            return raw.send(content)

    here._socket = Interrupted()  # type: ignore[assignment]
    here.send(b"outside")
    here._socket = raw
    assert there.recv(100) == b"outside"
    with here._sending:
        refused: list[bool] = []
        thread = threading.Thread(target=lambda: refused.append(is_refused(lambda: here.send(b"x", here.post_flags))))
        thread.start()
        thread.join()
        assert refused == [True], "it waits for no lock"
    with pytest.raises(BlockingIOError):
        there.recv(100, 1)


@pytest.mark.parametrize("length", [0, 65_537, 0xFFFFFFFF])
def test_an_impossible_length_ends_the_connection(pair: Pair, length: int) -> None:
    _, there, raw = pair
    raw.send(length.to_bytes(4, "little") + bytes(100))
    assert there.recv(100) == b""
    assert there.recv(100) == b""


def test_waiting_ends_in_time(pair: Pair) -> None:
    here, there, _ = pair
    there.limit_wait(0.05)
    began = time.monotonic()
    with pytest.raises(BlockingIOError):
        there.recv(100)
    assert 0.04 < time.monotonic() - began < 2.0
    there.limit_wait(0.0)
    waker = threading.Timer(0.05, there.hang_up)
    waker.start()
    assert there.recv(100) == b""
    assert here.recv(100) == b""


def test_select_does_what_the_other_selectors_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """What Windows has."""
    monkeypatch.setattr(selectors, "DefaultSelector", selectors.SelectSelector)
    poller = portable.SelectorPoller()
    one, two = socket.socketpair()
    with one, two:
        poller.register(one.fileno())
        assert poller.poll(5.0) == [(poller.waker, selectors.EVENT_READ)], "it notices the new socket"
        poller.drain()
        poller.drain()
        two.send(b"x")
        assert poller.poll(5.0) == [(one.fileno(), selectors.EVENT_READ)]
        poller.mute(one.fileno(), True)
        poller.mute(one.fileno(), True)
        assert poller.poll(0) == []
        poller.mute(one.fileno(), False)
        poller.drain()
        assert poller.poll(5.0) == [(one.fileno(), selectors.EVENT_READ)]
        one.close()  # without a word
        assert poller.poll(0) == []
    poller.close()
    poller.wake()
    poller.unregister(1)


# --- what ends, and what must not ---


def test_a_stopping_proxy_keeps_its_name_until_its_file_is_removed(runtime_dir: Path) -> None:
    """Otherwise, it could remove the file of the next one, which may get the same inode."""
    first, second = LocalServer("alpha"), LocalServer("alpha")
    first.start(ServerLog())
    remove = first._directory.remove
    kept: list[bool] = []

    def look_first(*args: Any) -> None:
        kept.append(portable.is_live(runtime_dir / "alpha.port"))
        remove(*args)

    first._directory.remove = look_first  # type: ignore[method-assign,assignment]
    first.stop()
    assert kept == [True]
    assert list(runtime_dir.glob("*.port")) == []
    second.start(ServerLog())
    assert [proxy.name for proxy in list_names()] == ["alpha"]
    second.stop()


def test_a_proxy_that_could_not_remove_its_file_gives_its_memory_to_nobody(
    runtime_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its process may still run, and use its memory for other proxies."""
    removed: list[str] = []

    def fail(*_: object, **__: object) -> None:
        raise LinkError("the directory is locked by another process")

    with serving() as (server, _):
        monkeypatch.setattr(server._directory, "lock", fail)
    assert (runtime_dir / "alpha.port").exists()
    monkeypatch.setattr(portable, "prefix", lambda: "sky-of-another")
    monkeypatch.setattr(portable, "remove_names", removed.append)
    assert list_names() == []
    assert list(runtime_dir.glob("*.port")) == []
    assert removed == []


def gate_of(server: LocalServer) -> portable.Gate:
    gate = server._listener
    assert isinstance(gate, portable.Gate)
    return gate


def test_a_stop_waits_for_no_copy_of_its_sockets() -> None:
    """A forked child may hold one."""
    with serving() as (server, _):
        copies = [os.dup(end.fileno()) for end in (gate_of(server)._woken, gate_of(server)._bell)]
        stop = threading.Thread(target=server.stop, daemon=True)
        stop.start()
        stop.join(5.0)
        stopped = not stop.is_alive()
        for copy in copies:
            os.close(copy)
        assert stopped


@only_on("linux", "darwin", reason="no process forks")
def test_a_fork_keeps_no_copy_of_a_gate() -> None:
    import warnings

    with serving() as (server, _):
        gate = gate_of(server)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # about forks beside threads, from Python 3.12
            child = os.fork()
        if child == 0:
            os._exit(any(sock.fileno() >= 0 for sock in (gate._listener, gate._woken, gate._bell)) or gate._lock >= 0)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        dial("alpha")(ClientLog()).close()


def test_a_gate_survives_any_failure(runtime_dir: Path, caplog: pytest.LogCaptureFixture) -> None:
    failures = [RuntimeError("dictionary changed size during iteration"), MemoryError()]

    class Failing(dict[socket.socket, None]):
        def __setitem__(self, key: socket.socket, value: None) -> None:
            if failures:
                raise failures.pop()
            super().__setitem__(key, value)

    with serving() as (server, log):
        gate_of(server)._strangers = Failing()
        for _ in range(2):
            with socket.create_connection(("127.0.0.1", registration(runtime_dir).port), 5) as sock:
                assert sock.recv(100) == b"", "it is closed"
        client = dial("alpha")(ClientLog())
        wait_until(lambda: log.joined, "others are let in")
        client.close()
    assert caplog.text.count("cannot accept") == 2


def test_a_gate_that_can_not_be_made_leaves_nothing(runtime_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    for patched in ("threading.Thread.start", "socket.socketpair"):
        with monkeypatch.context() as patch:
            patch.setattr(patched, fail)
            with pytest.raises(RuntimeError, match="can't start"):
                LocalServer("alpha").start(ServerLog())
        assert list(runtime_dir.glob("*.port")) == []
        assert not [file for file in open_files() if str(runtime_dir) in file and ".port" in file]
    with serving():
        pass


@pytest.mark.parametrize("shared", [False, True])
def test_a_connection_that_fails_early_ends_alone(shared: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """macOS refuses to set options of a connection that has been reset."""
    failures = [OSError(errno.EINVAL, "Invalid argument")]
    ready = ServerConnection.__init__

    def fail_once(*args: Any) -> None:
        if failures:
            raise failures.pop()
        ready(*args)

    monkeypatch.setattr(ServerConnection, "__init__", fail_once)
    reactor = Reactor() if shared else None
    server, log, heard = (
        SharedLocalServer("alpha", reactor) if reactor else LocalServer("alpha"),
        ServerLog(),
        ClientLog(),
    )
    server.start(log)
    failing = dial("alpha")(heard)
    wait_until(lambda: heard.closings, "it is ended")
    client = dial("alpha")(ClientLog())
    wait_until(lambda: log.joined, "others are let in")
    client.close()
    failing.close()
    server.stop()
    if reactor:
        reactor.close()


def test_a_reset_connection_can_be_limited(pair: Pair) -> None:
    here, _, _ = pair
    here.close()
    here.limit_backlog()


def test_connections_beyond_what_select_takes_end_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """What Windows has."""
    monkeypatch.setattr(selectors, "DefaultSelector", selectors.SelectSelector)
    monkeypatch.setattr(portable, "_MOST_SELECTED", 3, raising=False)  # its bell, a server, and a client
    reactor = Reactor()
    server, log = SharedLocalServer("alpha", reactor), ServerLog()
    server.start(log)
    heard = ClientLog()
    first, second = dial("alpha")(ClientLog()), dial("alpha")(heard)
    wait_until(lambda: heard.closings, "the second is ended")
    assert "too many" in heard.closings[0]
    assert len(log.joined) == 1
    full = SharedLocalServer("bravo", reactor)
    with pytest.raises(OSError, match="too many"):
        full.start(ServerLog())
    assert [proxy.name for proxy in list_names()] == ["alpha"]
    assert first.send(b"packet")
    wait_until(lambda: log.packets, "the first is served")
    first.close()
    wait_until(lambda: log.left, "it left")
    third = dial("alpha")(ClientLog())
    wait_until(lambda: len(log.joined) == 2, "its place is free")
    third.close()
    second.close()
    server.stop()
    reactor.close()


def test_a_wait_that_fails_does_not_end_the_receiving_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    failures: list[Exception] = [ValueError("too many file descriptors in select()")]
    poll = portable.SelectorPoller.poll

    def fail_once(poller: portable.SelectorPoller, timeout_s: float) -> list[tuple[int, int]]:
        if failures:
            raise failures.pop()
        return poll(poller, timeout_s)

    monkeypatch.setattr(portable.SelectorPoller, "poll", fail_once)
    reactor = Reactor()
    server, log = SharedLocalServer("alpha", reactor), ServerLog()
    server.start(log)
    client = dial("alpha")(ClientLog())
    wait_until(lambda: log.joined, "it joined")
    client.close()
    server.stop()
    reactor.close()


# --- accepted packets, and the boundary between them ---


def fill(here: StreamSocket) -> int:
    """Send the longest packets until the last one is sent in part; return how many were accepted."""
    for number in range(100):
        if is_refused(lambda: here.send(number.to_bytes(MAX_PACKET, "little"))):  # noqa: B023
            assert here._rest
            return number
    raise AssertionError("the backlog is not bounded")


def test_what_was_accepted_arrives_although_its_sender_hung_up(pair: Pair) -> None:
    here, there, _ = pair
    sent = fill(here)
    began = time.monotonic()
    here.hang_up(b"bye")
    assert time.monotonic() - began < 0.2
    with pytest.raises(OSError, match="has ended"):
        here.send(b"more")
    assert here.recv(100) == b""
    for number in range(sent):
        assert there.recv(MAX_PACKET) == number.to_bytes(MAX_PACKET, "little")
    assert there.recv(100) == b"bye"
    assert there.recv(100) == b""


def test_a_stalled_reader_does_not_keep_a_connection_that_hung_up(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(portable, "_REST_S", 0.05, raising=False)
    here, there, _ = pair
    sent = fill(here)
    here.hang_up()
    wait_until(lambda: not here._awaiting_room, "its thread has ended")
    assert [len(there.recv(MAX_PACKET)) for _ in range(sent - 1)] == [MAX_PACKET] * (sent - 1)
    assert there.recv(100) == b"", "the rest is missing"


class CutShort:
    """A socket behind whose calls a signal's handler raises an exception."""

    def __init__(self, sock: socket.socket, most: int) -> None:
        self._sock, self._most = sock, most

    def send(self, content: bytes) -> int:
        self._sock.send(content[: self._most])
        raise KeyboardInterrupt

    def recv(self, size: int, flags: int = 0) -> bytes:
        content = self._sock.recv(min(size, self._most), flags)
        if flags & socket.MSG_PEEK:
            return content
        raise KeyboardInterrupt

    def shutdown(self, how: int) -> None:
        self._sock.shutdown(how)


def test_an_exception_in_the_middle_of_sending_ends_the_connection(pair: Pair) -> None:
    here, there, raw = pair
    here.send(b"before")
    here._socket = CutShort(raw, 10)  # type: ignore[assignment]
    with pytest.raises(KeyboardInterrupt):
        here.send(b"a" * 20)
    here._socket = raw
    with pytest.raises(OSError):  # noqa: PT011
        here.send(b"stop")
    assert there.recv(100) == b"before"
    assert there.recv(100) == b""


def test_an_exception_in_the_middle_of_receiving_ends_the_connection(pair: Pair) -> None:
    here, there, _ = pair
    here.send(b"a" * 20)
    here.send(b"next")
    raw = there._socket
    there._socket = CutShort(raw, 10)  # type: ignore[assignment]
    with pytest.raises(KeyboardInterrupt):
        there.recv(100)
    there._socket = raw
    assert there.recv(100) == b""
    wait_until(lambda: not is_refused(lambda: here.recv(100, 1)), "the other end learns it")


def test_an_exception_before_the_rests_thread_starts_ends_the_connection(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(_thread, "start_new_thread", interrupt)
    here, _, _ = pair
    with pytest.raises(KeyboardInterrupt):
        fill(here)
    here.hang_up()
    assert here.recv(100) == b""


def test_an_end_stays_although_a_packet_arrived_meanwhile(pair: Pair) -> None:
    here, there, raw = pair

    class HungUp(CutShort):
        def recv(self, size: int, flags: int = 0) -> bytes:
            there.hang_up()
            return raw.recv(size, flags)

    here.send(b"packet")
    raw, there._socket = there._socket, HungUp(raw, 0)  # type: ignore[assignment]
    there.recv(100)
    assert there._ended
    there._socket = raw


def test_a_rest_that_can_not_be_sent_is_forgotten_with_its_connection(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failing(CutShort):
        def send(self, content: bytes) -> int:
            raise OSError(errno.ENOBUFS, "No buffer space available")

        def fileno(self) -> int:
            return readable.fileno()

    monkeypatch.setattr(_thread, "start_new_thread", lambda *_: None)
    here, _, raw = pair
    fill(here)
    readable, other = socket.socketpair()  # there is room
    with readable, other:
        here._socket = Failing(raw, 0)  # type: ignore[assignment]
        here._complete()
        here._socket = raw
    assert here._rest == b""
    assert here.recv(100) == b""
    with pytest.raises(OSError):  # noqa: PT011
        here.send(b"mixed")


def test_one_small_packet_follows_a_rest(pair: Pair) -> None:
    """A stop is not refused because a large packet is on its way."""
    here, there, _ = pair
    sent = fill(here)
    assert is_refused(lambda: here.send(bytes(1025)))
    here.send(b"stop" * 256, SEND_FLAGS)
    assert is_refused(lambda: here.send(b"second"))
    assert [len(there.recv(MAX_PACKET)) for _ in range(sent)] == [MAX_PACKET] * sent
    assert there.recv(2000) == b"stop" * 256
    wait_until(lambda: not here._rest, "it knows")
    here.send(b"third")
    assert there.recv(100) == b"third"


# --- killed processes ---


@contextmanager
def process(role: str, name: str = "alpha") -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, OTHER, role, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    ) as child:  # fmt: skip
        try:
            assert child.stdout is not None
            assert child.stdout.readline() == "ready\n"
            yield child
        finally:
            child.kill()


def named(begin: str = "sky-") -> list[str]:
    if PLATFORM == "win32":  # in use by any process; tests/support/elsewhere/sitecustomize.py
        used = f"/memfd:as-on-windows-{begin}"
        return [link.removeprefix(used) for link in open_files() if link.startswith(used)]
    return [path.name for path in Path("/dev/shm").iterdir() if path.name.startswith(begin)]


def open_files() -> set[str]:
    found = set()
    for path in Path("/proc").glob("[0-9]*/fd/*"):
        with suppress(OSError):
            found.add(str(path.readlink()))
    return found


def keeper_of(begin: str) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if begin.encode() in words:
            found.append(int(path.parent.name))
    return found


@pytest.mark.process
@pytest.mark.parametrize("killed", ["proxy", "client", "both"])
@pytest.mark.parametrize("_number", range(2))
def test_a_killed_process_leaves_no_memory_and_no_child(runtime_dir: Path, killed: str, _number: int) -> None:
    log = ClientLog(keep=False)
    with process("serve") as proxy:
        begin = registration(runtime_dir).memory
        client = dial("alpha")(log)
        client.subscribe(video(FRONT))
        with process("watch") as watching:
            wait_until(lambda: log.seen and len(named(begin)) >= 1, "frames flow")
            wait_until(lambda: PLATFORM == "win32" or keeper_of(begin), "something keeps its memory")
            if killed in ("client", "both"):
                watching.kill()
            if killed in ("proxy", "both"):
                proxy.kill()
                client.close()
                wait_within(5.0, lambda: not named(begin) and not keeper_of(begin))
                assert proxy.stderr is not None
                assert proxy.stderr.read() == ""
            else:
                number = len(log.seen)
                wait_until(lambda: len(log.seen) > number + 50, "the others still get frames")
                assert log.torn == []
                client.close()
                wait_within(5.0, lambda: not named(begin))
                assert proxy.stdin is not None
                proxy.stdin.close()
                assert proxy.wait() == 0
                wait_within(5.0, lambda: not keeper_of(begin))
    assert named(begin) == []


def wait_within(seconds: float, condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@has_keepers
@pytest.mark.process
def test_memory_of_a_proxy_killed_with_its_keeper_is_removed_by_the_next_listing(runtime_dir: Path) -> None:
    with process("serve") as proxy:
        begin = registration(runtime_dir).memory
        client = dial("alpha")(ClientLog())
        client.subscribe(video(FRONT))
        wait_until(lambda: named(begin) and keeper_of(begin), "frames flow")
        for pid in keeper_of(begin):
            os.kill(pid, signal.SIGKILL)
        proxy.kill()
        proxy.wait()
        client.close()
        assert named(begin) != []
        wait_within(5.0, lambda: not list_names())  # it may be starting another keeper, which holds its lock until then
        assert named(begin) == []


@has_keepers
@pytest.mark.process
def test_a_killed_keeper_is_replaced(runtime_dir: Path) -> None:
    with process("serve") as proxy:
        begin = registration(runtime_dir).memory
        first = ClientLog(keep=False)
        client = dial("alpha")(first)
        client.subscribe(video(FRONT))
        wait_until(lambda: keeper_of(begin), "frames flow")
        (killed,) = keeper_of(begin)
        os.kill(killed, signal.SIGKILL)
        client.close()
        client = dial("alpha")(first)
        client.subscribe(video(FRONT))
        wait_until(lambda: [pid for pid in keeper_of(begin) if pid != killed], "the next slot starts another one")
        client.close()
        proxy.kill()
        wait_within(5.0, lambda: not named(begin))


def test_an_ending_server_leaves_the_memory_of_others_in_its_process() -> None:
    """Its name is free for a moment before its file is gone, and others may look at it then."""
    there = ClientLog()
    with serving("bravo") as (bravo, _):
        client = dial("bravo")(there)
        client.subscribe(video(FRONT))
        wait_until(lambda: bravo.subscribers(video(FRONT)), "it watches")

        def arrived() -> bool:
            bravo.publish_frame(header(1), picture(header(1)))  # until one finds the client ready for it
            return bool(there.frames)

        wait_until(arrived, "there is a frame")
        before = named(named_memory.prefix())
        with serving("alpha"):
            pass
        assert list_names()[0].name == "bravo"
        assert named(named_memory.prefix()) == before
        client.close()


def test_slots_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    named_memory.prefix()
    monkeypatch.setattr(named_memory._process, "free", type(named_memory._process.free)([5]))
    slot = named_memory.NamedSlot(1, 0, 100)
    with pytest.raises(OSError, match="slots"):
        named_memory.NamedSlot(2, 0, 100)
    assert len(named(named_memory.prefix())) == 1
    del slot
    assert named(named_memory.prefix()) == []
    named_memory.NamedSlot(3, 0, 100)


def test_a_name_that_a_client_still_uses_is_not_given_to_new_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """On Windows, the memory would be the old one, with its size and its picture."""
    named_memory.prefix()
    free = named_memory._process.free
    monkeypatch.setattr(named_memory._process, "free", type(free)([5, 6]))
    first = named_memory.NamedSlot(1, 0, 100)
    first.array[:] = 7
    name = first._name
    held: Any = named_memory.map_named(name, 1, 100)
    del first
    if PLATFORM != "win32":  # where only the name's owner keeps it
        held = named_memory._create(name, 164)
    again = [named_memory.NamedSlot(2, 0, 5000)]
    assert again[0]._name.endswith("-6")
    with pytest.raises(OSError, match="slots"):
        named_memory.NamedSlot(3, 0, 50)
    del held
    named_memory._unlink(name)
    again.append(named_memory.NamedSlot(3, 0, 50))
    assert again[1]._name == name
    assert not again[1].array.any(), "it has nothing of the old picture"


def test_an_unknown_name_is_no_memory() -> None:
    name = f"{named_memory.prefix()}-fff"
    with pytest.raises(LinkError, match="can't be mapped"):
        named_memory.map_named(name, 1, 100)
    slot = named_memory._create(name, 164)
    assert slot[:] == bytes(164), "no client has made it"
    named_memory._unlink(name)


@only_on("linux", "darwin", reason="no process forks")
def test_a_forks_copy_of_a_slot_removes_nothing() -> None:
    import warnings

    slot = named_memory.NamedSlot(1, 0, 100)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # about forks beside threads, from Python 3.12
        child = os.fork()
    if child == 0:
        mine = named_memory.prefix()
        slot.__del__()
        os._exit(mine == slot._owner.prefix)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert named(slot._name) == [slot._name]


@only_on("linux", reason="there is one side only")
def test_a_process_out_of_descriptors_does_not_settle_on_the_portable_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """For its whole life, it would have seen no proxy of the fast side, and served under a name that one has."""
    sides = systems()
    systems.cache_clear()

    def fail(number: int) -> Callable[..., object]:
        def socketpair(*_: object) -> object:
            raise OSError(number, os.strerror(number))

        return socketpair

    try:
        with monkeypatch.context() as patch:
            patch.setattr(socket, "socketpair", fail(errno.EMFILE))
            with pytest.raises(LinkError, match="Too many open files"):
                systems()
        assert list(systems()) == list(sides)
        with monkeypatch.context() as patch:
            systems.cache_clear()
            patch.setattr(socket, "socketpair", fail(errno.EPROTONOSUPPORT))
            assert list(systems()) == [PORTABLE]
    finally:
        systems.cache_clear()
        assert list(systems()) == list(sides)


def test_a_packet_sent_in_part_just_as_the_room_for_the_last_one_was_found_is_completed(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread of the last packet marked both as complete, so the thread of the new one gave up after one try."""
    here, there, _ = pair
    monkeypatch.setattr(portable, "_REST_SLICE_MS", 1)
    find_room = here._wait_and_send

    def find_room_and_send_more() -> bool:
        monkeypatch.setattr(here, "_wait_and_send", look)
        complete = find_room()
        while not here._rest:
            here.send(bytes(MAX_PACKET))
            sent.append(MAX_PACKET)
        done.set()
        return complete

    def look() -> bool:
        done.wait(10.0)
        return find_room()

    sent: list[int] = []
    done = threading.Event()
    monkeypatch.setattr(here, "_wait_and_send", find_room_and_send_more)
    while not here._rest:
        here.send(bytes(MAX_PACKET))
        sent.append(MAX_PACKET)
    first = len(sent)
    for _ in range(first):
        assert len(there.recv(MAX_PACKET)) == MAX_PACKET
    assert done.wait(10.0)
    time.sleep(0.1)  # many looks, at none of which there is room
    there.limit_wait(10.0)
    for _ in range(len(sent) - first):
        assert len(there.recv(MAX_PACKET)) == MAX_PACKET
