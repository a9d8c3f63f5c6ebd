"""Misbehaving ends of local connections harm only themselves."""

from __future__ import annotations

import array
import os
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from skyloop.messages import encode
from skyloop.messages.codec import HEADER
from skyloop.transport.base import MAX_PACKET, MAX_SUBSCRIPTIONS, TransportClient
from skyloop.transport.local import LocalServer, dial, packets
from skyloop.transport.local.directory import find_directory
from skyloop.transport.local.frame_exchange import SlotMemory
from skyloop.transport.local.system import FAST, PORTABLE, PacketSocket
from skyloop.transport.testing import ClientLog, ServerLog, header, wait_until

pytestmark = pytest.mark.usefixtures("side")


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def announce(raw: PacketSocket, slot: SlotMemory) -> None:
    """Send a slot's announcement, as a server does."""

    class Announcing:
        transmit_descriptor = staticmethod(raw.send_descriptor)

        def transmit(self, packet: bytes) -> None:
            raw.send(packet)

    slot.announce(Announcing(), 1)


def send_with(sock: PacketSocket, packet: bytes, *fds: int) -> None:
    assert isinstance(sock, socket.socket), "of the fast side"
    sock.sendmsg([packet], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", fds))])


# --- a misbehaving client ---


@contextmanager
def raw_client(*first: bytes) -> Iterator[tuple[PacketSocket, ServerLog, ClientLog]]:
    """Open a bare connection to a server, beside a good client that must survive it."""
    server, log, good_log = LocalServer("alpha"), ServerLog(), ClientLog()
    server.start(log)
    good = dial("alpha")(good_log)
    wait_until(lambda: log.joined, "the good client joined")
    raw = find_directory().connect("alpha")
    raw.limit_wait(5)
    try:
        for packet in first:
            raw.send_within(packet, 5)
        yield raw, log, good_log
        assert good.send(b"undisturbed")
        wait_until(lambda: log.from_peer(log.joined[0]) == [b"undisturbed"], "the good client is served")
        assert good_log.closings == []
    finally:
        raw.close()
        good.close()
        server.stop()


def test_a_packet_too_large_ends_its_connection() -> None:
    with raw_client(packets.hello(), bytes(MAX_PACKET), bytes(MAX_PACKET + 1)) as (raw, log, _):
        wait_until(lambda: log.left, "it was disconnected")
        assert log.left[0][0] == log.joined[1]
        assert "more than 60012 bytes" in log.left[0][1]
        assert log.from_peer(log.joined[1]) == [bytes(MAX_PACKET)]
        assert packets.parse(raw.recv(1000)) == packets.Bye(log.left[0][1])


def test_an_empty_packet_is_the_end() -> None:
    with raw_client(packets.hello(), b"x", b"") as (_, log, _):
        wait_until(lambda: log.left, "it was disconnected")
        assert log.from_peer(log.joined[1]) == [b"x"]


@pytest.mark.parametrize("first", [b"x", packets.subscribe("feedback", True), packets.hello()[:-2] + b"\x02\0"])
def test_a_client_without_hello_is_rejected(first: bytes) -> None:
    with raw_client(first) as (raw, log, _):
        message = packets.parse(raw.recv(1000))
        assert isinstance(message, packets.Bye)
        assert "Hello" in message.reason
        assert raw.recv(1000) == b""
        assert len(log.joined) == 1
        assert log.left == []


def test_nonsense_is_passed_to_the_handler() -> None:
    nonsense = [
        packets.release(1),  # of a slot that it does not hold
        packets.release(1)[:-1],
        packets.slot(1, 1, 1),  # only a proxy sends this
        HEADER.pack(b"SKYL", 1, 0xFF, 0, 0),
        HEADER.pack(b"SKYL", 2, 0x41, 0, 0),
    ]
    with raw_client(packets.hello(), *nonsense) as (_, log, _):
        wait_until(lambda: len(log.packets) == len(nonsense), "the handler got them")
        assert log.from_peer(log.joined[1]) == nonsense
        assert log.left == []


def test_the_wake_up_that_older_applications_send_before_a_command_is_ignored() -> None:
    with raw_client(packets.hello(), packets.WAKE, b"x") as (_, log, _):
        wait_until(lambda: log.packets, "the handler got the packet behind it")
        assert log.from_peer(log.joined[1]) == [b"x"]
        assert log.complaints == []


def test_subscriptions_are_bounded() -> None:
    wishes = [packets.subscribe(f"topic-{number}", True) for number in range(MAX_SUBSCRIPTIONS + 1)]
    with raw_client(packets.hello(), *wishes, *wishes[:3]) as (_, log, _):
        wait_until(lambda: log.complaints, "the handler got the complaint")
        assert "'topic-64' exceeds the 64 topics" in log.complaints[0][1]
        assert log.packets == []


@contextmanager
def joined(log: ServerLog) -> Iterator[tuple[LocalServer, TransportClient]]:
    """Start a server with one client."""
    server = LocalServer("alpha")
    server.start(log)
    client = dial("alpha")(ClientLog())
    try:
        wait_until(lambda: log.joined, "it joined")
        yield server, client
    finally:
        client.close()
        server.stop()


def test_topics_that_do_not_exist_are_refused_and_leave_nothing() -> None:
    log = ServerLog()
    log.problems["video/made-up"] = "no such camera"
    with joined(log) as (server, client):
        client.subscribe("video/made-up")
        client.subscribe("video/front?scale=0.5")
        wait_until(lambda: len(log.complaints) == 2, "the handler got the complaints")
        assert log.complaints[0][1] == "no such camera"
        assert "subscribe to 'video/front'" in log.complaints[1][1]
        assert server.subscribers("video/made-up") == 0
        assert server._exchange._cameras == {}


def test_a_camera_without_readers_leaves_nothing() -> None:
    log = ServerLog()
    with joined(log) as (server, client):
        client.subscribe("video/front")
        wait_until(lambda: server._exchange._cameras, "the camera is subscribed to")
        client.close()
        wait_until(lambda: log.left, "the client is gone")
        assert server._exchange._cameras == {}


@pytest.mark.side(FAST)
def test_descriptors_sent_to_a_server_are_not_kept() -> None:
    with raw_client(packets.hello()) as (raw, log, _):
        wait_until(lambda: len(log.joined) == 2, "it joined")
        before = descriptors()
        for _ in range(20):
            send_with(raw, b"have these", 0, 0, 0)
        wait_until(lambda: len(log.packets) == 20, "the packets arrived")
        assert descriptors() <= before


def test_connections_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyloop.transport.local.server.MAX_CLIENTS", 2)
    late, log = ClientLog(), ServerLog()
    with joined(log) as (server, _):
        second = dial("alpha")(ClientLog())
        wait_until(lambda: len(log.joined) == 2, "both joined")
        for peer in log.joined:
            assert server.admit(peer, pilot=True) == ""
        client = dial("alpha")(late)
        wait_until(lambda: late.closings, "it was rejected")
        assert "has 2 connections and accepts no more" in late.closings[0]
        client.close()
        second.close()
        assert len(log.joined) == 2


@pytest.mark.side(FAST)
def test_a_server_out_of_descriptors_accepts_once_there_are_some() -> None:
    import resource

    from skyloop.transport.local.fast import Socket

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    server, log = LocalServer("alpha"), ServerLog()
    server.start(log)
    path = str(find_directory().path / "alpha.sock")
    with Socket() as first, Socket() as second:
        lowest_free = os.dup(second.fileno())
        os.close(lowest_free)
        resource.setrlimit(resource.RLIMIT_NOFILE, (lowest_free, hard))
        try:
            for raw in (first, second):  # the kernel may have reserved one descriptor for the waiting accept
                raw.connect(path)
                raw.send(packets.hello())
            second.settimeout(0.3)
            with pytest.raises(TimeoutError):
                second.recv(100)
            assert len(log.joined) <= 1
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        wait_until(lambda: len(log.joined) == 2, "both joined")
    server.stop()


# --- a misbehaving proxy ---


@contextmanager
def raw_server() -> Iterator[tuple[PacketSocket, TransportClient, ClientLog]]:
    """Open the bare server end of a client's connection."""
    listener, _ = find_directory().listen("alpha")
    log = ClientLog()
    before = descriptors()
    client = dial("alpha")(log)
    accepted, _ = listener.accept()
    try:
        assert accepted.recv(100) == packets.hello()
        yield accepted, client, log
    finally:
        client.close()
        accepted.close()
        listener.hang_up()
        del listener
    assert len(log.closings) == 1
    assert descriptors() <= before


@pytest.mark.side(PORTABLE)
@pytest.mark.parametrize(
    ("number", "capacity", "complaint"),
    [(2, 4096, "not the proxy's slot 2"), (1, 2048, "not the proxy's slot 1"), (1, 8192, "can't be mapped")],
)
def test_memory_that_is_not_the_announced_one_is_refused(number: int, capacity: int, complaint: str) -> None:
    slot = find_directory().serving.new_slot(1, 0, 4096)
    name = slot._name  # type: ignore[attr-defined]
    with raw_server() as (raw, _, log):
        raw.send(packets.named_slot(number, 1, capacity, name))
        raw.send(packets.frame(number, encode(header(1, 8, 8))))
        wait_until(lambda: log.closings, "the client refused it")
        assert complaint in log.closings[0]
        assert log.frames == []


@pytest.mark.side(PORTABLE)
def test_memory_that_does_not_exist_is_refused_when_it_is_needed() -> None:
    with raw_server() as (raw, _, log):
        raw.send(packets.named_slot(1, 1, 4096, "sky-000000000000-0"))
        raw.send(b"a sample")  # the server may have freed a slot that it announced and did not use
        wait_until(lambda: log.packets, "the connection goes on")
        raw.send(packets.frame(1, encode(header(1))))
        wait_until(lambda: log.closings, "the client refused it")
        assert "can't be mapped: [Errno 2]" in log.closings[0]


def memfd(size: int, seal: str) -> int:
    import fcntl

    fd = os.memfd_create("test", os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, getattr(fcntl, f"F_SEAL_{seal}") if seal else 0)
    return fd


@pytest.mark.side(FAST)
@pytest.mark.parametrize(
    ("size", "seal", "capacity", "complaint"),
    [
        (8192, "", 8192, "not sealed"),
        (8192, "GROW", 8192, "not sealed"),
        (4096, "SHRINK", 8192, "8192 bytes, but only 4096"),
        (4096, "SHRINK", 0, "0 bytes, but only 4096"),
        (1 << 40, "SHRINK", 1 << 40, "1099511627776 bytes, but only"),
    ],
)
def test_memory_that_could_vanish_is_refused(size: int, seal: str, capacity: int, complaint: str) -> None:
    fd = memfd(size, seal)
    try:
        with raw_server() as (raw, _, log):
            send_with(raw, packets.slot(1, 1, capacity), fd)
            wait_until(lambda: log.closings, "the client refused it")
            assert complaint in log.closings[0]
    finally:
        os.close(fd)


@pytest.mark.side(FAST)
def test_an_ordinary_file_is_refused() -> None:
    with tempfile.TemporaryFile() as file:
        file.truncate(8192)
        with raw_server() as (raw, _, log):
            send_with(raw, packets.slot(1, 1, 8192), file.fileno())
            wait_until(lambda: log.closings, "the client refused it")
            assert "not sealed" in log.closings[0]


@pytest.mark.side(FAST)
@pytest.mark.parametrize("count", [0, 2, 4])
def test_a_slot_needs_one_descriptor(count: int) -> None:
    with raw_server() as (raw, _, log):
        send_with(raw, packets.slot(1, 1, 4096), *([0] * count)) if count else raw.send(packets.slot(1, 1, 4096))
        wait_until(lambda: log.closings, "the client refused it")
        assert f"with {count} descriptors" in log.closings[0]


@pytest.mark.side(FAST)
@pytest.mark.parametrize("packet", [b"a sample", packets.bye("x"), packets.frame(1, encode(header(1)))])
def test_descriptors_out_of_place_are_closed(packet: bytes) -> None:
    with raw_server() as (raw, _, _):
        for _ in range(10):
            try:
                send_with(raw, packet, 0, 0, 0)
            except ConnectionError:
                break  # it has already refused the first


@pytest.mark.parametrize(
    ("packet", "complaint"),
    [
        (packets.frame(2, encode(header(1))), "slot 2, which it has not announced"),
        (packets.frame(1, encode(header(1, 640, 480))), "frame of 921600 bytes in slot 1"),
        (packets.frame(1, b"junk"), "header"),
        (HEADER.pack(b"SKYL", 1, 0x7F, 0, 0), "kind 0x7f"),
    ],
)
def test_frames_without_memory_are_refused(packet: bytes, complaint: str) -> None:
    slot = find_directory().serving.new_slot(1, 0, 4096)
    with raw_server() as (raw, _, log):
        announce(raw, slot)
        raw.send(packet)
        wait_until(lambda: log.closings, "the client refused it")
        assert complaint in log.closings[0]
        assert log.frames == []


def test_the_memory_is_read_only_for_a_client(side: str) -> None:
    slot = find_directory().serving.new_slot(1, 0, 4096)
    slot.array[:] = 7
    with raw_server() as (raw, _, log):
        announce(raw, slot)
        raw.send(packets.frame(1, encode(header(1))))
        wait_until(lambda: log.frames, "the frame arrived")
        pixels = log.frames[0][1]
        with pytest.raises(ValueError, match="WRITEABLE"):
            pixels.flags.writeable = True
        if side == FAST:
            from skyloop.transport.local.fast import SealedSlot

            assert isinstance(slot, SealedSlot)
            with pytest.raises(PermissionError):
                os.pwrite(slot.fd, b"x", 0)
            with pytest.raises(PermissionError):
                os.ftruncate(slot.fd, 0)
        address = f"{pixels.ctypes.data & ~0xFFF:x}-"
        mapping = next(line for line in Path("/proc/self/maps").read_text().splitlines() if line.startswith(address))
        assert mapping.split()[1] == "r--s"
        assert np.all(pixels == 7)


def test_the_end_comes_after_earlier_packets() -> None:
    with raw_server() as (raw, _, log):
        for number in range(50):
            raw.send(bytes([number + 1]))
        raw.close()
        wait_until(lambda: log.closings, "the client noticed")
        assert log.packets == [bytes([number + 1]) for number in range(50)]
        assert log.closings == ["the proxy is gone"]


def test_packets_that_do_not_fit_are_sent_later_and_in_order() -> None:
    with raw_server() as (raw, client, log):
        sent = 0
        while client.send(bytes(50_000)):  # until the buffer of the proxy, which does not read, is full
            sent += 1
        while client.send(bytes(1)):
            sent += 1
        wishes = [(f"topic-{number}", True) for number in range(5)] + [("topic-1", False)]
        for wish in wishes:
            client.subscribe(*wish)
        raw.limit_wait(5)
        received = [raw.recv(60_000) for _ in range(sent + len(wishes))]
        assert [packets.parse(packet) for packet in received[sent:]] == [packets.Subscribe(*wish) for wish in wishes]
        assert log.closings == []
