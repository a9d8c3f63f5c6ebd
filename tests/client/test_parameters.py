"""Parameters as a mapping."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from skyloop.client import Drone
from skyloop.client.parameters import plain_value
from skyloop.errors import AuthorityError, LinkError, ParameterError, UnknownNameError, UsageError
from skyloop.messages import (
    Done,
    EventKind,
    GetParameter,
    ListParameters,
    Refusal,
    Refused,
    SetParameter,
    Value,
)
from tests.support.scripted_proxy import WAIT_S, ScriptedProxy, background, flown, scripted


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


@pytest.fixture
def drone(proxy: ScriptedProxy) -> Iterator[Drone]:
    with flown(proxy) as drone:
        yield drone


def test_reading(drone: Drone) -> None:
    config = drone.config
    assert config["limits.tilt"] == 0.35
    assert config.describe("limits.tilt").unit == "rad"
    assert list(config) == ["limits.speed", "limits.tilt"]
    assert config.items() == [("limits.speed", 2.0), ("limits.tilt", 0.35)]
    assert config.values() == [2.0, 0.35]
    assert len(config) == 2
    assert "limits.tilt" in config
    assert "limits" not in config


def test_writing(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.config["limits.tilt"] = np.float64(0.2)
    assert proxy.parameters["limits.tilt"] == 0.2
    assert SetParameter("limits.tilt", 0.2, drone.authority.lease) in proxy.requests


def test_unknown_names(drone: Drone) -> None:
    with pytest.raises(UnknownNameError, match=r"did you mean 'limits\.tilt'"):
        _ = drone.config["limits.tild"]
    with pytest.raises(UnknownNameError):
        drone.config["limits.tild"] = 0.1
    with pytest.raises(UsageError, match="1 to 128"):
        _ = drone.config[""]


def test_refusals(proxy: ScriptedProxy, drone: Drone) -> None:
    with pytest.raises(ParameterError, match=r"limits\.tilt: takes a float") as error:
        drone.config["limits.tilt"] = "much"
    assert error.value.code == "wrong_type"
    drone.release_authority()
    with pytest.raises(AuthorityError, match=r"writing limits\.tilt needs the authority"):
        drone.config["limits.tilt"] = 0.1
    assert proxy.parameters["limits.tilt"] == 0.35


def test_answers_of_the_wrong_type(proxy: ScriptedProxy, drone: Drone) -> None:
    for kind in (GetParameter, SetParameter, ListParameters):
        proxy.answers[kind] = Done()
    with pytest.raises(LinkError, match="with Done"):
        _ = drone.config["limits.tilt"]
    with pytest.raises(LinkError, match="with Done"):
        drone.config["limits.tilt"] = 0.1
    with pytest.raises(LinkError, match="with Done"):
        drone.config.items()


def test_values_that_cannot_be_restored_are_reported(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.config["limits.tilt"] = 0.2
    proxy.answers[SetParameter] = Refused(Refusal.OUT_OF_RANGE, "too much today")
    proxy.stop()
    proxy.start()

    def told() -> bool:
        return any(event.kind is EventKind.PARAMETER_CHANGED and event.seq == 0 for event in drone.recent_events())

    drone.wait(lambda _: told(), WAIT_S)
    event = next(event for event in drone.recent_events() if event.kind is EventKind.PARAMETER_CHANGED)
    assert "too much today" in event.text
    assert event.data == {"name": "limits.tilt", "reason": "out_of_range"}


def writes(proxy: ScriptedProxy) -> list[SetParameter]:
    return [request for request in list(proxy.requests) if isinstance(request, SetParameter)]


def held_again(drone: Drone, lease: int) -> None:
    drone.wait(lambda _: drone.authority.state == "held" and drone.authority.lease != lease, WAIT_S)
    _ = drone.config["limits.tilt"]  # values written at the grant were sent before this


@pytest.mark.parametrize("momentary", [True, False])
def test_momentary_parameters_are_not_repeated_after_a_broken_link(
    proxy: ScriptedProxy, drone: Drone, momentary: bool
) -> None:
    """The proxy may have done it before the link broke: two flips instead of one."""
    proxy.momentary = {"limits.tilt"} if momentary else set()
    proxy.answers[SetParameter] = None
    ended: list[Exception | None] = []

    def write() -> None:
        try:
            drone.config["limits.tilt"] = 0.2
        except LinkError as error:
            ended.append(error)
        else:
            ended.append(None)

    writing = background(write)
    proxy.until(lambda: any(isinstance(request, SetParameter) for request in proxy.requests))
    proxy.stop()
    proxy.requests.clear()
    del proxy.answers[SetParameter]
    proxy.start()
    writing.join(WAIT_S)
    again = [request for request in proxy.requests if isinstance(request, SetParameter)]
    if momentary:
        assert "may have been carried out" in str(ended[0])
        assert not again
    else:
        assert again


def test_a_lost_link_alone_restores_nothing(proxy: ScriptedProxy, drone: Drone) -> None:
    """The proxy forgot nothing: another pilot's newer value would be overwritten."""
    drone.config["limits.tilt"] = 0.2
    lease = drone.authority.lease
    proxy.hang_up()
    held_again(drone, lease)
    assert len(writes(proxy)) == 1


def test_a_restarted_proxy_gets_the_values_but_no_momentary_parameter(proxy: ScriptedProxy, drone: Drone) -> None:
    """A drone flipped a second time, unasked."""
    proxy.momentary = {"tello.flip"}
    proxy.parameters["tello.flip"] = 0.0
    drone.config["limits.tilt"] = 0.2
    drone.config["tello.flip"] = 1.0
    proxy.stop()
    proxy.requests.clear()
    proxy.start()
    drone.wait(lambda _: bool(writes(proxy)), WAIT_S)
    _ = drone.config["limits.tilt"]
    assert [(write.name, write.value) for write in writes(proxy)] == [("limits.tilt", 0.2)]


def test_another_pilots_values_are_not_overwritten(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.config["limits.tilt"] = 0.2
    drone.config["limits.speed"] = 1.0
    proxy.event(EventKind.PARAMETER_CHANGED, "", "other", name="limits.tilt", value=0.1, app_id=99)
    proxy.event(
        EventKind.PARAMETER_CHANGED,
        "",
        "me",
        name="limits.speed",
        value=1.0,
        app_id=proxy.owner[0] if proxy.owner else 0,
    )
    drone.wait(lambda _: len(drone.recent_events()) >= 2, WAIT_S)
    proxy.stop()
    proxy.requests.clear()
    proxy.start()
    drone.wait(lambda _: bool(writes(proxy)), WAIT_S)
    _ = drone.config["limits.tilt"]
    assert [write.name for write in writes(proxy)] == ["limits.speed"]


def test_nothing_is_restored_if_others_flew_since_the_restart(proxy: ScriptedProxy, drone: Drone) -> None:
    drone.config["limits.tilt"] = 0.2
    proxy.stop()
    proxy.requests.clear()
    proxy.first_lease = 5
    proxy.start()
    drone.wait(lambda _: any("others have flown since" in event.text for event in drone.recent_events()), WAIT_S)
    _ = drone.config["limits.tilt"]
    assert writes(proxy) == []


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (True, True),
        (np.bool_(False), False),
        (3, 3),
        (np.int16(3), 3),
        (0.5, 0.5),
        (np.float32(0.5), 0.5),
        ("text", "text"),
        ([1, 2.5], (1.0, 2.5)),
        (np.array([1.0, 2.0]), (1.0, 2.0)),
        (np.array(0.5), 0.5),
        (np.array(True), True),
    ],
)
def test_plain_values(given: object, expected: Value) -> None:
    value = plain_value("x", given)
    assert value == expected
    assert type(value) is type(expected)


@pytest.mark.parametrize(
    "given", [None, {}, object(), ["a"], 2**63, "x" * 5000, [0.0] * 300, np.zeros((2, 2)), np.array(1j)]
)
def test_values_that_cannot_be_sent(given: object) -> None:
    with pytest.raises(UsageError, match="x can't be"):
        plain_value("x", given)


def test_non_finite_values_are_left_to_the_proxy() -> None:
    value = plain_value("x", math.inf)
    assert isinstance(value, float)
    assert math.isinf(value)
