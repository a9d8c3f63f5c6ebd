"""The proxy's code kept warm: for who flies, and for nobody else."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from skyloop.messages import FlightState, Hover, ReleaseAuthority, Role
from skyloop.proxy import Proxy, warm_up
from tests.proxy.fake import Bench


def test_a_round_runs_a_command_a_feedback_and_a_frame_and_nobody_learns_of_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made: list[Proxy] = []

    class Seen(Proxy):
        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            made.append(self)

    monkeypatch.setattr(warm_up, "Proxy", Seen)
    with caplog.at_level(logging.DEBUG):
        pieces = warm_up.make_pieces()
        for _ in range(500):
            for piece in pieces:
                piece()
    (proxy,) = made
    counts = proxy._counters.snapshot()
    assert counts["commands.applied"] == counts["commands.received"] == 500
    assert counts["feedback.published"] == 501
    assert counts["frames.camera.published"] == 500
    assert not [name for name in counts if "refused" in name or "missed" in name or "errors" in name]
    assert caplog.records == []


def test_it_is_kept_warm_while_a_pilot_flies_and_never_on_the_ground(bench: Bench) -> None:
    asked: list[float] = []
    bench.proxy.keep_warm = asked.append

    def now() -> float:
        bench.tick()
        return asked[-1]

    assert now() == 0.0  # nobody is there
    observer = bench.join("observer", Role.OBSERVER)
    pilot = bench.pilot()
    assert now() == 0.0  # a pilot, on the ground
    bench.take_off(pilot)
    assert now() == bench.proxy.parameters.number("warm.period_s") == 0.005
    pilot.command(Hover())
    assert now() == 0.005
    bench.driver.report(state=FlightState.LANDED)
    assert now() == 0.0
    bench.driver.report(state=FlightState.HOVERING)
    assert now() == 0.005
    pilot.ask(ReleaseAuthority())
    assert now() == 0.0  # it flies, and only an observer looks on
    assert observer.last_feedback().state is FlightState.HOVERING


@pytest.mark.parametrize(("given", "kept"), [(0.0, 0.0), (0.0001, 0.001), (0.02, 0.02)])
def test_a_parameter_says_how_often(bench: Bench, given: float, kept: float) -> None:
    bench.proxy.parameters.set("warm.period_s", given)
    assert bench.proxy.parameters.flight_settings().warm_s == kept


def test_a_tick_that_comes_back_after_the_end_keeps_nothing_warm(bench: Bench) -> None:
    asked: list[float] = []
    bench.proxy.keep_warm = asked.append
    bench.airborne()
    bench.tick()
    assert asked[-1] > 0.0
    bench.proxy.end(reason="its driver hangs", hangs=True)
    bench.tick()
    assert asked[-1] == 0.0
