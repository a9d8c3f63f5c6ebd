"""Observers that request less feedback, over each transport: the samples they get, and the state of their link."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from skyloop.client import Drone
from skyloop.client.drone import open_drone
from skyloop.clock import monotonic_ns
from skyloop.errors import NoAnswerError, UsageError
from skyloop.messages import Feedback, FlightState, LinkState, Overview
from skyloop.network import FabricServer, FabricSettings
from skyloop.network import dial as dial_fabric
from skyloop.network.config import free_port
from skyloop.proxy import Proxy
from skyloop.transport.base import FEEDBACK, OVERVIEW, Dialer, TransportServer
from skyloop.transport.local import LocalServer
from skyloop.transport.local import dial as dial_local
from skyloop.transport.memory import MemoryServer
from skyloop.transport.testing import wait_until
from tests.support.proxy_bench import FakeDriver
from tests.support.scripted_proxy import QUICK, WAIT_S, ScriptedProxy, scripted


def _memory() -> tuple[TransportServer, Dialer]:
    server = MemoryServer("rates")
    return server, server.dial


def _local() -> tuple[TransportServer, Dialer]:
    return LocalServer("rates"), dial_local("rates")


def _fabric() -> tuple[TransportServer, Dialer]:
    place = (f"127.0.0.1:{free_port('127.0.0.1')}",)
    server = FabricServer("rates", FabricSettings(listen=place, multicast=False))
    return server, dial_fabric("rates", FabricSettings(connect=place, multicast=False))


class Beating:
    """A proxy whose vehicle reports 100 times a second."""

    def __init__(self, server: TransportServer) -> None:
        self.server = server
        self.driver = FakeDriver(monotonic_ns)
        self.proxy = Proxy(self.driver, server, name="rates")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat)

    def __enter__(self) -> Beating:
        self.proxy.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self.proxy.end()

    def _beat(self) -> None:
        while not self._ended.wait(0.01):
            self.driver.report()


@pytest.fixture(params=[_memory, _local, _fabric], ids=["memory", "local", "fabric"])
def transport(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[TransportServer, Dialer]]:
    with TemporaryDirectory(prefix="skyloop-") as directory:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(directory) / "run"))
        yield request.param()


def test_an_observer_gets_the_rate_its_consumers_request_and_its_link_is_up(
    transport: tuple[TransportServer, Dialer],
) -> None:
    server, dial = transport
    got: list[Feedback] = []
    fast: list[Feedback] = []
    with Beating(server), open_drone(dial, app="eye", access="observe") as drone:
        assert server.subscribers(FEEDBACK) == 1
        with drone.on_feedback(got.append, inline=True, max_hz=10):
            topic = "feedback?max_hz=10"
            wait_until(lambda: server.subscribers(topic) == 1 and not server.subscribers(FEEDBACK), "it is narrowed")
            wait_until(lambda: len(got) >= 5, "samples come")
            before = drone.stats["feedback"].count
            wait_until(lambda: len(got) >= 10, "samples come")
            assert drone.stats["feedback"].count - before <= 7, "more were sent than requested"
            wait_until(lambda: drone.link.application is LinkState.UP, "the link is up")
            with drone.on_feedback(fast.append, max_hz=50):
                both = "feedback?max_hz=50"
                wait_until(lambda: server.subscribers(both) == 1 and not server.subscribers(topic), "for both")
                wait_until(lambda: len(fast) >= 10, "samples come")
            wait_until(lambda: server.subscribers(topic) == 1, "narrowed again")
        wait_until(lambda: server.subscribers(FEEDBACK) == 1, "all again, as nobody asks for less")
        wait_until(lambda: drone.feedback().skipped == 0, "whole")
        assert drone.stats["feedback"].lost == 0 or isinstance(server, FabricServer)  # the fabric sends it as datagrams
    assert {(sample.battery, sample.altitude_m) for sample in (*got, *fast)} == {(0.9, 1.0)}
    for one, other in itertools.pairwise(got):
        assert other.published_ns - one.published_ns > 0.05e9


def test_reading_counts_as_a_consumer_and_waiting_needs_all_samples() -> None:
    server, dial = _memory()
    with Beating(server) as beating, open_drone(dial, app="eye", access="observe") as drone:
        assert drone.feedback(max_hz=2).altitude_m == 1.0
        slow = "feedback?max_hz=2"
        wait_until(lambda: server.subscribers(slow) == 1 and not server.subscribers(FEEDBACK), "it is narrowed")
        assert drone.next_feedback(WAIT_S, max_hz=2).battery == 0.9
        waiting = threading.Thread(target=drone.wait, args=("flying", WAIT_S))
        waiting.start()
        wait_until(lambda: server.subscribers(FEEDBACK) == 1, "all while it waits")
        beating.driver.report(state=FlightState.FLYING)
        waiting.join(WAIT_S)
        wait_until(lambda: server.subscribers(slow) == 1 and not server.subscribers(FEEDBACK), "it is narrowed again")
        findings = drone.preflight(video_s=0.0)
        assert findings
        assert drone.next_feedback(WAIT_S).battery == 0.9
        wait_until(lambda: server.subscribers(FEEDBACK) == 1 and not server.subscribers(slow), "all, for good")


def test_a_pilot_gets_all_samples_and_its_consumers_the_rate_they_request() -> None:
    server, dial = _memory()
    got: list[Feedback] = []
    with (
        Beating(server),
        open_drone(dial, app="pilot") as drone,
        drone.on_feedback(got.append, max_hz=20),
    ):
        wait_until(lambda: len(got) >= 5, "samples come")
        assert server.subscribers(FEEDBACK) == 1
        assert drone.feedback().altitude_m == 1.0
    assert {sample.battery for sample in got} == {0.9}
    assert {sample.owner for sample in got} <= {None, "pilot"}
    for one, other in itertools.pairwise(got):
        assert other.published_ns - one.published_ns > 0.02e9


def test_invalid_rates_are_refused() -> None:
    server, dial = _memory()
    with Beating(server), open_drone(dial, app="eye", access="observe") as drone:
        calls: list[Callable[[], object]] = [
            lambda: drone.feedback(max_hz=0),
            lambda: drone.next_feedback(max_hz=float("nan")),
            lambda: drone.on_feedback(print, max_hz=-1),
        ]
        for call in calls:
            with pytest.raises(UsageError, match="max_hz is"):
                call()
        assert server.subscribers(FEEDBACK) == 1


@contextmanager
def _observing(proxy: ScriptedProxy) -> Iterator[Drone]:
    with open_drone(proxy.server.dial, app="eye", access="observe", policy=QUICK) as drone:
        yield drone


def test_a_proxy_of_an_earlier_version_sends_all_samples_and_the_client_drops_the_rest() -> None:
    got: list[Feedback] = []
    with scripted() as proxy, _observing(proxy) as drone:
        # It publishes nothing on the requested topic, but still answers pings.
        with drone.on_feedback(got.append, max_hz=4):
            wait_until(lambda: proxy.server.subscribers("feedback?max_hz=4") == 1, "it is asked for")
            wait_until(lambda: proxy.server.subscribers(FEEDBACK) == 1, "plain feedback instead")
            wait_until(lambda: len(got) >= 3, "samples come")
            wait_until(lambda: drone.link.application is LinkState.UP, "the link is up")
            with drone.on_feedback(got.append, max_hz=8):
                assert proxy.server.subscribers("feedback?max_hz=8") == 0, "it is not requested again"
        assert proxy.server.subscribers(FEEDBACK) == 1
        newest = drone.feedback()
        wait_until(lambda: drone.feedback().seq > newest.seq + 3, "all come")
    assert got[1].published_ns - got[0].published_ns > 0.15e9


def test_another_connection_requests_the_same_rate() -> None:
    server, dial = _memory()
    with Beating(server), open_drone(dial, app="eye", access="observe", policy=QUICK) as drone:
        got: list[Feedback] = []
        with drone.on_feedback(got.append, max_hz=20):
            wait_until(lambda: server.subscribers("feedback?max_hz=20") == 1, "it is narrowed")
            session = drone._connection.session
            assert session is not None
            assert session._end is not None
            session._end.close()
            wait_until(lambda: drone._connection.session not in (None, session), "another session")
            wait_until(lambda: server.subscribers("feedback?max_hz=20") == 1, "asked for in it")
            count, now_ns = len(got), time.monotonic_ns()
            wait_until(lambda: len(got) > count and got[-1].published_ns > now_ns, "samples come again")
            assert server.subscribers(FEEDBACK) == 0


def test_the_overview_is_sent_on_request(transport: tuple[TransportServer, Dialer]) -> None:
    server, dial = transport
    got: list[Overview] = []
    with Beating(server), open_drone(dial, app="eye", access="observe") as drone:
        assert server.subscribers(OVERVIEW) == 0
        with drone.on_overview(got.append):
            wait_until(lambda: bool(got), "one comes at once")
        wait_until(lambda: server.subscribers(OVERVIEW) == 0, "nobody asks for it")
        (row,) = drone.overview(WAIT_S).vehicles
        assert (row.name, row.battery, row.state) == ("rates", 0.9, FlightState.LANDED)
        wait_until(lambda: server.subscribers(OVERVIEW) == 1, "it is kept")


def test_a_proxy_that_sends_no_overview() -> None:
    words = "older proxies send none"
    with scripted() as proxy, _observing(proxy) as drone, pytest.raises(NoAnswerError, match=words):
        drone.overview(0.05)
