"""Short runs with others about, with real processes; how fast things are is no matter of a test."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from benchmarks import load
from benchmarks.disk import DISK_MB, small_disk
from benchmarks.load import FULL, KILLED, RECORDED, Case, cases_of, pages_name
from benchmarks.measuring.schedule import CHANNELS, MIDDLE, Turn
from benchmarks.onlookers import cockpit_problem, recorder_problem, view_problem
from benchmarks.slow import SLOW_VIDEO
from skyloop.errors import UsageError
from tests.benchmarks.working import plausible

SHORT_S = 0.5
pytestmark = pytest.mark.process


def test_others_about() -> None:
    cases = [Case(load.SLOW, slow=True), Case("two, one stopped", observers=2, stuck=True)]
    shares: list[float] = []
    results = load.measure(SHORT_S, cases, progress=lambda share, _: shares.append(share))
    assert shares == sorted(shares)
    turn = Turn(0, SHORT_S)
    for result in results.cases:
        for channel in CHANNELS:
            plausible(result.channels[channel], turn.count(channel))
        assert result.cpu["proxy"] >= 0.0
    by_name = {result.case: result for result in results.cases}
    slow = by_name[load.SLOW].channels[SLOW_VIDEO]
    assert 1 <= slow.samples <= SHORT_S / 0.2 + 2  # the others were dropped for it, and only for it
    observed = by_name["two, one stopped"]
    plausible(observed.channels["video, observers"], turn.count("video"))  # of the one that went on
    assert "observers" in observed.cpu


def test_a_recorder_alive_and_killed(tmp_path: Path) -> None:
    if problem := recorder_problem():
        pytest.skip(problem)
    cases = [case for case in cases_of([], slow_processor=False, stuck=False, disk_full=False) if case.recorder]
    assert len(cases) == 2
    results = load.measure(SHORT_S, cases, record_to=tmp_path)
    recorded, killed = results.cases
    assert (recorded.case, killed.case) == (RECORDED, KILLED)
    assert recorded.recorder_lost is not None
    assert sum(recorded.recorder_lost.values()) == 0
    assert killed.recorder_lost is None
    for result in results.cases:
        plausible(result.channels["command"], Turn(0, SHORT_S).count("command"))
    assert list(tmp_path.glob("*.mcap"))


@pytest.fixture
def disk() -> Iterator[Path]:
    with suppress(UsageError), small_disk() as folder:
        yield folder
        return
    pytest.skip("mounting a small disk needs the right to")


def test_a_small_disk_is_small_and_goes_again(disk: Path) -> None:
    assert shutil.disk_usage(disk).total <= DISK_MB << 20
    assert disk.stat().st_mode & 0o077 == 0


def test_where_none_can_be_mounted_another_serves_if_it_is_nearly_full(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    with small_disk(disk) as folder:
        assert folder == disk
    with pytest.raises(UsageError, match=r"only root may mount a small disk, and --record-to names no"), small_disk():
        pass
    with pytest.raises(UsageError, match=r"MB left, more than the 16 to fill"), small_disk(tmp_path):
        pass


def test_a_recorder_whose_disk_is_full(disk: Path) -> None:
    if problem := recorder_problem():
        pytest.skip(problem)
    cases = [case for case in cases_of([], slow_processor=False, stuck=False, recorder=False) if case.recorder]
    [result] = load.measure(1.0, cases).cases
    assert result.case == FULL
    assert "No space left" in result.recorder_stopped
    plausible(result.channels["command"], Turn(0, 1.0).count("command"))


def test_a_disk_that_can_not_be_had_is_left_out_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    cases = [Case(load.ALONE), Case(FULL, recorder=True, disk_full=True, size=MIDDLE)]
    results = load.measure(SHORT_S, cases)
    assert [result.case for result in results.cases] == [load.ALONE]
    assert results.skipped[FULL].startswith("only root may mount")


def test_pages_of_a_cockpit() -> None:
    if problem := cockpit_problem():
        pytest.skip(problem)
    [case] = [case for case in cases_of([], slow_processor=False, stuck=False, recorder=False, pages=2) if case.pages]
    [result] = load.measure(1.0, [case]).cases
    assert (result.case, result.pages, result.size) == (pages_name(2), 2, str(MIDDLE))
    turn = Turn(0, 1.0)
    plausible(result.channels["command"], turn.count("command"))
    seen = result.channels["video, pages"]
    assert 2 <= seen.samples <= seen.samples + seen.lost == 2 * turn.count("video")
    assert 0 < seen.median_us < 1e6
    assert {"cockpit", "pages"} <= set(result.cpu)


def test_a_viewer_of_foxglove_s_server_that_is_stopped() -> None:
    if problem := view_problem():
        pytest.skip(problem)
    every = cases_of([], slow_processor=False, stuck=False, recorder=False, disk_full=False, viewed=True)
    [_, _, case] = [case for case in every if case.size == MIDDLE]
    [result] = load.measure(SHORT_S, [case]).cases
    assert (result.case, result.size) == (load.VIEWED_STUCK, str(MIDDLE))
    plausible(result.channels["command"], Turn(0, SHORT_S).count("command"))
    assert "view" in result.cpu
