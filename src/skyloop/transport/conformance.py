"""Conformance tests for transports. Subclass :class:`TransportSuite` in your tests and provide your two ends.

::

    class TestMyTransport(TransportSuite):
        def make_server(self) -> TransportServer:
            return MyServer(...)

        def dialer(self, server: TransportServer) -> Dialer:
            return my_dialer(server.address)

Run it with pytest, and once more under load if you can.
"""

from __future__ import annotations

import random
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

from skyloop.errors import LinkError, UsageError
from skyloop.transport.base import FEEDBACK, MAX_PACKET, MAX_TOPIC, Dialer, Peer, Pixels, TransportServer, video
from skyloop.transport.testing import (
    FRONT,
    ClientLog,
    Joined,
    ServerLog,
    header,
    picture,
    raises,
    resources,
    wait_until,
)


class TransportSuite(ABC):
    """The contract in :mod:`skyloop.transport.base` as tests. pytest collects the tests that a subclass inherits."""

    @abstractmethod
    def make_server(self) -> TransportServer:
        """Return a new transport server that has not been started."""

    @abstractmethod
    def dialer(self, server: TransportServer) -> Dialer:
        """Return a dialer to a server from :meth:`make_server`, whether or not the server is running.

        It raises :class:`skyloop.errors.LinkError` or :class:`skyloop.errors.UnknownNameError` while the server does
        not run.
        """

    @contextmanager
    def serving(self) -> Iterator[tuple[TransportServer, ServerLog]]:
        """Yield a started server and its handler's log, and stop the server at the end."""
        server, log = self.make_server(), ServerLog()
        server.start(log)
        try:
            yield server, log
        finally:
            server.stop()

    @contextmanager
    def connected(self, server: TransportServer, log: ServerLog, *topics: str, keep: bool = True) -> Iterator[Joined]:
        """Yield a joined, subscribed client, and close it at the end. ``keep``: its log keeps frames."""
        client_log = ClientLog(keep=keep)
        known = len(log.joined)
        before = {topic: server.subscribers(topic) for topic in topics}
        client = self.dialer(server)(client_log)
        try:
            wait_until(lambda: len(log.joined) > known, "the client joined")
            for topic in topics:
                client.subscribe(topic)
            wait_until(lambda: all(server.subscribers(t) > before[t] for t in topics), "its topics are subscribed")
            yield Joined(client, client_log, log.joined[known])
        finally:
            client_log.gate.set()
            client.close()
            if len(log.joined) > known:
                wait_until(lambda: log.joined[known] in [peer for peer, _ in log.left], "the server saw it leave")

    # --- packets ---

    def test_packets_arrive_whole_and_in_order(self) -> None:
        sent = [bytes([n % 256]) * size for n, size in enumerate((1, 2, 5, 11, 12, 13, 100, 4096, MAX_PACKET, 1))]
        with self.serving() as (server, log), self.connected(server, log) as app:
            for packet in sent:
                wait_until(partial(app.client.send, packet), "the packet fits")
            wait_until(lambda: len(log.packets) == len(sent), "the server got all packets")
            assert log.from_peer(app.peer) == sent
            for packet in sent:
                wait_until(partial(server.send, app.peer, packet), "the packet fits")
            wait_until(lambda: len(app.log.packets) == len(sent), "the client got all packets")
            assert app.log.packets == sent

    def test_garbage_passes_through_untouched(self) -> None:
        rng = random.Random(7)
        sent = [rng.randbytes(rng.randrange(1, 200)) for _ in range(300)] + [b"SKYL", b"SKYL\x01\x7f", b"\0" * 12]
        with self.serving() as (server, log), self.connected(server, log) as app:
            for packet in sent:
                wait_until(partial(app.client.send, packet), "the packet fits")
            wait_until(lambda: len(log.packets) == len(sent), "all packets arrived")
            assert log.from_peer(app.peer) == sent

    def test_packets_that_cannot_be_sent_are_refused(self) -> None:
        with self.serving() as (server, log), self.connected(server, log, FEEDBACK) as app:
            for wrong in (b"", bytes(MAX_PACKET + 1)):
                raises(UsageError, partial(app.client.send, wrong))
                raises(UsageError, partial(server.send, app.peer, wrong))
                raises(UsageError, partial(server.publish, FEEDBACK, wrong))
            assert app.client.send(b"still here")
            wait_until(lambda: log.packets, "a good packet arrived")
            assert log.from_peer(app.peer) == [b"still here"]

    def test_each_application_has_its_own_connection(self) -> None:
        with self.serving() as (server, log), self.connected(server, log) as one, self.connected(server, log) as two:
            assert one.peer.id != two.peer.id
            assert one.client.send(b"from one")
            assert two.client.send(b"from two")
            assert server.send(two.peer, b"to two")
            wait_until(lambda: len(log.packets) == 2 and two.log.packets, "all packets arrived")
            assert log.from_peer(one.peer) == [b"from one"]
            assert two.log.packets == [b"to two"]
            assert one.log.packets == []

    def test_several_threads_may_send_at_once(self) -> None:
        with self.serving() as (server, log), self.connected(server, log) as app:

            def send(thread: int) -> None:
                for number in range(50):
                    packet = bytes((thread, number))
                    wait_until(partial(app.client.send, packet), "the packet fits")

            threads = [threading.Thread(target=send, args=(thread,)) for thread in range(4)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            wait_until(lambda: len(log.packets) == 200, "all packets arrived")
            for number in range(4):
                assert [p[1] for p in log.from_peer(app.peer) if p[0] == number] == list(range(50))

    # --- topics ---

    def test_only_subscribers_are_sent_a_topic(self) -> None:
        with (
            self.serving() as (server, log),
            self.connected(server, log, FEEDBACK) as one,
            self.connected(server, log) as two,
        ):
            assert server.publish(FEEDBACK, b"1") == 0
            assert server.publish("nobody", b"x") == 0
            wait_until(lambda: one.log.packets, "a packet published before the subscription is not sent later")
            two.client.subscribe(FEEDBACK)
            wait_until(lambda: server.subscribers(FEEDBACK) == 2, "both are subscribed")
            assert server.publish(FEEDBACK, b"2") == 0
            wait_until(lambda: len(one.log.packets) == 2, "it arrived before the client unsubscribed")
            one.client.subscribe(FEEDBACK, False)
            wait_until(lambda: server.subscribers(FEEDBACK) == 1, "one has unsubscribed")
            assert server.publish(FEEDBACK, b"3") == 0
            wait_until(lambda: len(one.log.packets) == 2 and len(two.log.packets) == 2, "all packets arrived")
            assert one.log.packets == [b"1", b"2"]
            assert two.log.packets == [b"2", b"3"]

    def test_a_topic_has_a_longest_name(self) -> None:
        with self.serving() as (server, log), self.connected(server, log, "é" * MAX_TOPIC) as app:
            raises(UsageError, lambda: app.client.subscribe("x" * (MAX_TOPIC + 1)))
            raises(UsageError, lambda: app.client.subscribe(""))

    # --- frames ---

    def test_frames_arrive_intact(self) -> None:
        with self.serving() as (server, log), self.connected(server, log, video(FRONT), keep=False) as app:
            for seq in range(60):
                server.publish_frame(header(seq), picture(header(seq)))
                wait_until(partial(app.log.saw, seq), "the frame arrived")
            assert app.log.torn == []

    def test_frames_are_flat_read_only_and_of_any_size(self) -> None:
        heads = [header(n, *size) for n, size in enumerate(((1, 1), (640, 480), (32, 24), (33, 25), (320, 240)))]
        with self.serving() as (server, log), self.connected(server, log, video(FRONT)) as app:
            for head in heads:
                pixels = picture(head).reshape(head.height, head.width, 3)
                server.publish_frame(head, pixels)
                pixels[:] = 0  # the caller may reuse it
                wait_until(partial(app.log.saw, head.seq), "the frame arrived")
            for head, (got, pixels) in zip(heads, app.log.frames, strict=True):
                assert got == head
                assert pixels.ndim == 1
                assert pixels.size == head.size
                assert pixels.dtype == np.uint8
                assert not pixels.flags.writeable
                assert np.array_equal(pixels, picture(head))

    def test_pixels_that_do_not_fit_their_header_are_refused(self) -> None:
        with self.serving() as (server, log), self.connected(server, log, video(FRONT)):
            head = header(1)
            for wrong in (picture(head)[:-1], np.zeros((head.height, head.width * 2, 3), np.uint8)[:, ::2]):
                raises(UsageError, partial(server.publish_frame, head, wrong))

    def test_frames_in_use_are_never_overwritten(self) -> None:
        with self.serving() as (server, log), self.connected(server, log, video(FRONT)) as app:
            views: dict[int, Pixels] = {}
            for seq in range(40):
                server.publish_frame(header(seq), picture(header(seq)))
                wait_until(partial(app.log.saw, seq), "the frame arrived, whatever views are kept")
                head, pixels = app.log.frames.pop()
                if seq % 4 == 0:  # only a view of a view keeps the frame alive
                    views[head.seq] = pixels.reshape(head.height, head.width, 3)[::2, 1::2]
                del pixels
            app.client.close()
            for seq, view in views.items():
                assert np.array_equal(view, picture(header(seq)).reshape(24, 32, 3)[::2, 1::2]), seq

    def test_a_slow_reader_costs_only_itself(self) -> None:
        topics = (FEEDBACK, video(FRONT))
        with (
            self.serving() as (server, log),
            self.connected(server, log, *topics) as slow,
            self.connected(server, log, *topics, keep=False) as fast,
        ):
            slow.log.gate.clear()
            missed = 0
            for seq in range(800):
                packet = seq.to_bytes(4, "little") * 75
                missed += server.publish(FEEDBACK, packet)
                missed += server.publish_frame(header(seq), picture(header(seq)))
                wait_until(partial(fast.log.saw, seq), "the fast reader got the frame")
            assert fast.log.torn == []
            wait_until(lambda: len(fast.log.packets) == 800, "the packets arrived, possibly over another channel")
            assert [int.from_bytes(p[:4], "little") for p in fast.log.packets] == list(range(800))
            assert missed > 0, "the backlog of a stalled reader must be bounded"
            slow.log.gate.set()
            wait_until(lambda: server.publish(FEEDBACK, b"new") == 0, "the slow reader is served again")
            wait_until(lambda: slow.log.packets[-1:] == [b"new"], "the packet arrived")
            last = header(800)
            wait_until(lambda: server.publish_frame(last, picture(last)) == 0, "the slow reader gets frames again")
            wait_until(lambda: slow.log.seen[-1:] == [800], "the newest frame arrived")
            for head, pixels in slow.log.frames:
                assert np.array_equal(pixels, picture(head)), head.seq

    def test_the_newest_frame_waits_for_a_slow_reader(self) -> None:
        with self.serving() as (server, log), self.connected(server, log, video(FRONT)) as slow:
            slow.log.gate.clear()
            missed = [server.publish_frame(header(seq), picture(header(seq))) for seq in range(30)]
            assert missed[0] == 0
            assert missed[-1] == 1
            slow.log.gate.set()
            wait_until(lambda: slow.log.seen[-1:] == [29], "the newest frame arrived without a later one")
            assert slow.log.seen == sorted(slow.log.seen)

    # --- ends ---

    def test_a_missing_server_is_a_link_error(self) -> None:
        server = self.make_server()
        raises(LinkError, lambda: self.dial_or_link_error(server))
        server.stop()

    def dial_or_link_error(self, server: TransportServer) -> None:
        """Dial, and convert the other valid error for an unknown name (``UsageError``) to ``LinkError``."""
        try:
            self.dialer(server)(ClientLog())
        except UsageError as error:
            raise LinkError(str(error)) from error

    def test_close_notifies_both_ends_once(self) -> None:
        with self.serving() as (server, log), self.connected(server, log, FEEDBACK) as app:
            assert app.client.send(b"last words")
            app.client.close()
            assert len(app.log.closings) == 1, "closed() is called before close() returns"
            app.client.close()
            wait_until(lambda: log.left, "the server was notified")
            assert log.from_peer(app.peer) == [b"last words"]
            assert [peer for peer, _ in log.left] == [app.peer]
            assert log.left[0][1]
            assert not app.client.send(b"x")
            assert not server.send(app.peer, b"x")
            assert server.publish(FEEDBACK, b"x") == 0
            assert server.subscribers(FEEDBACK) == 0
            server.disconnect(app.peer, "twice")
            app.client.subscribe(FEEDBACK)
        assert len(app.log.closings) == 1
        assert len(log.left) == 1

    def test_disconnect_tells_both_ends_why(self) -> None:
        with self.serving() as (server, log), self.connected(server, log) as app, self.connected(server, log) as other:
            server.disconnect(app.peer, "because of this")
            wait_until(lambda: app.log.closings and log.left, "both ends were notified")
            assert log.left == [(app.peer, "because of this")]
            assert app.log.closings == ["because of this"]
            assert other.client.send(b"still here")
            wait_until(lambda: log.from_peer(other.peer), "the other one is unaffected")

    def test_stop_notifies_every_client(self) -> None:
        with self.serving() as (server, log):
            with self.connected(server, log) as one, self.connected(server, log) as two:
                assert server.send(one.peer, b"goodbye")
                server.stop()
                server.stop()
                wait_until(lambda: one.log.closings and two.log.closings, "both were notified")
                assert one.log.packets == [b"goodbye"], "packets sent before the stop still arrive"
                assert one.log.closings[0]
                assert not one.client.send(b"x")
            assert sorted(peer.id for peer, _ in log.left) == [one.peer.id, two.peer.id]
            assert one.log.closings[1:] == []

    def test_a_raising_server_handler_ends_its_own_connection_only(self) -> None:
        def fail(_: Peer, packet: bytes) -> None:
            if packet == b"bad":
                raise RuntimeError("on purpose")

        with self.serving() as (server, log), self.connected(server, log) as bad, self.connected(server, log) as good:
            log.on_packet = fail
            assert bad.client.send(b"bad")
            wait_until(lambda: bad.log.closings and log.left, "both ends were notified")
            assert "on purpose" in log.left[0][1]
            assert good.client.send(b"good")
            wait_until(lambda: log.from_peer(good.peer) == [b"good"], "the other one is unaffected")
            assert good.log.closings == []

    def test_a_raising_client_handler_ends_its_own_connection_only(self) -> None:
        def fail(_: bytes) -> None:
            raise RuntimeError("on purpose")

        with (
            self.serving() as (server, log),
            self.connected(server, log, FEEDBACK) as bad,
            self.connected(server, log, FEEDBACK) as good,
        ):
            bad.log.on_packet = fail
            assert server.publish(FEEDBACK, b"x") == 0
            wait_until(lambda: bad.log.closings and log.left, "both ends were notified")
            assert "on purpose" in bad.log.closings[0]
            wait_until(lambda: server.subscribers(FEEDBACK) == 1, "the failed client is gone")
            assert server.publish(FEEDBACK, b"y") == 0
            wait_until(lambda: good.log.packets == [b"x", b"y"], "the other one is unaffected")

    def test_ends_may_be_closed_from_inside_their_handlers(self) -> None:
        with self.serving() as (server, log), self.connected(server, log) as app, self.connected(server, log) as other:
            app.log.on_packet = lambda _: app.client.close()
            assert server.send(app.peer, b"x")
            wait_until(lambda: app.log.closings and log.left, "both ends were notified")
            log.on_packet = lambda _, __: server.stop()
            assert other.client.send(b"x")
            wait_until(lambda: other.log.closings and len(log.left) == 2, "all ends were notified")

    def test_coming_and_going_leaves_nothing_behind(self) -> None:
        with self.serving() as (server, log):
            with self.connected(server, log, video(FRONT)):
                server.publish_frame(header(0), picture(header(0)))
            wait_until(lambda: len(log.left) == 1, "it left")
            before = resources()
            for seq in range(50):
                with self.connected(server, log, video(FRONT), FEEDBACK) as app:
                    server.publish_frame(header(seq), picture(header(seq)))
                    server.publish(FEEDBACK, b"x")
                    if seq % 2:
                        server.disconnect(app.peer, "on purpose")
            wait_until(lambda: len(log.left) == 51, "all left")
            assert sum(server.subscribers(topic) for topic in (video(FRONT), FEEDBACK)) == 0
            del app
            wait_until(lambda: resources() <= before, f"resources return to {before} from {resources()}")
