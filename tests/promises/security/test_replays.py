"""Recorded bytes of the command channel, sent again: refused on every transport, with an event that says why.

A pilot's emergency stop, the only command accepted whatever its number, age and lease, is tested here too.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skyloop.messages import Command, EmergencyStop, EventKind, Hover, Refusal, Role, Velocity, encode
from skyloop.network import FabricServer, FabricSettings
from skyloop.network import dial as fabric_dial
from skyloop.network.config import free_port
from skyloop.network.delivery import RECENT_PACKETS
from skyloop.transport.base import Dialer, TransportServer
from skyloop.transport.local import LocalServer
from skyloop.transport.local import dial as local_dial
from skyloop.transport.memory import MemoryServer
from skyloop.transport.testing import wait_until
from tests.support.proxy_bench import App, Bench


def memory() -> tuple[TransportServer, Dialer]:
    server = MemoryServer("bench")
    return server, server.dial


def local() -> tuple[TransportServer, Dialer]:
    return LocalServer("bench"), local_dial("bench")


def fabric() -> tuple[TransportServer, Dialer]:
    place = f"127.0.0.1:{free_port('127.0.0.1')}"
    server = FabricServer("bench", FabricSettings(listen=(place,), multicast=False))
    return server, fabric_dial("bench", FabricSettings(connect=(place,), multicast=False))


@pytest.fixture(params=[memory, local, fabric], ids=lambda make: make.__name__)
def bench(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    make: Callable[[], tuple[TransportServer, Dialer]] = request.param
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        with Bench(transport=make()) as bench:
            yield bench


_numbers = itertools.count()


def fly(bench: Bench, pilot: App) -> Command:
    """Have a pilot's command executed, which the attacker records. No two commands are alike, so the executed one is
    known, even if datagrams are lost or overtaken."""
    sent: list[Command] = []

    def executed() -> bool:
        sent.append(pilot.command(Velocity(0.25 + next(_numbers) / 10_000)))
        return wait_briefly(lambda: sent[-1].action in bench.driver.told)

    wait_until(executed, "the command is executed")
    return sent[-1]


def wait_briefly(condition: Callable[[], bool]) -> bool:
    """Whether it becomes true soon; if not, data sent by datagrams is sent again."""
    deadline = time.monotonic() + 0.3
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.001)
    return True


def send_until_refused(bench: Bench, sender: App, packet: bytes) -> str:
    """Send bytes over an application's connection; returns the published reason for their refusal."""
    before = len(bench.published(EventKind.COMMAND_REFUSED))

    def told() -> bool:
        assert sender.end.send(packet)
        return wait_briefly(lambda: len(bench.published(EventKind.COMMAND_REFUSED)) > before)

    wait_until(told, "the refusal is told")
    event = bench.published(EventKind.COMMAND_REFUSED)[before]
    assert event.app == sender.name
    assert event.text.startswith(f"{sender.name}: ")
    return str(event.data["reason"])


@pytest.fixture
def jane(bench: Bench) -> App:
    """The pilot."""
    return bench.airborne("jane")


def test_at_once_by_the_same_connection(bench: Bench, jane: App) -> None:
    """Where packets arrive by two paths, the transport recognises the second one as a duplicate, without an event."""
    recorded = fly(bench, jane)
    for _ in range(5):
        assert jane.end.send(encode(recorded))
    fly(bench, jane)
    assert bench.driver.told.count(recorded.action) == 1


def test_again_by_the_same_connection(bench: Bench, jane: App) -> None:
    recorded = fly(bench, jane)
    for _ in range(RECENT_PACKETS):
        fly(bench, jane)
    done = list(bench.driver.told)
    assert send_until_refused(bench, jane, encode(recorded)) == Refusal.OUT_OF_SEQUENCE
    assert bench.driver.told == done


def test_by_another_pilot_while_the_holder_flies(bench: Bench, jane: App) -> None:
    """The packet has the current lease, and is recent: it is the connection that is wrong."""
    recorded = fly(bench, jane)
    eve = bench.join("eve")
    done = list(bench.driver.told)
    assert send_until_refused(bench, eve, encode(recorded)) == Refusal.NO_AUTHORITY
    assert bench.driver.told == done


def test_by_an_observer(bench: Bench, jane: App) -> None:
    recorded = fly(bench, jane)
    olga = bench.join("olga", Role.OBSERVER)
    done = list(bench.driver.told)
    assert send_until_refused(bench, olga, encode(recorded)) == Refusal.OBSERVER
    assert bench.driver.told == done


def test_by_a_client_without_a_hello(bench: Bench, jane: App) -> None:
    recorded = fly(bench, jane)
    stranger = bench.stranger()
    stranger.name = f"application {jane.app_id + 1}"
    done = list(bench.driver.told)
    assert send_until_refused(bench, stranger, encode(recorded)) == Refusal.PROTOCOL
    assert bench.driver.told == done


def test_by_the_same_pilot_under_a_later_lease(bench: Bench, jane: App) -> None:
    recorded = fly(bench, jane)
    jane.end.close()
    wait_until(lambda: bench.published(EventKind.AUTHORITY_LOST), "jane has gone")
    again = bench.pilot("jane")
    done = list(bench.driver.told)
    assert again.lease != recorded.lease
    assert send_until_refused(bench, again, encode(recorded)) == Refusal.FOREIGN_LEASE
    assert bench.driver.told == done


def test_while_no_one_flies(bench: Bench, jane: App) -> None:
    recorded = fly(bench, jane)
    jane.end.close()
    wait_until(lambda: bench.published(EventKind.AUTHORITY_LOST), "jane has gone")
    eve = bench.join("eve")
    done = list(bench.driver.told)
    assert send_until_refused(bench, eve, encode(recorded)) == Refusal.FOREIGN_LEASE
    assert bench.driver.told == done


@pytest.mark.parametrize("late_s", [0.26, 3600.0])
def test_after_its_time(bench: Bench, jane: App, late_s: float) -> None:
    recorded = fly(bench, jane)
    done = list(bench.driver.told)
    bench.clock.advance(late_s)
    young = Command(recorded.seq + 1000, recorded.lease, recorded.intent, recorded.sent_ns, recorded.action)
    assert send_until_refused(bench, jane, encode(young)) == Refusal.STALE
    assert bench.driver.told == done


def test_before_its_time(bench: Bench, jane: App) -> None:
    recorded = fly(bench, jane)
    done = list(bench.driver.told)
    early = Command(recorded.seq + 1000, recorded.lease, recorded.intent, recorded.sent_ns + 10**9, recorded.action)
    assert send_until_refused(bench, jane, encode(early)) == Refusal.STALE
    assert bench.driver.told == done


def test_from_before_the_failsafe(bench: Bench, jane: App) -> None:
    """Recent, in sequence, with the right lease, but the pilot was silent after it was sent."""
    recorded = fly(bench, jane)
    bench.run(0.6)  # silence: the vehicle hovers
    assert bench.driver.told[-1] == Hover()
    done = list(bench.driver.told)
    repeat = Command(recorded.seq + 1000, recorded.lease, recorded.intent, bench.clock(), recorded.action)
    assert send_until_refused(bench, jane, encode(repeat)) == Refusal.NOT_FRESH
    assert bench.driver.told == done


def test_an_emergency_stop_of_any_pilot_is_taken_however_old(bench: Bench, jane: App) -> None:
    """On purpose: anyone who sees that something goes wrong must be able to stop it. So a recorded stop works, too."""
    fly(bench, jane)
    recorded = encode(Command(1, 99, 1, 1, EmergencyStop()))
    bob = bench.join("bob")

    def stopped() -> bool:
        assert bob.end.send(recorded)
        return wait_briefly(lambda: EmergencyStop() in bench.driver.told)

    wait_until(stopped, "the motors are stopped")
    olga = bench.join("olga", Role.OBSERVER)
    assert send_until_refused(bench, olga, recorded) == Refusal.OBSERVER
