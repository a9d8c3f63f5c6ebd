"""An application's code kept warm: while it flies."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from skyloop.client import Drone, warm_up
from skyloop.client.core import DroneCore
from skyloop.client.warm_up import keeper
from skyloop.errors import UsageError
from skyloop.messages import FlightState
from skyloop.transport.testing import wait_until
from tests.client.scripted import ScriptedProxy, scripted


@pytest.fixture
def proxy() -> Iterator[ScriptedProxy]:
    with scripted() as proxy:
        yield proxy


def test_a_round_takes_feedback_and_a_frame_and_sends_a_command(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made: list[DroneCore] = []

    class Seen(DroneCore):
        def __init__(self, *args: object, **options: object) -> None:
            super().__init__(*args, **options)  # type: ignore[arg-type]
            made.append(self)

    monkeypatch.setattr(warm_up, "DroneCore", Seen)
    with caplog.at_level(logging.DEBUG):
        pieces = warm_up.make_pieces()
        (core,) = made
        before = core.commands.sends.count
        for _ in range(200):
            for piece in pieces:
                piece()
    stats = Drone(core).stats
    assert stats["feedback"].count == 201
    assert stats["video/camera"].count == 200
    assert core.commands.sends.count - before == 200
    assert core.commands.sends.dropped == 0
    assert caplog.records == []


def test_it_is_kept_warm_while_this_application_flies(proxy: ScriptedProxy) -> None:
    asked: list[bool] = []
    core = DroneCore(proxy.server.dial, app="test", keep_warm=asked.append)
    core.open()
    try:
        wait_until(lambda: asked, "it was asked")
        assert not any(asked)
        proxy.state = FlightState.FLYING
        wait_until(lambda: asked[-1], "it flies")
        core.commands.release()
        wait_until(lambda: not asked[-1], "the authority was given back")
    finally:
        core.close()
    assert asked[-1] is False


def test_each_drone_is_one_who_wants_it() -> None:
    flies = keeper(0.5)
    other = keeper(0.0)
    other(True)
    assert not warm_up.WARMER.active
    flies(True)
    assert warm_up.WARMER.active
    flies(False)
    assert not warm_up.WARMER.active


@pytest.mark.parametrize("period_s", [-1.0, 0.0001, 2.0, float("nan")])
def test_a_period_that_makes_no_sense_is_refused(period_s: float) -> None:
    with pytest.raises(UsageError, match=r"must be from 0\.001 to 1 s, or 0 for never"):
        keeper(period_s)
