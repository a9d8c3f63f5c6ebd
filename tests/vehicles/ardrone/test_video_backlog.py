"""Which frames are decoded and shown, and capture times: pure decisions."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from skyloop.drivers.live_video import LATE_NS, MAX_FRAMES, Coded, FrameBacklog
from skyloop.vehicles.ardrone.video import DroneStamps

MS = 1_000_000


def coded(n: int, *, key: bool = False, arrived_ns: int = 0) -> Coded:
    return Coded(bytes([n % 256]), key, n, arrived_ns, 0)


def drain(backlog: FrameBacklog, now_ns: int) -> list[tuple[int, bool]]:
    taken = []
    while len(backlog):
        frame, show = backlog.take(now_ns)
        taken.append((frame.captured_ns, show))
    return taken


def test_in_time_every_frame_is_decoded_and_shown() -> None:
    backlog = FrameBacklog()
    for n in range(4):
        backlog.put(coded(n, key=n == 2), wanted=True)
    assert drain(backlog, LATE_NS) == [(n, True) for n in range(4)]
    assert backlog.skipped == 0


def test_when_late_it_skips_to_the_newest_key_frame_and_shows_only_the_newest() -> None:
    backlog = FrameBacklog()
    for n in range(9):
        backlog.put(coded(n, key=n in (0, 3, 6)), wanted=True)
    assert drain(backlog, LATE_NS + 1) == [(6, False), (7, False), (8, True)]
    assert backlog.skipped == 8


def test_late_without_a_key_frame_all_are_decoded_and_the_newest_is_shown() -> None:
    backlog = FrameBacklog()
    for n in range(3):
        backlog.put(coded(n), wanted=True)
    backlog.put(coded(3, arrived_ns=2), wanted=True)
    backlog.put(coded(4, arrived_ns=2), wanted=True)
    assert drain(backlog, LATE_NS + 1) == [(0, False), (1, False), (2, False), (3, True), (4, True)]
    assert backlog.skipped == 3


def test_without_viewers_the_frames_since_the_newest_key_frame_are_kept_and_none_counts_as_skipped() -> None:
    backlog = FrameBacklog()
    for n in range(1000):
        backlog.put(coded(n, key=n % 15 == 0), wanted=False)
    assert len(backlog) == 1000 % 15
    assert drain(backlog, 1 << 60) == [*((n, False) for n in range(990, 999)), (999, True)]
    assert backlog.skipped == 0


def test_an_overflow_drops_the_oldest() -> None:
    backlog = FrameBacklog()
    for n in range(MAX_FRAMES + 5):
        backlog.put(coded(n), wanted=True)
    assert [number for number, _ in drain(backlog, 0)] == list(range(5, MAX_FRAMES + 5))
    assert backlog.skipped == 5


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), max_size=400))
def test_it_is_bounded_keeps_the_order_and_counts_every_wanted_frame(frames: list[tuple[bool, bool, bool]]) -> None:
    backlog = FrameBacklog()
    shown: list[int] = []
    wanted_shown = 0
    wants = [wanted for _, wanted, _ in frames]
    for n, (key, wanted, take) in enumerate(frames):
        backlog.put(coded(n, key=key, arrived_ns=n * 20 * MS), wanted=wanted)
        assert len(backlog) <= MAX_FRAMES
        if take:
            frame, show = backlog.take(n * 20 * MS)
            shown += [frame.captured_ns] * show
    for number, show in drain(backlog, len(frames) * 20 * MS):
        shown += [number] * show
    wanted_shown = sum(wants[n] for n in shown)
    assert shown == sorted(set(shown))
    assert backlog.skipped == sum(wants) - wanted_shown


def test_a_stamp_is_mapped_by_the_smallest_delay_seen() -> None:
    stamps = DroneStamps()
    delays_ms = [40, 12, 30, 12, 90, 15]
    taken = [stamps.captured_ns(1000 + 33 * n, (33 * n + delay) * MS) for n, delay in enumerate(delays_ms)]
    assert taken == [40 * MS, *((33 * n + 12) * MS for n in range(1, 6))]


def test_the_stale_first_frame_of_a_real_drone_does_not_shift_later_times() -> None:
    stamps = DroneStamps()
    assert stamps.captured_ns(1792570814, 0) == 0  # 6.3 s older than the next one, and 1 ms ahead of it
    assert stamps.captured_ns(1792577172, 1 * MS) == 1 * MS
    assert stamps.captured_ns(1792577204, 60 * MS) == 33 * MS


def test_stamps_wrap() -> None:
    stamps = DroneStamps()
    begin = (1 << 32) - 40
    taken = [
        stamps.captured_ns((begin + 33 * n) % (1 << 32), (33 * n + delay) * MS) for n, delay in enumerate([5, 9, 5, 25])
    ]
    assert taken == [(33 * n + 5) * MS for n in range(4)]


def test_a_restarted_drones_clock_is_learned_again() -> None:
    stamps = DroneStamps()
    for n in range(100):
        stamps.captured_ns(500_000 + 33 * n, (33 * n + 5) * MS)
    begin_ms = 30_000
    assert stamps.captured_ns(2_000, (begin_ms + 50) * MS) == (begin_ms + 50) * MS
    assert stamps.captured_ns(2_033, (begin_ms + 33 + 10) * MS) == (begin_ms + 43) * MS
    assert stamps.captured_ns(2_066, (begin_ms + 66 + 70) * MS) == (begin_ms + 76) * MS


def test_a_drifting_clock_is_followed() -> None:
    """100 ppm slow or fast, with 0 to 40 ms of jitter: never later than the arrival, and within 3 ms of the truth."""
    for drift in (-1e-4, 1e-4):
        rng = random.Random(5)
        stamps = DroneStamps()
        errors_ms = []
        for n in range(6000):  # 200 s
            true_ms = n * 33.0
            arrived_ns = round((true_ms + 8 + rng.random() ** 3 * 40) * MS)
            captured_ns = stamps.captured_ns(1_000_000 + round(true_ms * (1 + drift)), arrived_ns)
            assert captured_ns <= arrived_ns
            errors_ms.append(captured_ns / MS - true_ms - 8)
        assert max(abs(error) for error in errors_ms[100:]) < 3.0, drift


@given(st.lists(st.tuples(st.integers(0, (1 << 32) - 1), st.integers(0, 10**12)), max_size=30))
def test_any_stamps_give_times_that_are_not_later_than_the_arrival(pairs: list[tuple[int, int]]) -> None:
    stamps = DroneStamps()
    for stamp_ms, arrived_ns in sorted(pairs, key=lambda pair: pair[1]):
        assert stamps.captured_ns(stamp_ms, arrived_ns) <= arrived_ns
