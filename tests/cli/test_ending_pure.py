"""``skyloop land`` and ``stop`` against a simulated proxy: silence, failures, and two of the same priority."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import typer

from skyloop.cli import ending
from skyloop.client.drone import Drone, open_drone
from skyloop.errors import AuthorityError, ClosedError, NoAnswerError
from skyloop.messages import EmergencyStop, FlightState, Hover, RequestAuthority, ReturnToStart
from skyloop.transport.base import Peer
from tests.support.scripted_proxy import QUICK, WAIT_S, ScriptedProxy, background, scripted

LANDED, LANDING, FLYING = FlightState.LANDED, FlightState.LANDING, FlightState.FLYING


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


def test_a_stop_waits_for_no_state_and_no_authority(proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    """The vehicle's downlink is dead, and the proxy answers no request: it can still be stopped."""

    def prepare(_: str, **options: Any) -> tuple[Drone, float]:
        drone = Drone(proxy.server.dial, app=options["name"], on_exit="hover", policy=QUICK)
        return drone, time.monotonic() + WAIT_S

    monkeypatch.setattr(sys.modules["skyloop.client.connect"], "prepare", prepare)
    monkeypatch.setattr(ending, "STOPPING_S", 0.5)
    proxy.beating.clear()
    proxy.answers[RequestAuthority] = None
    try:
        with pytest.raises(NoAnswerError, match="has not confirmed it"):
            ending._stop("alpha")
        assert proxy.actions().count(EmergencyStop()) > 3
        assert not any(isinstance(request, RequestAuthority) for request in proxy.requests)
    finally:
        proxy.beating.set()
    proxy.state = FlightState.EMERGENCY
    assert ending._stop("alpha") == "motors off"


def test_an_unexpected_failure_of_one_does_not_hide_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    def end(name: str) -> str:
        if name == "b":
            raise ZeroDivisionError("a bug")
        if name == "c":
            raise NoAnswerError("it is silent")
        return "landed"

    with pytest.raises(typer.Exit) as ended:
        ending._each("abcd", end, "NOT landed", json=True)
    assert ended.value.exit_code == 1
    told = {one["name"]: (one["ok"], one["outcome"]) for one in json.loads(capsys.readouterr().out)}
    assert told == {
        "a": (True, "landed"),
        "b": (False, "NOT landed: ZeroDivisionError('a bug')"),
        "c": (False, "NOT landed: it is silent"),
        "d": (True, "landed"),
    }


def test_every_drone_is_ended_at_once_however_many_there_are() -> None:
    names = [f"d{number}" for number in range(90)]
    begun: list[str] = []

    def end(name: str) -> str:
        begun.append(name)
        deadline_s = time.monotonic() + WAIT_S
        while len(begun) < len(names):
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        return "motors off"

    ending._each(names, end, "NOT stopped", json=False)


@pytest.mark.parametrize(("state", "outcome"), [(LANDING, "landed, by its pilot"), (FLYING, None)])
def test_a_landing_of_the_same_priority_serves_both(
    proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch, state: FlightState, outcome: str | None
) -> None:
    def busy(*_: object, **__: object) -> None:
        raise AuthorityError("skyloop land holds the authority over alpha", code="busy")

    monkeypatch.setattr("skyloop.cli.listing.connect_pilot", busy)
    monkeypatch.setattr(
        "skyloop.client.connect",
        lambda _, **options: open_drone(proxy.server.dial, app=options["name"], access="observe", policy=QUICK),
    )
    proxy.state = state
    joined = [0]
    before = proxy.peer_joined

    def peer_joined(peer: Peer) -> None:
        before(peer)
        joined.append(peer.id)
        proxy.notifier.notify()

    monkeypatch.setattr(proxy, "peer_joined", peer_joined)
    if outcome is None:
        with pytest.raises(AuthorityError, match="skyloop land holds"):
            ending._land("alpha", 0)
        return
    down = background(
        lambda: proxy.until(lambda: len(joined) > 2, "it is watched"), lambda: setattr(proxy, "state", LANDED)
    )
    assert ending._land("alpha", 0) == outcome
    down.join(WAIT_S)


@pytest.mark.parametrize("connected", [True, False])
def test_no_return_begins_after_ctrl_c(proxy: ScriptedProxy, monkeypatch: pytest.MonkeyPatch, connected: bool) -> None:
    """A drone that was still connecting flew home after it."""
    proxy.state = FlightState.FLYING

    def connect(_name: str, _advice: str, **_: object) -> Drone:
        return open_drone(proxy.server.dial, app="me", on_exit="hover", policy=QUICK)

    monkeypatch.setattr("skyloop.cli.listing.connect_pilot", connect)
    monkeypatch.setattr(ending, "_over_already", lambda *_: "")
    flown: list[Drone] = []
    interrupted = threading.Event()
    if connected:
        monkeypatch.setattr(Drone, "return_to_start", _interrupted(Drone.return_to_start))
    else:
        interrupted.set()
    with pytest.raises(ClosedError, match="too late"):
        ending._return("alpha", 16, None, flown, interrupted)
    assert not [one for one in proxy.actions() if isinstance(one, ReturnToStart)]
    assert Hover() in proxy.actions()


def _interrupted(fly: Any) -> Any:
    """Send Ctrl-C between the connection and the command."""

    def flown(drone: Drone, *arguments: Any, **options: Any) -> None:
        ending._stay(drone)
        fly(drone, *arguments, **options)

    return flown
