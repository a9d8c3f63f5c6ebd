"""``drone.log``: entries sent, entries refused, and what callbacks receive."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from skyloop.client import Drone
from skyloop.errors import UsageError
from skyloop.messages import LogEntry, Severity, encode
from skyloop.messages.codec import MAX_BODY
from skyloop.messages.relayed import MAX_LOG_TEXT, MAX_VALUES
from skyloop.transport.base import LOGS
from tests.support.scripted_proxy import WAIT_S, ScriptedProxy, flown, scripted


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy) as drone:
        yield drone


def sent(proxy: ScriptedProxy, count: int) -> list[LogEntry]:
    proxy.until(lambda: len(proxy.others) >= count, f"{count} entries")
    return [entry for entry in proxy.others if isinstance(entry, LogEntry)]


def test_entries_are_sent(proxy: ScriptedProxy, drone: Drone) -> None:
    assert drone.log.text("found it")
    assert drone.log.text("look out", name="mode", severity="warning")
    assert drone.log.number("error", float(np.float32(0.25)))
    assert drone.log.numbers(range_m=1, bearing=-0.5)
    assert drone.log.array("grid", np.arange(6, dtype=np.int16).reshape(2, 3))
    assert drone.log.array("scalar", 4.0)
    entries = sent(proxy, 7)
    assert {entry.source for entry in entries} == {"me"}
    assert all(entry.at_ns > 0 for entry in entries)
    assert [(e.name, e.text, e.number, e.values, e.shape, e.severity) for e in entries] == [
        ("", "found it", None, None, (), Severity.INFO),
        ("mode", "look out", None, None, (), Severity.WARNING),
        ("error", None, 0.25, None, (), Severity.INFO),
        ("range_m", None, 1.0, None, (), Severity.INFO),
        ("bearing", None, -0.5, None, (), Severity.INFO),
        ("grid", None, None, (0.0, 1.0, 2.0, 3.0, 4.0, 5.0), (2, 3), Severity.INFO),
        ("scalar", None, None, (4.0,), (), Severity.INFO),
    ]


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda log: log.text(7), "strings of at most 4096"),
        (lambda log: log.text("x" * (MAX_LOG_TEXT + 1)), "strings of at most 4096"),
        (lambda log: log.text("x", severity="fatal"), "info, warning, error"),
        (lambda log: log.text("x", name="n" * 65), "1 to 64"),
        (lambda log: log.text("x", name=None), "1 to 64"),
        (lambda log: log.number("", 1.0), "1 to 64"),
        (lambda log: log.number(None, 1.0), "1 to 64"),
        (lambda log: log.number("n" * 65, 1.0), "1 to 64"),
        (lambda log: log.number("error", float("nan")), "error can't be nan"),
        (lambda log: log.number("error", "big"), "finite number"),
        (lambda log: log.number("error", 1j), "finite number"),
        (lambda log: log.numbers(good=1.0, bad=float("inf")), "bad can't be inf"),
        (lambda log: log.array("a", [0.0] * (MAX_VALUES + 1)), "has 4097 numbers"),
        (lambda log: log.array("a", np.zeros((1,) * 9)), "9 dimensions"),
        (lambda log: log.array("a", [1.0, float("nan")]), "not finite"),
        (lambda log: log.array("a", ["x"]), "array of real numbers"),
        (lambda log: log.array("a", [[1], [1, 2]]), "array of real numbers"),
        (lambda log: log.array("", [1]), "1 to 64"),
    ],
)
def test_invalid_entries(proxy: ScriptedProxy, drone: Drone, call: Any, match: str) -> None:
    with pytest.raises(UsageError, match=match):
        call(drone.log)
    assert proxy.others == []


def test_the_largest_entries_fit_into_a_packet(proxy: ScriptedProxy, drone: Drone) -> None:
    assert drone.log.array("n" * 64, [-1.2345e300] * MAX_VALUES)
    assert drone.log.text("\U0001f681" * MAX_LOG_TEXT, name="n" * 64)
    for entry in sent(proxy, 2):
        assert len(encode(entry)) < MAX_BODY


def test_listeners_get_every_applications_entries(proxy: ScriptedProxy, drone: Drone) -> None:
    got: list[LogEntry] = []
    entry = LogEntry("other", "error", 5, number=0.5)
    with drone.on_log(got.append):
        drone.wait(lambda _: proxy.server.subscribers(LOGS) == 1, WAIT_S)
        proxy.server.publish(LOGS, encode(entry))
        drone.wait(lambda _: got == [entry], WAIT_S)
    drone.wait(lambda _: proxy.server.subscribers(LOGS) == 0, WAIT_S)


def test_a_closed_drone_logs_nothing(drone: Drone) -> None:
    drone.close()
    assert not drone.log.text("too late")
    assert not drone.log.numbers(a=1.0, b=2.0)


@pytest.mark.parametrize("inline", [True, False])
def test_listeners_may_be_inline(proxy: ScriptedProxy, drone: Drone, inline: bool) -> None:
    threads: list[str] = []

    def note(_: object) -> None:
        threads.append(threading.current_thread().name)

    with (
        drone.on_event(note, inline=inline),
        drone.on_command(note, inline=inline),
        drone.on_annotation(note, inline=inline),
        drone.on_log(note, inline=inline),
    ):
        drone.wait(lambda _: proxy.server.subscribers(LOGS) == 1, WAIT_S)
        proxy.server.publish(LOGS, encode(LogEntry("x", "", 1, text="hello")))
        drone.wait(lambda _: bool(threads), WAIT_S)
    assert ("skyloop-log" in threads) is not inline
