"""Video over a mobile network's uplink: pure traces and figures, and some seconds of real video between two hosts."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import moving_scene, video_path
from benchmarks.hosts import traces
from benchmarks.hosts.impairments import Impairments, Way
from benchmarks.hosts.traces import Modem, Trace
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, SMALL, VIDEO, Size
from benchmarks.over_path import FIXED_KBIT_S, NO_VIDEO
from skyloop.bench import Machine
from skyloop.errors import UsageError

MS = 1_000_000
SECONDS = 15.0
OUTAGE_MS = (3000, 5000)
#: After an outage the first packet passes alone, and the next ones slowly: each answer takes a while.
SLOW = ((5000, 48), (5250, 8640), (5500, 3840), (5750, 3360), (6000, 4512), (6250, 6576), (6500, 2496), (6750, 4000))
BACK_WITHIN_MS = 5000


def test_packets_leave_with_the_opportunities_of_the_trace() -> None:
    modem = Modem(Trace("made up", (2, 5, 5, 9, 20), queue=6000))
    assert modem.leaves_ns(1000, 0) == 2 * MS
    assert modem.leaves_ns(500, 1 * MS) == 2 * MS, "it fits beside the first"
    assert modem.leaves_ns(3000, 2 * MS) == 5 * MS, "larger ones use several opportunities"
    assert modem.leaves_ns(1, 6 * MS) == 9 * MS
    assert modem.leaves_ns(1500, 10 * MS) == 20 * MS
    assert modem.leaves_ns(1500, 21 * MS) == 22 * MS, "the trace is repeated"


def test_a_full_queue_drops_packets() -> None:
    modem = Modem(Trace("made up", (100,), queue=3000))
    assert [modem.leaves_ns(1500, 0) for _ in range(3)] == [100 * MS, 200 * MS, None]
    assert modem.leaves_ns(1500, 100 * MS) == 300 * MS


@given(
    st.lists(st.integers(0, 50), min_size=1, max_size=30).map(sorted).filter(lambda times: times[-1] > 0),
    st.lists(st.tuples(st.integers(0, 30 * MS), st.integers(1, 3000)), max_size=50),
)
def test_packets_leave_in_order_never_early_and_never_beyond_the_capacity(
    times: list[int], packets: list[tuple[int, int]]
) -> None:
    trace = Trace("made up", tuple(times), queue=1_000_000)
    modem, now_ns, last_ns, size = Modem(trace), 0, 0, 0
    for pause_ns, length in packets:
        now_ns += pause_ns
        leaves_ns = modem.leaves_ns(length, now_ns)
        assert leaves_ns is not None
        assert leaves_ns >= max(now_ns, last_ns)
        last_ns, size = leaves_ns, size + length
    turns, ms = divmod(last_ns // MS, trace.length_ms)
    possible = turns * trace.kbit(0, trace.length_ms + 1) + trace.kbit(0, ms + 1)
    assert size * 8e-3 <= possible


def test_a_path_has_its_own_delay_beside_the_trace() -> None:
    way = Way(0, Impairments(delay_s=0.02, trace=Trace("made up", (10, 1000), queue=1500)))
    way.put(b"first", 0)
    way.put(bytes(1500), 0)
    assert (way.next_ns, way.lost) == (30 * MS, 1)


def test_the_synthetic_trace_is_like_a_phones_in_a_car() -> None:
    trace = traces.synthetic()
    assert trace == traces.synthetic()
    assert trace != traces.synthetic(2)
    seconds = sorted(trace.kbit(begin, begin + 1000) for begin in range(0, trace.length_ms, 1000))
    assert 1000 < sum(seconds) / len(seconds) < 3000
    assert 5 <= sum(kbit < 300 for kbit in seconds) <= 15, "there are bad seconds"
    assert seconds[len(seconds) // 2] > 600


@pytest.mark.parametrize("times", [(), (0,), (-1, 3), (3, 2)])
def test_times_that_do_not_form_a_trace_are_refused(times: tuple[int, ...]) -> None:
    with pytest.raises(UsageError, match="trace bad"):
        Trace("bad", times)
    with pytest.raises(UsageError, match="no trace 'unheard-of'"):
        traces.find(("unheard-of",))


@pytest.mark.parametrize("size", [SMALL, Size(640, 480)])
def test_a_picture_carries_its_stamp_and_follows_from_it(size: Size) -> None:
    scene = moving_scene.MovingScene(size)
    stamp_ns = 123_456_789 * moving_scene.STAMP_NS
    picture = scene.picture(stamp_ns + 1)
    assert moving_scene.stamp_in(picture, stamp_ns + 400 * MS) == stamp_ns
    assert moving_scene.psnr_db(picture, scene.picture(stamp_ns)) > 70
    assert moving_scene.psnr_db(picture, scene.picture(stamp_ns + 500 * MS)) < 25


def test_only_time_with_enough_capacity_counts() -> None:
    # A second of 600 kbit/s, one of nothing, one of 600 again; a picture every 100 ms, 50 ms old, none in the second.
    trace = Trace("made up", tuple(second * 1000 + ms for second in (0, 2) for ms in range(0, 1000, 20)))
    pictures = [(ms * MS, (ms + 50) * MS) for ms in (*range(0, 900, 100), *range(2000, 2900, 100))]
    late = (900 * MS, 1500 * MS)
    arrivals = {VIDEO: [*pictures, late], COMMAND: pictures[:5], FEEDBACK: [], "quality 30": pictures[:2]}
    case = video_path.judge("made up", trace, 3.0, 0, arrivals, 75_000)
    assert case.good_share == pytest.approx(2 / 3)
    assert case.video == video_path.Ages(50, 50, 50)
    assert (case.pictures_per_s, case.psnr_db, case.feedback) == (9, 30, None)
    assert (case.carried_kbit_s, case.sent_kbit_s) == (400, 200)
    assert case.frozen_share == pytest.approx(50 / 1717, abs=0.01), "until the third second's first picture"
    assert case.unavoidable_share == pytest.approx(20 / 1717, abs=0.01)
    assert case.frozen_of_all == pytest.approx((2050 - 1083) / 2717, abs=0.01)
    assert case.unavoidable_of_all == pytest.approx((2020 - 1263) / 2717, abs=0.01)
    assert "50, 50, 50" in video_path.table(video_path.VideoPath(_machine(), 3.0, [case])).markdown()


def _machine() -> Machine:
    return Machine("cpu", 2, "system", "kernel", "3.11")


@pytest.mark.usefixtures("_possible")
def test_on_a_bad_uplink_the_picture_stays_fresh_and_commands_are_not_delayed() -> None:
    pytest.importorskip("zenoh")
    pytest.importorskip("av", reason="H.264 needs the extra 'video'")
    quiet, watched = video_path.measure(SECONDS, [traces.synthetic()], [NO_VIDEO, "H.264, adaptive"]).cases
    assert watched.video is not None
    assert watched.command is not None
    assert quiet.command is not None
    # The figures themselves belong to the benchmark: a busy machine adds to each of them.
    assert watched.video.p50 < 300
    assert watched.pictures_per_s > 5
    assert watched.command.p95 < quiet.command.p95 + 150
    assert watched.commands_share > 0.7


@pytest.mark.usefixtures("_possible")
def test_after_an_outage_the_link_comes_back_under_a_stream_of_fixed_rate() -> None:
    """One end noticed that the links ended and the other did not, or one end gave up a link that was just made."""
    pytest.importorskip("zenoh")
    pytest.importorskip("av", reason="H.264 needs the extra 'video'")
    begin_ms, end_ms = OUTAGE_MS
    times = [*range(begin_ms), *(at for from_ms, kbit_s in SLOW for at in _spread(from_ms, kbit_s))]
    trace = Trace("outage", (*times, *range(7000, 60_000, 3)))
    [found] = video_path.measure(12.0, [trace], [f"H.264, {FIXED_KBIT_S} kbit/s"]).cases
    back = [at for at, _ in found.shown if at > end_ms]
    assert any(at < begin_ms for at, _ in found.shown)
    assert back
    assert back[0] < end_ms + BACK_WITHIN_MS
    assert found.commands_share > 0.4


def _spread(from_ms: int, kbit_s: int) -> list[int]:
    """Return times for this many packets a second, evenly over 250 ms."""
    count = round(kbit_s / (8e-3 * traces.OPPORTUNITY * 4))
    return [from_ms + (250 * n + 125) // count for n in range(count)]
