"""Hostile packets on any key: the fabric transport keeps serving clients that follow the protocol."""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from skyloop.messages import Command, Hello, ReleaseAuthority, Request, Takeoff, encode
from skyloop.network import FabricServer, FabricSettings, dial, layout, packets
from skyloop.network.client import STALLED_S as CLIENT_STALLED_S
from skyloop.network.client import FabricClient
from skyloop.network.config import LEASE_S, free_port
from skyloop.network.connection import ServerConnection
from skyloop.network.delivery import Outgoing
from skyloop.network.registry import STALLED_S
from skyloop.transport.base import FEEDBACK, MAX_PACKET, Peer, results, video
from skyloop.transport.testing import FRONT, ClientLog, ServerLog, header, picture, wait_until
from tests.network.stranger import stranger

LOCAL = "127.0.0.1"


class Scene:
    """A server and an application that follow the protocol, and an intruder connected to both."""

    def __init__(self, ends: ExitStack, lease_s: float = LEASE_S) -> None:
        place, lair = (f"{LOCAL}:{free_port(LOCAL)}" for _ in range(2))
        self.intruder = stranger(listen=[f"tcp/{lair}"], connect=[f"tcp/{place}"])
        ends.callback(self.intruder.close)
        self.server = FabricServer("alpha", FabricSettings(listen=(place,), multicast=False, lease_s=lease_s))
        self.log = ServerLog()
        self.server.start(self.log)
        ends.callback(self.server.stop)
        self.app_log = ClientLog()
        settings = FabricSettings(connect=(place, f"tcp/{lair}"), multicast=False, lease_s=lease_s)
        self.app = dial("alpha", settings)(self.app_log)
        ends.callback(self.app.close)
        wait_until(lambda: self.log.joined, "the application joined")
        for topic in (FEEDBACK, video(FRONT)):
            self.app.subscribe(topic)
        wait_until(lambda: self.server.subscribers(video(FRONT)) == 1, "it is subscribed")
        assert isinstance(self.app, FabricClient)
        self.id = self.app._id
        self.run = bytes.fromhex(self.server._run)
        wait_until(lambda: len(list(self.intruder.info.peers_zid())) == 2, "the intruder is connected to both")

    def still_serves(self) -> None:
        before = len(self.app_log.packets)
        assert self.app.send(b"still here")
        wait_until(lambda: self.log.packets[-1:] == [(self.log.joined[0], b"still here")], "packets still go up")
        wait_until(lambda: self.server.publish(FEEDBACK, b"f") == 0, "there is room")
        wait_until(lambda: b"f" in self.app_log.packets[before:], "packets still come down")
        seq = self.app_log.seen[-1] + 1 if self.app_log.seen else 0
        self.server.publish_frame(header(seq), picture(header(seq)))
        wait_until(lambda: self.app_log.saw(seq), "frames still arrive")
        assert self.app_log.closings == []
        assert self.log.left == []


@pytest.fixture
def scene(caplog: pytest.LogCaptureFixture) -> Iterator[Scene]:
    with ExitStack() as ends:
        yield Scene(ends)
    raised = [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]
    assert raised == [], "no exception may leave the transport"


def garbage(seed: int) -> Iterator[tuple[bytes, bytes | None]]:
    """Yield payloads and attachments: none at all, random, and nearly right."""
    rng = random.Random(seed)
    number = packets.number(1)
    for size in (0, 1, 7, 8, 9, 16, 24, 100, 5000):
        yield rng.randbytes(size), None
        yield rng.randbytes(size), rng.randbytes(size)
        yield rng.randbytes(size), number
    yield bytes(MAX_PACKET + 1), number
    for packet in (packets.subscribe("x", True), packets.seen("x", 2**63), packets.taken("", 2**63), packets.bye("x")):
        yield packet[:-1], number
        yield packet + b"\0", number
    yield packets.seen("video/front", 2**64 - 1), packets.number(0)


def test_garbage_on_every_key(scene: Scene) -> None:
    other = layout.new_id()
    keys = [
        *(layout.upward(way, "alpha", "anyone", other) for way in (layout.ASK, layout.ORDER, layout.COMMAND)),
        *(f"{layout.ROOT}/alpha/{way}/*/*" for way in (layout.ASK, layout.ORDER, layout.COMMAND)),
        *(f"{layout.ROOT}/alpha/ask/{who}" for who in ("anyone/x", f"*/{scene.id}", f"mallory/{scene.id}")),
        layout.to("alpha", scene.id),
        layout.topic("alpha", FEEDBACK),
        layout.video("alpha", FRONT),
        layout.video_for("alpha", FRONT, "", scene.id),
        f"{layout.ROOT}/**",
    ]
    for number, key in enumerate(keys):
        for payload, attachment in garbage(number):
            scene.intruder.put(key, payload, attachment=attachment)
            scene.intruder.delete(key)
    scene.still_serves()
    assert scene.server.strays > 0


def test_garbage_on_an_applications_key_is_passed_on_as_garbage(scene: Scene) -> None:
    """Without keys, anybody can send as anybody; the handler judges the packets."""
    key = layout.upward(layout.ASK, "alpha", "anyone", scene.id)
    scene.intruder.put(key, b"nonsense", attachment=packets.number(0))
    wait_until(lambda: scene.log.packets, "it arrived")
    assert scene.log.packets == [(scene.log.joined[0], b"nonsense")]
    scene.still_serves()


def test_a_handler_that_fails_on_a_refusal_keeps_serving_applications(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told: list[str] = []

    def refused(_peer: Peer, reason: str) -> None:
        told.append(reason)
        raise RuntimeError("in the handler")

    monkeypatch.setattr(scene.log, "refused", refused)
    key = layout.upward(layout.COMMAND, "alpha", "anyone", layout.new_id())

    def seen() -> list[str]:
        scene.intruder.put(key, encode(Command(1, 0, 1, 0, Takeoff())), attachment=packets.number(1))
        return told

    wait_until(seen, "it is notified of commands without a connection")
    scene.still_serves()
    assert any("checking the connections" in record.getMessage() for record in caplog.records)
    caplog.clear()


def test_a_silent_application_is_dropped_and_counted(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ServerConnection, "stalled_s", lambda _connection, _now: STALLED_S + 1.0)
    wait_until(lambda: scene.log.left, "it is disconnected")
    assert "it acknowledged nothing for 3 s" in str(scene.log.left)
    assert scene.server.counters["network.dropped"] == 1


def test_with_a_longer_lease_both_ends_wait_longer_for_acknowledgements(monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as ends:
        scene = Scene(ends, LEASE_S + 2.0)
        stalled_s, looked = [STALLED_S + 1.9], threading.Event()

        def stalled(connection: ServerConnection, now_s: float) -> float:
            looked.set()
            return stalled_s[0]

        monkeypatch.setattr(ServerConnection, "stalled_s", stalled)
        assert looked.wait(10)
        scene.still_serves()
        monkeypatch.setattr(Outgoing, "stalled_s", lambda _outgoing, _now: CLIENT_STALLED_S + 1.9)
        scene.still_serves()
        stalled_s[0] = STALLED_S + 2.1
        wait_until(lambda: scene.log.left, "it is disconnected")


def test_unknown_topics_are_refused_and_leave_nothing(scene: Scene) -> None:
    before = threading.active_count()
    made_up = [video(f"made-up-{number}") for number in range(20)]
    scene.log.problems.update(dict.fromkeys(made_up, "no such camera"))
    for topic in made_up:
        scene.app.subscribe(topic)
    wait_until(lambda: len(scene.log.complaints) == len(made_up), "the handler was notified of each")
    assert set(scene.log.complaints) == {(scene.log.joined[0], "no such camera")}
    assert threading.active_count() <= before
    assert list(scene.server._publisher.video._variants) == [FRONT]
    for topic in made_up:
        scene.app.subscribe(topic, False)
    for number in range(3):  # existing topics, by names that applications choose
        topic = results(f"detector-{number}")
        scene.app.subscribe(topic)
        wait_until(lambda: scene.server.subscribers(topic), "it is subscribed to")  # noqa: B023
        assert scene.server.publish(topic, b"found") == 0
        wait_until(lambda: scene.app_log.packets[-1:] == [b"found"], "it arrived")
        scene.app_log.packets.clear()
        scene.app.subscribe(topic, False)
        wait_until(lambda: not scene.server.subscribers(topic), "it is unsubscribed")  # noqa: B023
    assert not any(
        topic.startswith(results(""))
        for topic in (*scene.server._publisher._publishers, *scene.server._publisher._numbers)
    )
    scene.still_serves()


def test_tokens_and_queries_of_strangers(scene: Scene) -> None:
    held = [
        scene.intruder.liveliness().declare_token(f"{layout.ROOT}/alpha/{rest}")
        for rest in ("app/x", "app/anyone/zz", "app/a/b/c", f"app/anyone/{layout.new_id()}", "alive/zz", "alive/a/b")
    ]
    for payload in (b"", b"\xc1", b"\x93\x01\x02\x03", packets.encode_own(packets.Join(1, "zz"))):
        for key in (
            layout.join("alpha", "anyone", layout.new_id()),
            f"{layout.ROOT}/alpha/join/*/*",
            f"{layout.ROOT}/alpha/join/x/y",
            f"{layout.ROOT}/alpha/info",
            f"{layout.ROOT}/**",
        ):
            replies = scene.intruder.get(key, payload=payload, timeout=0.2)
            assert all("welcome" not in str(reply) for reply in replies)
    for token in held:
        token.undeclare()  # type: ignore[no-untyped-call]
    scene.still_serves()
    assert len(scene.log.joined) == 1


def test_another_revision_is_refused_with_the_reason(scene: Scene) -> None:
    wish = packets.Join(99, scene.server._run)
    (reply,) = scene.intruder.get(
        layout.join("alpha", "anyone", layout.new_id()), payload=packets.encode_own(wish), timeout=2
    )
    assert reply.err is not None
    assert "revision 99" in reply.err.payload.to_string()


def test_an_application_without_a_token_is_dropped(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyloop.network.registry.CONFIRM_S", 0.1)
    wish = packets.encode_own(packets.Join(packets.REVISION, scene.server._run))
    (reply,) = scene.intruder.get(layout.join("alpha", "anyone", layout.new_id()), payload=wish, timeout=2)
    assert reply.ok is not None
    wait_until(lambda: len(scene.log.left) == 1, "the silent one was disconnected")
    assert scene.log.left[0][0] == scene.log.joined[1]
    assert "token" in scene.log.left[0][1]


TAKEOFF = encode(Command(1, 1, 1, 1, Takeoff()))
RELEASE = encode(Request(1, ReleaseAuthority()))


@pytest.mark.parametrize(("way", "packet"), [(layout.ASK, TAKEOFF), (layout.ORDER, TAKEOFF), (layout.ASK, RELEASE)])
def test_a_key_of_a_lesser_right_does_not_carry_greater_requests(scene: Scene, way: str, packet: bytes) -> None:
    scene.intruder.put(layout.upward(way, "alpha", "anyone", scene.id), packet, attachment=packets.number(0))
    wait_until(lambda: scene.log.refusals, "it was refused")
    assert scene.server.refused == 1
    assert scene.log.packets == []
    scene.still_serves()


@pytest.mark.parametrize(
    ("way", "packet"),
    [(layout.COMMAND, TAKEOFF), (layout.ORDER, RELEASE), (layout.ASK, encode(Request(1, Hello("me"))))],
)
def test_the_application_sends_each_packet_by_its_key(scene: Scene, way: str, packet: bytes) -> None:
    came: list[str] = []
    scene.intruder.declare_subscriber(
        f"{layout.ROOT}/alpha/*/anyone/*", lambda sample: came.append(str(sample.key_expr))
    )
    wait_until(lambda: scene.app.send(packet) and scene.log.packets[-1:] == [(scene.log.joined[0], packet)], "arrived")
    key = layout.upward(way, "alpha", "anyone", scene.id)
    # Resent: the application may not have known of the subscriber yet.
    wait_until(lambda: scene.app.send(packet) and key in came, f"it came by the key {way}")


def test_packets_of_another_proxy_of_the_same_name_are_ignored(scene: Scene) -> None:
    forged = packets.published(b"\1" * 8, 10**6)
    frame = packets.frame(b"\1" * 8, 10**6, encode(header(1)))
    for _ in range(20):
        scene.intruder.put(layout.topic("alpha", FEEDBACK), b"forged", attachment=forged)
        scene.intruder.put(layout.video("alpha", FRONT), picture(header(1)).tobytes(), attachment=frame)
    scene.still_serves()
    assert b"forged" not in scene.app_log.packets


def test_inconsistent_frames_are_ignored(scene: Scene) -> None:
    sends: list[Callable[[], None]] = []
    key = layout.video("alpha", FRONT)
    for said, sent in ((header(5), b""), (header(5), bytes(10)), (header(5, 16384, 16384), bytes(10))):
        attachment = packets.frame(scene.run, 10**6, encode(said))
        sends.append(lambda attachment=attachment, sent=sent: scene.intruder.put(key, sent, attachment=attachment))  # type: ignore[misc]
    for send in sends:
        send()
    scene.still_serves()
