"""The state of a link from arrival times alone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.client.monitoring import LinkMonitor, StallWatch, Thresholds
from skyloop.clock import ManualClock
from skyloop.messages import LinkState

PERIOD = 1 / 32


def flow(monitor: LinkMonitor, clock: ManualClock, seqs: range | list[int], period_s: float = PERIOD) -> None:
    for seq in seqs:
        clock.advance(period_s)
        monitor.feedback(seq, clock())
        monitor.verdict(clock())


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def monitor(clock: ManualClock) -> LinkMonitor:
    return LinkMonitor(Thresholds(), clock())


def test_connecting_until_feedback_arrives(monitor: LinkMonitor, clock: ManualClock) -> None:
    assert monitor.verdict(clock()).state is LinkState.CONNECTING
    flow(monitor, clock, [7])
    assert monitor.verdict(clock()).state is LinkState.UP


def test_late_feedback_degrades_and_the_next_one_recovers(monitor: LinkMonitor, clock: ManualClock) -> None:
    flow(monitor, clock, range(40))
    clock.advance(0.31)
    verdict = monitor.verdict(clock())
    assert (verdict.state, verdict.restart) == (LinkState.DEGRADED, False)
    assert "0.3 s" in verdict.reason
    flow(monitor, clock, [40])
    assert monitor.verdict(clock()).state is LinkState.UP


def test_silence_is_a_lost_link_to_be_restarted(monitor: LinkMonitor, clock: ManualClock) -> None:
    flow(monitor, clock, range(40))
    clock.advance(1.01)
    verdict = monitor.verdict(clock())
    assert (verdict.state, verdict.restart) == (LinkState.LOST, True)


def test_a_network_with_pauses_is_given_more_time(monitor: LinkMonitor, clock: ManualClock) -> None:
    monitor.excuse(2.0)
    flow(monitor, clock, range(10))
    clock.advance(2.9)
    assert monitor.verdict(clock()).state is LinkState.DEGRADED
    monitor.expect(0.0, clock() - 2_900_000_000)
    clock.advance(0.2)
    assert monitor.verdict(clock()).restart


def test_a_proxy_that_answers_but_sends_no_feedback_is_degraded_not_lost(
    monitor: LinkMonitor, clock: ManualClock
) -> None:
    flow(monitor, clock, range(40))
    for _ in range(30):
        clock.advance(0.1)
        monitor.received_ns = clock()
    verdict = monitor.verdict(clock())
    assert (verdict.state, verdict.restart) == (LinkState.DEGRADED, False)


@pytest.mark.parametrize(("step", "state"), [(20, LinkState.UP), (5, LinkState.DEGRADED)])
def test_missing_samples(monitor: LinkMonitor, clock: ManualClock, step: int, state: LinkState) -> None:
    """One in ``step`` is missing: 5 % is fine, 20 % is not."""
    flow(monitor, clock, [seq for seq in range(96) if seq % step])
    assert monitor.verdict(clock()).state is state


def test_old_gaps_are_forgotten(monitor: LinkMonitor, clock: ManualClock) -> None:
    flow(monitor, clock, [0, 20])
    assert monitor.verdict(clock()).state is LinkState.DEGRADED
    flow(monitor, clock, range(21, 60))
    assert monitor.verdict(clock()).state is LinkState.UP


def test_malformed_packets_degrade_and_then_restart(monitor: LinkMonitor, clock: ManualClock) -> None:
    flow(monitor, clock, range(10))
    monitor.malformed()
    monitor.malformed()
    assert monitor.verdict(clock()).state is LinkState.DEGRADED
    for _ in range(3):
        monitor.malformed()
    verdict = monitor.verdict(clock())
    assert verdict.restart
    assert "5 malformed" in verdict.reason


def test_repeated_and_overtaken_samples_are_not_new(monitor: LinkMonitor, clock: ManualClock) -> None:
    assert monitor.feedback(5, clock())
    assert not monitor.feedback(5, clock())
    assert not monitor.feedback(4, clock())
    assert monitor.feedback(6, clock())
    assert (monitor.received, monitor.missing) == (2, 0)


@given(st.lists(st.tuples(st.integers(0, 100), st.floats(0.0, 2.0)), max_size=40))
def test_any_arrivals_give_a_verdict(arrivals: list[tuple[int, float]]) -> None:
    clock = ManualClock()
    monitor = LinkMonitor(Thresholds(), clock())
    for seq, pause_s in arrivals:
        clock.advance(pause_s)
        monitor.feedback(seq, clock())
        verdict = monitor.verdict(clock())
        assert not verdict.restart  # it was received at this very moment
        assert verdict.state in (LinkState.UP, LinkState.DEGRADED)
    assert monitor.received <= len(arrivals)
    assert len(monitor._past) <= len(arrivals) + 1


def test_stall_watch_asks_once_per_patience() -> None:
    clock = ManualClock()
    watch = StallWatch(1.0, clock())
    asked = []
    for _ in range(35):
        clock.advance(0.1)
        asked.append(watch.stalled(True, clock()))
    assert sum(asked) == 3
    watch.received_ns = clock()
    clock.advance(0.9)
    assert not watch.stalled(True, clock())
    clock.advance(5.0)
    assert not watch.stalled(False, clock())  # nothing else flows either: that is up to the link
    clock.advance(0.9)
    assert not watch.stalled(True, clock()), "the others returned first after the silence"
    clock.advance(0.2)
    assert watch.stalled(True, clock())


def slow_flow(monitor: LinkMonitor, clock: ManualClock, seqs: list[int], period_s: float = 1.0) -> None:
    """Feed samples that each follow 31 left-out ones, judged twenty times a second."""
    for seq in seqs:
        for _ in range(round(period_s * 20)):
            clock.advance(0.05)
            assert monitor.verdict(clock()).state is not LinkState.LOST
        monitor.feedback(seq, clock(), 31)


def test_feedback_requested_once_a_second_is_not_late(monitor: LinkMonitor, clock: ManualClock) -> None:
    flow(monitor, clock, range(1, 33))
    monitor.expect(1.0, clock())
    for number in range(2, 30):
        slow_flow(monitor, clock, [32 * number])
        assert monitor.verdict(clock()).state is LinkState.UP
    assert monitor.missing == 0
    clock.advance(1.35)
    assert monitor.verdict(clock()).state is LinkState.DEGRADED
    clock.advance(0.7)
    verdict = monitor.verdict(clock())
    assert (verdict.state, verdict.restart) == (LinkState.LOST, True)


def test_losses_of_slow_feedback_are_counted_in_its_own_samples(monitor: LinkMonitor, clock: ManualClock) -> None:
    flow(monitor, clock, [1])
    monitor.expect(0.1, clock())
    slow_flow(monitor, clock, [32 * number for number in range(1, 25)], 0.1)
    assert monitor.missing == 0
    slow_flow(monitor, clock, [32 * 26, 32 * 29], 0.1)
    assert monitor.missing == 1 + 2
    assert monitor.verdict(clock()).state is LinkState.DEGRADED


def test_a_change_of_the_rate_leaves_no_gap(monitor: LinkMonitor, clock: ManualClock) -> None:
    flow(monitor, clock, [1])
    monitor.expect(1.0, clock())
    slow_flow(monitor, clock, [33, 65, 97])
    monitor.expect(0.0, clock())
    flow(monitor, clock, [97, *range(110, 160)])
    assert monitor.missing == 0
    assert monitor.verdict(clock()).state is LinkState.UP
    flow(monitor, clock, [170])
    assert monitor.missing == 10, "from then on, gaps count again"


def test_a_rate_of_one_per_quarter_of_an_hour_excuses_no_long_silence(monitor: LinkMonitor, clock: ManualClock) -> None:
    flow(monitor, clock, [1])
    monitor.expect(1000.0, clock())
    for _ in range(100):
        clock.advance(2.0)
        monitor.received_ns = clock()  # the answer to a ping
        assert monitor.verdict(clock()).state is LinkState.UP
    clock.advance(3.1)
    assert monitor.verdict(clock()).restart
