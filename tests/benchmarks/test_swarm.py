"""``python -m benchmarks.swarm``: what it expects of failsafes, and a short run without root."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import swarm
from benchmarks.swarm import WITHIN_S, Expected, judge, stops_of
from benchmarks.swarming import Step

S = 1_000_000_000


def test_missed_and_needless_failsafes_are_told_apart() -> None:
    expected = [Expected("one", 10 * S), Expected("two", 10 * S), Expected("one", 20 * S)]
    steps = [Step("one", 10 * S + S // 2), Step("one", 15 * S), Step("two", 9 * S), Step("one", 20 * S)]
    verdict = judge(expected, steps)
    assert (verdict.expected, verdict.missed, verdict.needless) == (3, 1, 2)
    assert verdict.delay is not None
    assert (verdict.delay.samples, verdict.delay.median_us) == (2, 0.25e6)
    assert judge([], []).delay is None


def test_a_step_that_comes_too_late_is_none() -> None:
    verdict = judge([Expected("one", 0)], [Step("one", round(WITHIN_S * S) + 1)])
    assert (verdict.missed, verdict.needless) == (1, 1)


@given(st.integers(1, 10), st.floats(1.0, 600.0))
def test_users_stop_one_after_the_other_within_the_run(users: int, seconds: float) -> None:
    stops = stops_of(users, seconds)
    assert len(stops) == users
    assert stops == sorted(stops)
    assert stops[0] > 0.0
    assert stops[-1] < seconds


@pytest.mark.process
def test_without_hosts_of_their_own_all_meet_on_the_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh")
    pytest.importorskip("cv2")
    monkeypatch.setattr(swarm, "problem", lambda: "not today")
    found = swarm.measure(3.0, drones=2)
    assert not found.hosts
    assert found.failsafe.expected >= 2
    assert found.failsafe.missed == 0
    assert found.feedback_at_observers is None
    assert swarm.Swarm.__struct_config__.tag == "swarm"
