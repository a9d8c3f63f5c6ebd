"""``benchmarks.codecs``: a short run gives every figure, of work that does what it says. How fast is not asked."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import codecs, tables
from benchmarks.command import build
from skyloop.drivers.live_frames import Coded
from skyloop.vehicles.ardrone.video import PaveVideo
from skyloop.vehicles.ardrone.wire import navdata
from skyloop.vehicles.ardrone.wire.options import LAYOUTS

SHORT_S = 0.5


def test_the_command_measures_everything_prints_and_writes(tmp_path: Path) -> None:
    pytest.importorskip("av")
    arguments = ["--seconds", str(SHORT_S), "--output", str(tmp_path)]
    ended = CliRunner().invoke(build("codecs"), arguments, env={"COLUMNS": "160"})
    assert ended.exit_code == 0, ended.output
    results = msgspec.json.decode((tmp_path / "codecs.json").read_bytes(), type=codecs.CodecResults)
    assert [(row.what, row.of, row.target) for row in results.rows] == [
        ("UVLC, encode", "a rendered picture, 320×240", 15.0),
        ("UVLC, decode to BGR", "a rendered picture, 320×240", 15.0),
        ("UVLC, encode", "noise, 320×240", 15.0),
        ("UVLC, decode to BGR", "noise, 320×240", 15.0),
        ("H.264, decode to BGR", "a rendered picture, 640×360", None),
        ("navdata, decode", f"all {len(LAYOUTS)} options", None),
    ]
    for row in results.rows:
        assert row.once.samples >= 3
        assert 0 < row.once.median_us <= row.once.p99_us
        # Half of the calls took the median or longer.
        assert 0 < row.per_s <= 2.01e6 / row.once.median_us
        assert row.what in ended.output
    assert "a second on one core" in ended.output
    rendered, noise = results.rows[0], results.rows[2]
    assert 1_000 < rendered.size < noise.size < 65_536
    shown = tables.codecs_table(results).rows
    assert [row[5] for row in shown] == ["≥ 15"] * 4 + [""] * 2


def test_the_pictures_are_of_a_flight_and_decoded_to_what_they_were() -> None:
    pytest.importorskip("av")
    small, pictures = codecs.rendered(3)
    assert [image.shape for image in small] == [(240, 320, 3)] * 3
    assert [image.shape for image in pictures] == [(480, 640, 3)] * 3
    assert not np.array_equal(pictures[0], pictures[2])
    frames = codecs.h264(pictures)
    assert [frame.is_key for frame in frames] == [True, False, False]
    video = PaveVideo()
    for frame, image in zip(frames, pictures, strict=True):
        decoded = video.decode(Coded(frame, frame.is_key, 0, 0, 0), show=True)
        assert decoded is not None
        assert float(np.abs(decoded[1].astype(int) - image[:360]).mean()) < 12.0


def test_the_datagram_is_full() -> None:
    decoded = navdata.decode(codecs.full_navdata())
    assert set(decoded.options) == set(LAYOUTS)
    assert not decoded.unknown


def test_without_pyav_h264_is_left_out_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    shares: list[float] = []
    results = codecs.measure_here(0.01, shares.append)
    assert [row.what.split(",")[0] for row in results.rows] == ["UVLC"] * 4 + ["navdata"]
    assert "skyloop install video" in results.skipped["H.264"]
    assert "left out" in tables.codecs_table(results).rows[-1][1]
    assert shares == sorted(shares)
