"""``skyloop bench``: short runs with real processes; no test checks speed."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from skyloop import bench
from skyloop.bench import PERIODS_S, Machine, SimResults, Spread, cpu_model, numbers_of, os_name, spread
from skyloop.cli.app import build
from skyloop.cli.bench import What, drawing_table, parse_sizes, physics_table
from skyloop.errors import LinkError, UsageError
from skyloop.sim import STEP_S

PAGE = Path(__file__).parents[2] / "docs" / "delays.md"
SHORT_S = 0.5


@pytest.fixture(scope="module", autouse=True)
def sockets() -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield


def plausible(found: Spread, least: int) -> None:
    assert found.samples >= least
    assert 0 < found.median_us <= found.p99_us < 60e6


# The command line ---------------------------------------------------------------------------------------------------


def test_sizes() -> None:
    assert parse_sizes(None) == [(320, 240)]
    assert parse_sizes("640x480, 320×240,640x480") == [(640, 480), (320, 240)]
    assert parse_sizes("16x16") == [(16, 16)]


@pytest.mark.parametrize("text", ["", "320", "320x", "0x240", "-1x5", "4000x3000", "axb"])
def test_invalid_sizes_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="not a frame size"):
        parse_sizes(text)


@pytest.mark.parametrize("arguments", [["sim", "--sizes", "1x1"], ["delays", "--sizes", "x"]])
def test_usage_errors_come_before_anything_is_measured(arguments: list[str]) -> None:
    with pytest.raises(UsageError):
        build(["bench"])(["bench", *arguments], standalone_mode=False)


def test_the_page_shows_what_is_measured() -> None:
    for what in What:
        assert f"skyloop bench {what.value}" in PAGE.read_text()


# Delays -------------------------------------------------------------------------------------------------------------


@pytest.mark.process
def test_delays_are_measured_beside_the_bare_hand_over() -> None:
    ended = CliRunner().invoke(build(["bench"]), ["bench", "delays", "--seconds", str(SHORT_S), "--json"])
    assert ended.exit_code == 0, ended.output
    found = json.loads(ended.output)
    assert found["what"] == "delays"
    assert set(found["machine"]) >= {"cpu", "cores", "system", "kernel", "python", "packages", "load"}
    assert [(row["size"], row["channel"]) for row in found["rows"]] == [("320×240", channel) for channel in PERIODS_S]
    for row in found["rows"]:
        sent = int(SHORT_S / PERIODS_S[row["channel"]])
        for who in ("skyloop", "bare"):
            plausible(msgspec.convert(row[who], Spread), round(0.3 * sent))  # a crowded machine skips some
        assert (
            row["skyloop"]["samples"] + row["lost"] >= sent
        )  # one more if the last sample of the warm-up was sent late


@pytest.mark.process
def test_a_failing_process_is_reported(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    turn = bench._Turn(0, SHORT_S, (320, 240))
    with bench._Pair(bench.BARE, str(tmp_path / "no-such-folder")) as pair, pytest.raises(LinkError, match="ended"):
        pair.measure(turn)
    assert "FileNotFoundError" in capfd.readouterr().err


@given(st.integers(0, 2**60), st.integers(0, 10**12))
def test_a_command_carries_its_time_to_the_last_bit(sent_ns: int, later_ns: int) -> None:
    up = bench.stamped(sent_ns)
    assert 0.0 <= up < 0.02
    assert bench.stamp_of(up, sent_ns + later_ns) == sent_ns


def test_a_channel_without_samples_has_no_figure() -> None:
    with pytest.raises(ValueError, match="not one sample"):
        spread([])


def test_the_machine_without_names() -> None:
    assert cpu_model("processor : 0\nmodel name\t: AMD  EPYC 7\nmodel name\t: other\n") == "AMD EPYC 7"
    assert cpu_model("Hardware : BCM2711") == ""
    assert os_name('NAME="Debian"\nPRETTY_NAME="Debian GNU/Linux 12 (bookworm)"\n') == "Debian GNU/Linux 12 (bookworm)"
    assert os_name("") == ""
    assert numbers_of("6.1.0-13-amd64-built-by-somebody") == "6.1.0"
    here = str(Machine.here())
    assert os.uname().nodename not in here
    assert f"{Machine.here().cores} cores" in here


# The simulator ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured() -> tuple[SimResults, list[float]]:
    shares: list[float] = []
    return bench.measure_sim(0.3, lambda share, _what: shares.append(share)), shares


def test_physics_is_measured_for_each_fleet(measured: tuple[SimResults, list[float]]) -> None:
    rows = measured[0].physics
    assert [bench.BenchFleet(row.world, row.drones, row.model, row.firmware) for row in rows] == list(bench.FLEETS)
    for row in rows:
        plausible(row.step, bench.LEAST_ROUNDS)
        # Half of the batches took the median or longer, so all together took at least half of the median each.
        assert 0 < row.real_time <= 2.01 * STEP_S * 1e6 / row.step.median_us


def test_drawing_is_measured_for_each_camera_and_size(measured: tuple[SimResults, list[float]]) -> None:
    rows = measured[0].drawing
    assert [(row.cameras, row.width, row.height, row.pictures) for row in rows] == [
        ("front", 320, 240, 1),
        ("bottom", 320, 240, 1),
        ("front and bottom", 320, 240, 2),
        ("front", 640, 480, 1),
        ("bottom", 640, 480, 1),
        ("front and bottom", 640, 480, 2),
        ("10 × front", 320, 240, 10),
    ]
    for row in rows:
        plausible(row.round, bench.LEAST_ROUNDS)
        assert row.frames_per_s > 0
    for front, bottom, both in (rows[:3], rows[3:6]):
        # The time for both is the sum of the times for each, so two pictures take as long as the two rates imply.
        assert 2 / both.frames_per_s == pytest.approx(1 / front.frames_per_s + 1 / bottom.frames_per_s)


def test_progress_rises_to_the_end(measured: tuple[SimResults, list[float]]) -> None:
    shares = measured[1]
    assert shares == sorted(shares)
    assert 0 < shares[0] < 1
    assert shares[-1] == pytest.approx(1.0)


def test_opencv_gets_its_threads_back() -> None:
    before = cv2.getNumThreads()
    with bench._one_core():
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == before


def test_the_simulator_is_printed(
    measured: tuple[SimResults, list[float]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[float] = []

    def known(seconds: float, progress: bench.Progress) -> SimResults:
        asked.append(seconds)
        progress(1.0, "all")
        return measured[0]

    monkeypatch.setattr(bench, "measure_sim", known)
    result = CliRunner().invoke(build(["bench"]), ["bench", "sim", "--seconds", "5"], env={"COLUMNS": "120"})
    assert result.exit_code == 0, result.output
    assert asked == [5.0]
    assert "Physics alone" in result.output
    assert "10 × front" in result.output
    assert physics_table(measured[0]).row_count == drawing_table(measured[0]).row_count == 7
