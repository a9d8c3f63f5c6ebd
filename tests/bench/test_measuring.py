"""Short runs of what measures delays, with real processes; how fast things are is no matter of a test."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from skyloop.bench import delays, load, loop
from skyloop.bench.disk import DISK_MB, small_disk
from skyloop.bench.load import FULL, KILLED, RECORDED, Case, cases_of, pages_name
from skyloop.bench.loop import STAGES, TOTAL, Trip
from skyloop.bench.machine import Machine
from skyloop.bench.onlookers import cockpit_problem, recorder_problem
from skyloop.bench.pair import Pair
from skyloop.bench.peers import PEERS, chosen, find
from skyloop.bench.schedule import CHANNELS, LARGE, MIDDLE, SMALL, Turn
from skyloop.bench.slow import SLOW_VIDEO
from skyloop.bench.statistics import Summary
from skyloop.bench.workers import Workers
from skyloop.cli.app import build
from skyloop.errors import LinkError, NoAnswerError, UnknownNameError, UsageError
from tests.bench import working

SHORT_S = 0.5
pytestmark = pytest.mark.process


def plausible(summary: Summary, sent: int) -> None:
    assert 0.3 * sent <= summary.samples <= sent  # a crowded machine leaves some out
    assert summary.samples + summary.lost == sent
    assert 0 < summary.minimum_us <= summary.median_us <= summary.p99_us <= summary.p999_us <= summary.maximum_us < 1e6


def test_the_command_measures_prints_and_writes(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    arguments = ["delays", "--seconds", str(SHORT_S), "--output", str(tmp_path)]
    ended = CliRunner().invoke(build(["bench"]), ["bench", *arguments])
    assert ended.exit_code == 0, ended.output
    for words in ("Table 1", "the paper's mean", "0.091", "Skyloop", "bare hand-over", "median to the floor's"):
        assert words in ended.output, words
    assert {file.suffix for file in tmp_path.iterdir()} == {".json", ".png", ".svg"}
    results = delays.load(tmp_path / "delays.json")
    assert json.loads((tmp_path / "delays.json").read_bytes())["what"] == "delays"
    assert (results.sizes, list(results.contenders)) == ([str(SMALL)], ["floor", "skyloop"])
    assert msgspec.structs.replace(Machine.here(), load=results.machine.load) == results.machine
    turn = Turn(0, SHORT_S)
    for name in results.contenders:
        for channel in CHANNELS:
            summary = results.summary(name, str(SMALL), channel)
            assert summary is not None
            plausible(summary, turn.count(channel))
    for series in results.series:
        assert len(series.at_s) == len(series.delay_us) >= 0.3 * turn.count(series.channel)
        assert series.at_s == sorted(series.at_s)
        assert 0.0 <= series.at_s[0] <= series.at_s[-1] <= SHORT_S + 0.1


@pytest.mark.parametrize("name", list(PEERS))
def test_a_peer_carries_everything(name: str) -> None:
    found, skipped = find([name])
    if not found:
        pytest.skip(skipped[name])
    [peer] = found
    turn = Turn(0, SHORT_S)
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, Workers() as workers:
        pair = Pair(workers, peer.module, folder, python=peer.python)
        arrivals = pair.measure(turn)
    for channel in CHANNELS:
        assert 0.6 * turn.count(channel) <= len(arrivals[channel]) <= turn.count(channel)
        assert all(sent_ns < heard_ns for sent_ns, heard_ns in arrivals[channel])


def test_what_is_not_installed_is_left_out_with_a_reason(tmp_path: Path) -> None:
    found, skipped = find(["ros2"], str(tmp_path / "python"))
    assert found == []
    assert "does not run" in skipped["ros2"]
    assert "ros-rclpy" in skipped["ros2"]
    bare = tmp_path / "python3"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')  # an interpreter without any package
    bare.chmod(0o755)
    found, skipped = find(["ros2"], str(bare))
    assert "No module named" in skipped["ros2"]


def test_peers_by_name() -> None:
    assert chosen("all") == list(PEERS)
    assert chosen("none") == []
    assert chosen("zeromq, zenoh,zeromq") == ["zeromq", "zenoh"]
    with pytest.raises(UnknownNameError, match="did you mean 'zenoh'"):
        chosen("zenho")


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


def test_the_loop_by_stage() -> None:
    results = loop.measure(SHORT_S, [SMALL, LARGE])
    assert [one.size for one in results.sizes] == [str(SMALL), str(LARGE)]
    for one in results.sizes:
        assert list(one.stages) == [*STAGES, TOTAL]
        for summary in one.stages.values():
            plausible(summary, Turn(0, SHORT_S, frame_period_s=loop.FRAME_PERIOD_S).count("video"))
        parts = sum(one.stages[stage].mean_us for stage in STAGES)
        assert one.stages[TOTAL].mean_us == pytest.approx(parts)


def test_the_stages_of_a_trip() -> None:
    stages = Trip(1000, 1010, 1110, 1200, 1240, 1300).stages_ns()
    assert stages == {"published": 10, "delivered": 100, "controller": 90, "sent": 40, "applied": 60, "total": 300}


def test_a_worker_that_fails_or_is_silent_is_told(capfd: pytest.CaptureFixture[str]) -> None:
    with Workers() as workers:
        with pytest.raises(LinkError, match="fails"):
            workers.start(working.fails).answer(20.0)
        with pytest.raises(NoAnswerError, match="is_silent"):
            workers.start(working.is_silent).answer(0.2)
        echo = workers.start(working.echo, 3)
        assert echo.answer(20.0) == 3
        addresses = "127.0.0.1 " * 100
        talkative = workers.start(working.echo, addresses)
        assert talkative.answer(20.0) == addresses
        with pytest.raises(NoAnswerError) as caught:
            talkative.answer(0.0)
        assert len(str(caught.value)) < 150, "no list of all addresses"
    assert "RuntimeError: on purpose" in capfd.readouterr().err
