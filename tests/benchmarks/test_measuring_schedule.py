"""What is sent when, and where the set-points lead."""

from __future__ import annotations

from itertools import islice, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.measuring.schedule import CHANNELS, COMMAND, LARGE, VIDEO, WARM_UP_S, Turn, paced
from benchmarks.measuring.waypoints import SPEED_M_S, WAYPOINTS_M, fly


def test_deadlines_are_absolute() -> None:
    now_ns, slept = 0, list[float]()

    def sleep(seconds: float) -> None:
        nonlocal now_ns
        slept.append(seconds)
        now_ns += round(seconds * 1e9) + 300_000_000  # too long each time

    for _ in paced(iter([10**9, 2 * 10**9, 2 * 10**9 + 1, 4 * 10**9]), lambda: now_ns, sleep):
        pass
    assert slept == pytest.approx([1.0, 0.7, 1.7])  # one that is late already is not waited for


@given(st.integers(0, 1000), st.floats(0.5, 10.0), st.sampled_from(CHANNELS))
def test_a_turn_counts_what_is_sent_after_the_warm_up(number: int, seconds: float, channel: str) -> None:
    turn, begin_ns = Turn(number, seconds), 5 * 10**9
    deadlines = list(turn.deadlines_ns(channel, begin_ns))
    counted = [at for at in deadlines if at >= begin_ns]
    assert len(counted) == turn.count(channel)
    assert deadlines[0] >= begin_ns - WARM_UP_S * 1e9
    assert counted[-1] < begin_ns + (seconds + turn.period_s(channel)) * 1e9
    assert all(later - earlier == pytest.approx(turn.period_s(channel) * 1e9) for earlier, later in pairwise(deadlines))


def test_channels_meet_in_another_way_in_each_turn() -> None:
    def phase(number: int, channel: str) -> int:
        turn = Turn(number, 1.0)
        return next(at for at in turn.deadlines_ns(channel, 10**9) if at >= 10**9)

    assert {phase(number, COMMAND) for number in range(5)} == {10**9}
    assert len({phase(number, VIDEO) for number in range(5)}) == 5


def test_sizes() -> None:
    assert (str(LARGE), LARGE.frame_bytes) == ("1920×1080", 6_220_800)


def test_the_set_points_lead_round_the_waypoints_within_the_limits() -> None:
    setpoints = list(islice(fly(), 3000))
    speeds = [(forward**2 + left**2) ** 0.5 for forward, left, _ in setpoints]
    assert max(speeds) <= SPEED_M_S + 1e-9
    assert min(speeds) > 0.0
    assert all(abs(yaw_rate) <= 1.0 for _, _, yaw_rate in setpoints)
    assert len(set(setpoints)) > 1000  # no constant load
    slow = sum(later < earlier for earlier, later in pairwise(speeds))
    assert slow > 20 * len(WAYPOINTS_M)  # it slows down before each
