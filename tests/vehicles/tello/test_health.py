"""Reports of heat and mission pads, once each."""

from __future__ import annotations

from skyloop.messages import Severity
from skyloop.vehicles.tello.telemetry import PAD_LOST, TelloHealth
from skyloop.vehicles.tello.wire import Pad, TelloState


def hot(celsius: float) -> TelloState:
    return TelloState(temperature_c=(celsius - 3, celsius))


def test_heat_is_reported_when_it_begins_and_ends() -> None:
    health = TelloHealth()
    assert health.changes(hot(89)) == []
    (told,) = health.changes(hot(90))
    assert (told.severity, told.data["reason"], told.data["active"]) == (Severity.WARNING, "hot", True)
    assert health.changes(hot(86)) == []
    (gone,) = health.changes(hot(84))
    assert gone.data["active"] is False
    assert health.changes(TelloState()) == []


def test_a_flickering_pad_is_reported_once() -> None:
    health = TelloHealth()
    seen = TelloState(pad=Pad(3, (10.0, 20.0, 80.0), None))
    (told,) = health.changes(seen)
    assert told.data["place"] == (0.1, 0.2, 0.8)
    for _ in range(PAD_LOST - 1):
        assert health.changes(TelloState()) == []
    assert health.changes(seen) == []
    for _ in range(PAD_LOST - 1):
        assert health.changes(TelloState()) == []
    (gone,) = health.changes(TelloState())
    assert (gone.data["pad"], gone.data["in_view"]) == (3, False)
    (unplaced,) = health.changes(TelloState(pad=Pad(4, None, None)))
    assert "place" not in unplaced.data
