"""What the chaos run's judge makes of journals: it finds each broken promise, and none that was kept."""

from __future__ import annotations

import pytest

from tests.chaos.journal import Entry
from tests.chaos.judge import Fault, Verdict, faults_of, judge

START_NS = 10**12


def entry(at_s: float, what: str, number: int = 0) -> Entry:
    return Entry(START_NS + round(at_s * 1e9), what, number)


def fault(kind: str, begin_s: float, end_s: float) -> Fault:
    return Fault(kind, START_NS + round(begin_s * 1e9), START_NS + round(end_s * 1e9))


class Flight:
    """Journals of a flight at 10 Hz from 0 to ``until_s``, with a gap in which the pilot is away."""

    def __init__(self, until_s: float = 20.0, away: tuple[float, float] = (0.0, 0.0)) -> None:
        self.pilot: list[Entry] = []
        self.vehicle = [entry(-2.0, "open"), entry(-1.9, "state:flying")]
        for number in range(1, round(until_s * 10)):
            at_s = number / 10
            if away[0] < at_s < away[1]:
                continue
            self.pilot += [entry(at_s, "call", number), entry(at_s + 0.001, "called", number)]
            self.vehicle.append(entry(at_s + 0.0005, "velocity", number))

    def judge(self, *faults: Fault) -> Verdict:
        by_time = sorted(self.vehicle, key=lambda line: line.at_ns)
        return judge(self.pilot, by_time, faults)


def test_a_flight_without_faults_breaks_nothing() -> None:
    verdict = Flight().judge()
    assert (verdict.calls, verdict.applied) == (199, 199)
    assert [verdict.stale, verdict.needless, verdict.missed, verdict.unrecovered] == [[]] * 4
    assert verdict.justified == 0
    assert verdict.delay_s == pytest.approx([0.0005] * 199)


@pytest.mark.parametrize(
    ("what", "number", "reason"),
    [
        (5.0, 4000, "never asked for"),
        (5.0, 30, "2.0"),  # the call of 3.0 s
    ],
)
def test_what_is_old_or_was_never_asked_for_is_stale(what: float, number: int, reason: str) -> None:
    flight = Flight()
    flight.vehicle.append(entry(what + 0.05, "velocity", number))
    (found,) = flight.judge().stale
    assert reason in found


def test_a_repeat_within_the_library_s_second_is_not_stale() -> None:
    flight = Flight()
    flight.vehicle.append(entry(5.9, "velocity", 50))
    assert not flight.judge().stale


def test_a_set_point_from_before_a_failsafe_is_stale_however_young() -> None:
    flight = Flight(away=(5.0, 6.0))
    flight.vehicle += [entry(5.5, "failsafe:hover"), entry(5.8, "velocity", 50)]
    (found,) = flight.judge(fault("pilot_stop", 5.05, 5.95)).stale
    assert "after a failsafe" in found


def test_a_failsafe_while_the_pilot_calls_is_needless() -> None:
    flight = Flight()
    flight.vehicle.append(entry(5.05, "failsafe:hover"))
    assert len(flight.judge().needless) == 1
    assert len(flight.judge(fault("request_flood", 4.0, 6.0)).needless) == 1, "a flood is no reason"
    verdict = flight.judge(fault("proxy_stop", 4.0, 5.0))
    assert not verdict.needless, "a proxy that was away is one"
    assert verdict.justified == 1


def test_a_failsafe_after_the_pilot_was_silent_is_due() -> None:
    flight = Flight(away=(5.0, 8.0))
    flight.vehicle.append(entry(5.55, "failsafe:hover"))
    verdict = flight.judge()
    assert (verdict.needless, verdict.justified) == ([], 1)


@pytest.mark.parametrize(
    ("hover_s", "land_s", "missed"), [(5.52, 10.0, 0), (None, 10.0, 1), (5.52, None, 1), (7.0, 13.0, 2)]
)
def test_a_pilot_who_is_away_is_followed_by_hover_and_landing(
    hover_s: float | None, land_s: float | None, missed: int
) -> None:
    flight = Flight(until_s=20.0, away=(5.0, 13.0))
    if hover_s is not None:
        flight.vehicle.append(entry(hover_s, "failsafe:hover"))
    if land_s is not None:
        flight.vehicle.append(entry(land_s, "failsafe:land"))
    verdict = flight.judge(fault("pilot_stop", 5.0, 12.95))
    assert len(verdict.missed) == missed
    if missed == 0:
        assert verdict.hover_late_s == pytest.approx([0.02])


def test_no_failsafe_is_expected_of_a_proxy_that_is_away_nor_on_the_ground() -> None:
    flight = Flight(away=(5.0, 13.0))
    assert not flight.judge(fault("pilot_stop", 5.0, 12.95), fault("proxy_stop", 5.1, 12.0)).missed
    grounded = Flight(away=(5.0, 13.0))
    grounded.vehicle.append(entry(4.95, "state:landed"))
    assert not grounded.judge(fault("pilot_stop", 5.0, 12.95)).missed


def test_recovery_is_counted_to_the_first_new_set_point() -> None:
    verdict = Flight(away=(5.0, 8.0)).judge(fault("pilot_kill", 5.0, 7.5))
    assert verdict.recovery_s == {"pilot_kill": [pytest.approx(0.5005)]}
    assert Flight(until_s=6.0).judge(fault("proxy_kill", 5.0, 7.0)).unrecovered


def test_faults_are_read_from_their_beginnings_and_ends() -> None:
    lines = [entry(1, "begin:hog"), entry(2, "end:hog"), entry(3, "begin:hog"), entry(4, "end:other")]
    assert faults_of(lines) == [fault("hog", 1, 2)]
