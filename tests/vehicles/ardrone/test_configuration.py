"""The handshake for one key, the reading of all keys, and the queue of exchanges."""

from __future__ import annotations

import pytest

from skyloop.vehicles.ardrone.configuration import (
    MAX_DUMP,
    Configurator,
    Exchange,
    Ids,
    Read,
    Step,
    Write,
    ids_in_force,
    own_ids,
    version_of,
)
from skyloop.vehicles.ardrone.wire.at import AtMessage
from tests.vehicles.ardrone.scripted import ns

CLEAR: AtMessage = ("CTRL", (5, 0))
SEND_ALL: AtMessage = ("CTRL", (4, 0))
DUMP = b"control:outdoor = TRUE\ngeneral:num_version_soft = 2.4.8\n\0"


class Bench:
    """A configurator with the time and the results of its exchanges."""

    def __init__(self) -> None:
        self.configurator = Configurator()
        self.results: list[str | None] = []
        self.now_s = 10.0

    def submit(self, *steps: Step, within_s: float = 0.9) -> None:
        self.configurator.submit(Exchange(iter(steps), ns(self.now_s + within_s), self.results.append))

    def says(self, after_s: float = 0.0) -> list[AtMessage]:
        self.now_s += after_s
        return self.configurator.messages(ns(self.now_s))


def test_the_handshake() -> None:
    bench = Bench()
    bench.submit(Write("control:outdoor", "TRUE"))
    assert bench.says() == [("CONFIG", ("control:outdoor", "TRUE"))]
    assert bench.says(0.03) == []
    assert bench.configurator.on_acknowledge(True)
    assert bench.says(0.03) == [CLEAR]
    assert bench.results == []
    assert bench.configurator.on_acknowledge(False)
    assert bench.results == [None]
    assert bench.says(0.03) == []


def test_an_earlier_acknowledgement_is_cleared_first() -> None:
    bench = Bench()
    bench.configurator.on_acknowledge(True)
    bench.submit(Write("control:outdoor", "TRUE"))
    assert bench.says() == [CLEAR]
    assert bench.says(0.03) == [CLEAR]
    assert bench.configurator.on_acknowledge(False)
    assert bench.says(0.03) == [("CONFIG", ("control:outdoor", "TRUE"))]


def test_a_config_without_acknowledgement_is_repeated() -> None:
    bench = Bench()
    bench.submit(Write("a:b", "1"))
    said = [bench.says(0.03) for _ in range(20)]
    assert [bool(messages) for messages in said].count(True) == 4
    bench.says(0.5)
    assert bench.results == ["the drone did not acknowledge a:b"]


def test_ids_are_sent_right_before_the_config() -> None:
    bench = Bench()
    bench.configurator.ids = Ids("00000001", "00000002", "00000003")
    bench.submit(Write("a:b", "1"))
    assert bench.says() == [("CONFIG_IDS", ("00000001", "00000002", "00000003")), ("CONFIG", ("a:b", "1"))]


def test_reading_everything() -> None:
    bench = Bench()
    bench.submit(Read())
    assert bench.says() == []
    assert bench.configurator.wants_dump == 1
    bench.configurator.dump_opened()
    assert bench.says() == [SEND_ALL]
    assert bench.says(0.1) == []
    assert bench.says(0.25) == [SEND_ALL], "the command may be lost"
    assert not bench.configurator.dump_received(DUMP[:9])
    assert bench.says(0.3) == [], "data arrived: no further request"
    assert bench.configurator.dump_received(DUMP[9:])
    assert bench.configurator.values == {"control:outdoor": "TRUE", "general:num_version_soft": "2.4.8"}
    assert bench.results == [None]
    assert bench.configurator.wants_dump == 0


def test_a_stray_acknowledgement_is_cleared() -> None:
    bench = Bench()
    bench.configurator.on_acknowledge(True)
    assert bench.says() == [CLEAR]


@pytest.mark.parametrize("reason", ["connection refused", "the connection ended early"])
def test_a_dump_that_fails_is_tried_again_until_the_deadline(reason: str) -> None:
    bench = Bench()
    bench.submit(Read())
    bench.says()
    bench.configurator.dump_opened()
    bench.configurator.dump_received(b"control:outd")
    bench.configurator.dump_failed(reason)
    assert bench.says(0.03) == [], "not connected"
    bench.configurator.dump_opened()
    assert bench.says(0.03) == [SEND_ALL]
    assert bench.configurator.dump_received(DUMP)
    assert bench.results == [None]
    bench.submit(Read())
    bench.says()
    bench.configurator.dump_failed(reason)
    bench.says(1.0)
    assert bench.results[1] == f"the drone's configuration could not be read: {reason}"


def test_an_endless_dump_is_aborted() -> None:
    bench = Bench()
    bench.submit(Read())
    bench.says()
    bench.configurator.dump_opened()
    assert bench.configurator.dump_received(b"x" * (MAX_DUMP + 1))
    assert "without an end mark" in bench.configurator.trouble


def test_exchanges_wait_for_one_another() -> None:
    bench = Bench()
    bench.submit(Write("a:a", "1"))
    bench.submit(Write("b:b", "2"), within_s=0.2)
    bench.submit(Write("c:c", "3"))
    bench.says()
    bench.says(0.3)
    assert bench.results == ["the drone was busy with other settings"]
    bench.configurator.on_acknowledge(True)
    bench.configurator.on_acknowledge(False)
    assert bench.says() == [("CONFIG", ("c:c", "3"))]


def test_abandoning_fails_all_exchanges_and_forgets_the_configuration() -> None:
    bench = Bench()
    bench.configurator.values = {"a:a": "1"}
    bench.submit(Write("a:a", "1"))
    bench.submit(Read())
    bench.configurator.abandon("gone")
    assert bench.results == ["gone", "gone"]
    assert bench.configurator.values == {}
    assert not bench.configurator.busy


def test_an_exchange_may_be_submitted_at_the_end_of_another() -> None:
    bench = Bench()
    bench.configurator.submit(Exchange(iter(()), ns(99), lambda failure: bench.submit(Write("after:it", "1"))))
    bench.submit(Write("in:line", "1"))
    assert bench.says() == [("CONFIG", ("after:it", "1"))]
    bench.configurator.on_acknowledge(True)
    bench.configurator.on_acknowledge(False)
    assert bench.says() == [("CONFIG", ("in:line", "1"))]


@pytest.mark.parametrize(
    ("soft", "board", "version"),
    [("1.7.4", "17", 1), ("2.4.8", "33", 2), ("1.11.5", "17", 1), ("3.0", "", 2), ("", "17", 1), ("x", "33", 2)],
)
def test_the_version_from_the_configuration(soft: str, board: str, version: int) -> None:
    assert version_of({"general:num_version_soft": soft, "general:num_version_mb": board}) == version


def test_a_drone_without_a_version() -> None:
    assert version_of({}) is None
    assert version_of({"general:num_version_soft": "0.9"}) is None


def test_ids() -> None:
    ours = own_ids(0x1_0000_00FF)
    assert ours == Ids("000000ff", ours.profile, ours.application)
    assert all(len(one) == 8 and int(one, 16) for one in (ours.profile, ours.application))
    told = {"custom:session_id": "1", "custom:profile_id": "2", "custom:application_id": "3"}
    assert ids_in_force(told) == Ids("1", "2", "3")
    assert ids_in_force({"custom:session_id": "1"}) is None
