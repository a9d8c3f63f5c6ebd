"""The rate of a stream that follows its path, on simulated paths."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.hosts import traces
from skyloop.proxy.core.stream_rate import LEAST_KBIT_S, LOST_S, PROBE_S, SELDOM, SELDOM_S, StreamRate, picture_form

MS = 1_000_000
PERIOD_MS = 33


@dataclass
class Run:
    """A stream over a path with changing capacity, in steps of a millisecond."""

    capacity_kbit_s: Callable[[int], float]  #: at a time [ms]
    loss: float = 0.0
    most_kbit_s: int = 3000
    one_way_ms: int = 20
    ages_ms: list[tuple[int, int]] = field(default_factory=list)  #: capture time, and age on arrival
    rates: list[float] = field(default_factory=list)  #: every 100 ms

    def go(self, length_ms: int, seed: int = 0) -> Run:
        rng, rate = random.Random(seed), StreamRate(self.most_kbit_s, 0)
        queue: deque[list[float]] = deque()  # bytes left, number, capture time
        arriving: deque[tuple[int, int]] = deque()
        seq, budget = 0, 0.0
        for ms in range(length_ms):
            while arriving and arriving[0][0] <= ms:
                rate.acknowledged(arriving.popleft()[1], ms * MS)
            if ms % PERIOD_MS == 0 and rate.may_send(ms * MS):
                seq += 1
                size = int(rate.kbit_s * 125 * PERIOD_MS / 1000 * rng.lognormvariate(0.0, 0.3)) + 40
                rate.sent(seq, size, ms * MS)
                queue.append([size, seq, ms])
            budget = min(budget + self.capacity_kbit_s(ms) / 8, 3000.0)
            while queue and budget > 0:
                used = min(budget, queue[0][0])
                budget -= used
                queue[0][0] -= used
                if queue[0][0] <= 0:
                    _, number, captured = queue.popleft()
                    if rng.random() >= self.loss:
                        self.ages_ms.append((int(captured), ms + self.one_way_ms - int(captured)))
                        arriving.append((ms + 2 * self.one_way_ms, int(number)))
            if ms % 100 == 0:
                self.rates.append(rate.kbit_s)
        return self

    def age_ms(self, share: float, since_ms: int = 0) -> int:
        ages = sorted(age for captured, age in self.ages_ms if captured >= since_ms)
        return ages[int(share * (len(ages) - 1))]


@pytest.mark.parametrize("kbit_s", [300, 1000, 2500])
def test_a_steady_path_is_used_but_not_filled(kbit_s: int) -> None:
    run = Run(lambda _: kbit_s).go(30_000)
    later = run.rates[150:]
    assert 0.5 * kbit_s <= sum(later) / len(later) <= 1.1 * kbit_s  # excess pictures are not started
    assert run.age_ms(0.95, since_ms=5000) <= 150
    assert len(run.ages_ms) > 0.7 * 30_000 / PERIOD_MS


def test_a_wide_path_takes_the_most() -> None:
    assert Run(lambda _: 50_000).go(15_000).rates[-1] == 3000


def test_after_a_fall_of_the_capacity_delay_comes_first_and_the_rate_recovers() -> None:
    run = Run(lambda ms: 400 if 10_000 <= ms < 20_000 else 2500).go(40_000)
    ages = [age for captured, age in run.ages_ms if captured >= 10_000]
    assert max(ages) < 1000  # two pictures from before the fall
    assert sum(age > 250 for age in ages) <= 4
    assert run.rates[199] < 450
    assert run.rates[-1] > 1200


def test_an_uneven_path_with_enough_capacity_is_used() -> None:
    run = Run(lambda ms: 0 if ms % 300 < 70 else 2500).go(30_000)
    later = run.rates[150:]
    assert sum(later) / len(later) > 1000
    assert run.age_ms(0.95, since_ms=5000) <= 150


def test_little_is_sent_during_a_stall_and_it_resumes_soon_after() -> None:
    run = Run(lambda ms: 0 if 10_000 <= ms < 15_000 else 1500).go(20_000)
    stuck = [captured for captured, _ in run.ages_ms if 10_000 <= captured < 15_000]
    assert len(stuck) <= 25
    assert any(15_000 <= captured < 15_300 for captured, _ in run.ages_ms)
    assert run.age_ms(1.0, since_ms=15_500) < 200


def test_on_a_path_with_pauses_the_rate_stays_where_few_pictures_are_late() -> None:
    often = Run(lambda ms: 0 if ms % 1000 < 150 else 2000).go(60_000)
    seldom = Run(lambda ms: 0 if ms % 10_000 < 150 else 2000).go(60_000)
    assert min(often.rates[50:]) >= 270, "below that, the silences are the path's own"
    assert sum(often.rates[200:]) < 0.7 * sum(seldom.rates[200:])
    for run in (often, seldom):
        assert run.age_ms(0.99, since_ms=5000) < 283


def test_over_a_mobile_network_pictures_are_rarely_older_than_necessary() -> None:
    trace, seconds = traces.synthetic(), 60
    run = Run(lambda ms: trace.kbit(ms, ms + 1) * 1000, most_kbit_s=1843).go(seconds * 1000)
    came = sorted((captured + age, captured) for captured, age in run.ages_ms)
    newest, late, steps = 0, 0, 0
    for ms in range(1000, seconds * 1000, 5):
        while came and came[0][0] <= ms:
            newest = max(newest, came.pop(0)[1])
        carries = trace.kbit(ms // 1000 * 1000, ms // 1000 * 1000 + 1000) >= 300
        steps += carries
        late += carries and ms - newest > 283 and trace.waits_ms(ms - 20) + 20 <= 283
    assert late / steps < 0.04
    assert run.age_ms(0.95) < 250
    assert sum(run.rates) / len(run.rates) > 300


def test_a_small_picture_is_sent_now_and_then_during_a_stall() -> None:
    rate = StreamRate(2000, 0)
    for seq in range(1, 4):
        rate.sent(seq, 1000, seq * 33 * MS)
        rate.acknowledged(seq, (seq * 33 + 45) * MS)
    begun, seq, before = [], 3, rate.kbit_s
    for ms in range(200, 2200, 33):
        if rate.may_send(ms * MS):
            seq += 1
            rate.sent(seq, 300, ms * MS)
            begun.append(ms)
    pauses = [later - earlier for earlier, later in pairwise(begun[3:])]
    assert 4 <= len(pauses) <= 14
    assert min(pauses) >= 150
    assert rate.kbit_s == pytest.approx(before / 2), "it fell once"


def test_longer_stalls_queue_less_and_a_fresh_picture_comes_first() -> None:
    rate = StreamRate(2000, 0)
    for seq in range(1, 4):
        rate.sent(seq, 1000, seq * 33 * MS)
        rate.acknowledged(seq, (seq * 33 + 45) * MS)
    begun, seq = [], 3
    for ms in range(200, 8200, 33):
        if rate.may_send(ms * MS):
            seq += 1
            rate.sent(seq, 1000, ms * MS)
            begun.append(ms)
    pauses = [later - earlier for earlier, later in pairwise(begun)]
    assert all(pause <= max(1000 * PROBE_S, SELDOM * ms * 1.5) + 33 for ms, pause in zip(begun, pauses, strict=False))
    assert len([ms for ms in begun if 500 < ms < 4500]) <= 12
    assert all(1000 * SELDOM_S <= pause <= 1000 * SELDOM_S + 33 for pause in pauses[-4:])
    rate.acknowledged(4, 8230 * MS)  # long given up
    assert rate.may_send(8231 * MS), "the path is open again"
    for again in range(1, 4):
        rate.sent(seq + again, 1000, (8231 + again) * MS)
    assert not rate.may_send(8240 * MS), "and then as usual"


@pytest.mark.parametrize("loss", [0.02, 0.1])
def test_loss_does_not_end_the_stream(loss: float) -> None:
    run = Run(lambda _: 1000, loss=loss).go(20_000)
    assert len(run.ages_ms) > 0.5 * 20_000 / PERIOD_MS
    assert min(run.rates) >= LEAST_KBIT_S


@given(
    st.lists(
        st.tuples(st.sampled_from(("send", "ack", "wait")), st.integers(0, 60), st.integers(0, 5000)), max_size=200
    )
)
def test_the_rate_stays_in_its_range_and_sending_continues_whatever_is_acknowledged(
    events: list[tuple[str, int, int]],
) -> None:
    rate, now_ns, seq = StreamRate(2000, 0), 0, 0
    for what, number, size in events:
        now_ns += number * MS
        if what == "send" and rate.may_send(now_ns):
            seq += 1
            rate.sent(seq, size, now_ns)
        elif what == "ack":
            rate.acknowledged(max(0, seq - number), now_ns)
        assert LEAST_KBIT_S <= rate.kbit_s <= 2000
    assert rate.may_send(now_ns + round(2 * LOST_S * 1e9))


def test_acknowledgements_of_unsent_pictures_change_nothing() -> None:
    rate = StreamRate(2000, 0)
    rate.acknowledged(7, MS)
    rate.sent(1, 1000, 2 * MS)
    rate.acknowledged(0, 3 * MS)
    assert (rate.kbit_s, rate.lost, rate.wait_s) == (300, 0, 0.0)


def test_forgotten_pictures_delay_nothing() -> None:
    rate = StreamRate(2000, 0)
    for seq in range(1, 5):
        rate.sent(seq, 5000, seq * MS)
    assert not rate.may_send(200 * MS)
    rate.forget()
    assert rate.may_send(200 * MS)
    rate.acknowledged(3, 210 * MS)
    assert (rate.lost, rate.wait_s) == (0, 0.0)


def test_the_size_of_pictures_follows_the_rate() -> None:
    vga = 640 * 480 * 30
    assert picture_form(2000, vga) == (1.0, 1.0)
    scales = [picture_form(kbit_s, vga) for kbit_s in (2000, 400, 200, 70, 60)]
    assert scales == sorted(scales, reverse=True)
    assert picture_form(1, vga) == (0.25, 0.5)
