"""The alarms of a drone, as tables."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from skyloop.cockpit.alarms import PARAMETERS, USUAL, AlarmThresholds, DegradedTimes, alarms, thresholds_of
from skyloop.cockpit.telemetry import encode_json
from skyloop.errors import UnknownNameError
from skyloop.messages import Failsafe, Feedback, FlightState, LinkState, Value
from skyloop.proxy.parameters import OWN


def link(application: str = "up", vehicle: str = "up", reason: str = "", remedy: str = "") -> Any:
    hops = {"application": LinkState(application), "vehicle": LinkState(vehicle)}
    return SimpleNamespace(**hops, reason=reason, remedy=remedy)


def flying(**values: Any) -> Feedback:
    known: dict[str, Any] = {"captured_ns": 1, "state": FlightState.FLYING, "battery": 0.8}
    return Feedback(**(known | values))


def landed(**values: Any) -> Feedback:
    return flying(state=FlightState.LANDED, **values)


LOST = ("application_link", "critical", "link to the proxy lost")
GONE = ("vehicle_link", "critical", "link to the vehicle lost: radio")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ((link(), flying(), 0.1, {}), []),
        ((link(), None, None, {}), []),
        ((link("lost", "up", "killed"), flying(battery=0.01), 9.0, {}), [(*LOST[:2], f"{LOST[2]}: killed")]),
        ((link("closed"), None, None, {}), [("application_link", "warning", "link to the proxy lost")]),
        ((link("up", "lost", "radio"), flying(), 0.1, {}), [GONE]),
        ((link("up", "lost", "radio", "plug it in"), flying(), 0.1, {}), [(*GONE[:2], f"{GONE[2]}: plug it in")]),
        ((link("up", "lost", "radio"), landed(), 0.1, {}), [(GONE[0], "warning", GONE[2])]),
        ((link("lost"), landed(), 9.0, {}), [(LOST[0], "warning", LOST[2])]),
        ((link(), landed(battery=0.05), 0.1, {}), [("battery", "warning", "battery critical: 5%")]),
        ((link(), landed(), 2.5, {}), [("feedback_age", "warning", "feedback is 2.5 s old")]),
        (
            (link("up", "connecting", "waiting"), None, None, {}),
            [("vehicle_link", "warning", "no vehicle yet: waiting")],
        ),
        ((link("up", "closed", "end of the recording"), flying(battery=0.01), 9.0, {"front": 9.0}), []),
        ((link("degraded"), flying(), 0.1, {}), [("application_link", "warning", "link to the proxy degraded")]),
        (
            (link(vehicle="degraded", reason="slow"), flying(), 0.1, {}),
            [("vehicle_link", "warning", "link to the vehicle degraded: slow")],
        ),
        (
            (link(), flying(state=FlightState.EMERGENCY), 0.1, {}),
            [("emergency", "critical", "emergency: the motors are off")],
        ),
        (
            (link(), flying(failsafe=Failsafe.HOVER, lease=3), 0.1, {}),
            [("failsafe", "warning", "failsafe: hovering")],
        ),
        (
            (link(), flying(failsafe=Failsafe.HOVER), 0.1, {}),
            [("failsafe", "warning", "failsafe: hovering, returning or landing next unless someone takes control")],
        ),
        ((link(), flying(failsafe=Failsafe.LAND), 0.1, {}), [("failsafe", "critical", "failsafe: landing")]),
        ((link(), flying(battery=0.19), 0.1, {}), [("battery", "warning", "battery low: 19%")]),
        ((link(), flying(battery=0.14), 0.1, {}), [("battery", "critical", "battery critical: 14%")]),
        ((link(), flying(), 2.5, {}), [("feedback_age", "critical", "feedback is 2.5 s old")]),
        (
            (link(), flying(), 0.1, {"front": 0.3, "bottom": 4.0}),
            [("video_age.bottom", "warning", "video of bottom is 4.0 s old")],
        ),
        (
            (link("degraded"), flying(state=FlightState.EMERGENCY, battery=0.18), 2.0, {}),
            [
                ("emergency", "critical", "emergency: the motors are off"),
                ("battery", "warning", "battery low: 18%"),
                ("application_link", "warning", "link to the proxy degraded"),
                ("feedback_age", "warning", "feedback is 2.0 s old"),
            ],
        ),
    ],
)
def test_alarms(given: tuple[Any, Any, Any, Any], told: list[tuple[str, str, str]]) -> None:
    long = DegradedTimes().update(given[0], 0)
    found = alarms(*given, degraded_s=dict.fromkeys(long, USUAL.link_degraded_s))
    assert [(alarm.id, alarm.severity, alarm.text) for alarm in found] == told


def test_a_link_is_an_alarm_once_it_has_been_degraded_for_a_while() -> None:
    times, bad = DegradedTimes(), link(vehicle="degraded", reason="slow")

    def told(status: Any, at_s: float, thresholds: AlarmThresholds = USUAL) -> list[str]:
        degraded_s = times.update(status, round(at_s * 1e9))
        return [alarm.id for alarm in alarms(status, flying(), 0.1, {}, degraded_s, thresholds)]

    assert told(bad, 1.0) == told(bad, 1.4) == []
    assert told(bad, 1.5) == ["vehicle_link"]
    assert (
        told(bad, 1.5, AlarmThresholds(link_degraded_s=2.0))
        == told(bad, 99.0, AlarmThresholds(link_degraded_s=0.0))
        == []
    )
    assert told(link(), 100.0) == []
    assert told(bad, 100.1) == [], "it was up in between"


def test_thresholds_are_the_drones_and_zero_is_never() -> None:
    late = (link(), flying(battery=0.3), 1.5, {"front": 2.5})
    told = alarms(
        *late, {}, AlarmThresholds(battery_low=0.5, battery_critical=0.35, feedback_age_s=2.0, video_age_s=2.0)
    )
    assert [(alarm.id, alarm.severity) for alarm in told] == [("battery", "critical"), ("video_age.front", "warning")]
    never = AlarmThresholds(battery_low=0.0, battery_critical=0.0, feedback_age_s=0.0, video_age_s=0.0)
    assert alarms(link(), flying(battery=0.0), 1e6, {"front": 1e6}, {}, never) == []


def test_an_alarm_is_an_object_for_pages() -> None:
    told = encode_json(alarms(link("degraded"), None, None, {}, {"application_link": 9.0}))
    assert told == b'[{"id":"application_link","severity":"warning","text":"link to the proxy degraded"}]'


class Config(dict[str, Value]):
    def __missing__(self, name: str) -> Value:
        raise UnknownNameError("parameter", name, self)


def test_the_usual_thresholds_are_the_proxys_defaults() -> None:
    assert thresholds_of(Config({parameter.name: parameter.value for parameter in OWN})) == USUAL


@pytest.mark.parametrize("value", [True, "much", (1.0,), math.nan, math.inf])
def test_thresholds_that_are_not_numbers_are_ignored(value: Value) -> None:
    assert thresholds_of(Config(dict.fromkeys(PARAMETERS.values(), value))) == USUAL


def test_an_older_proxy_without_them_has_the_usual_ones() -> None:
    assert thresholds_of(Config({"battery.warn": 0.4})) == AlarmThresholds(battery_low=0.4)
