"""``skyloop log export --to lerobot``: flights as episodes, in the files that LeRobot reads."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
import pytest

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import Attitude, Feedback
from skyloop.messages.rows import STATE
from skyloop.recording.layout import Channel
from skyloop.recording.reader import Recording
from skyloop.recording.review.episodes import Episode, RowFormat, episodes, row_format_of
from skyloop.recording.review.lerobot import export_lerobot
from skyloop.recording.review.tables import Table, tables
from tests.support.commands import Ended
from tests.support.recorded_flights import BEGIN_NS, HEIGHT, MS, WIDTH, Plan, feedback_at, picture_at, write_flight

Log = Callable[..., Ended]
CHANNELS = (Channel.FEEDBACK, Channel.COMMANDS, Channel.LOGS, Channel.FRAMES)
PLAN = Plan(seconds=8.0, lossy=False)
PYTHON = os.environ.get("SKYLOOP_LEROBOT_PYTHON", "")


def read(path: Path) -> dict[str, Table]:
    return tables(Recording.open(path), "alpha", CHANNELS)


def cut(path: Path, fps: float = 10.0, task: str = "circle") -> tuple[RowFormat, list[Episode]]:
    found = read(path)
    form = row_format_of(found, ["front"], fps)
    return form, episodes(found, form, task)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_flight(tmp_path / "flight.mcap", PLAN)


def test_an_episode_lasts_while_the_drone_follows_set_points(recording: Path) -> None:
    form, (episode,) = cut(recording)
    assert form == RowFormat(STATE, "velocity", ("front",), 10.0)
    assert form.action == ("forward", "left", "up", "yaw_rate")
    assert len(episode) == pytest.approx(0.55 * PLAN.seconds * 10, abs=2), "without take-off and landing"
    assert episode.task == "circle"
    assert episode.state.shape == (len(episode), 7)
    assert episode.action.shape == (len(episode), 4)


def test_the_state_is_taken_at_the_capture_of_the_image(recording: Path) -> None:
    form, (episode,) = cut(recording, fps=7.0)
    for row, captured_ns in enumerate(episode.frames_ns["front"]):
        at_ms = (int(captured_ns) - BEGIN_NS) / MS + 4  # feedback is captured 4 ms before its millisecond
        before = feedback_at(PLAN, int(at_ms // 20) * 20, 1)
        after = feedback_at(PLAN, int(at_ms // 20) * 20 + 20, 2)
        assert before.roll_rad is not None
        assert after.roll_rad is not None
        least, most = sorted((before.roll_rad, after.roll_rad))
        assert least - 1e-9 <= episode.state[row, form.state.index("roll_rad")] <= most + 1e-9
    yaw = episode.state[:, form.state.index("yaw_rad")]
    assert np.abs(yaw).max() <= np.pi, "the shorter way, even across the wrap"


def test_the_action_is_the_set_point_that_followed_the_image(recording: Path) -> None:
    _, (episode,) = cut(recording)
    commands = read(recording)["commands"]
    steps = np.arange(len(episode)) * (NS_PER_S // 10)
    begin_ns = round(0.25 * PLAN.seconds * 1000) * MS + BEGIN_NS - 4 * MS
    for row, by_ns in enumerate(begin_ns + steps + NS_PER_S // 10):
        newest = np.flatnonzero(commands["applied_ns"] <= by_ns)[-1]
        assert episode.action[row, 0] == pytest.approx(0.4)
        assert episode.action[row, 1] == pytest.approx(commands["asked_left"][newest])


def test_a_gap_in_the_images_ends_an_episode_and_short_ones_are_left_out(tmp_path: Path) -> None:
    def hidden(at_ms: int) -> Feedback | None:  # a second without feedback
        return feedback_at(PLAN, 4000, 1) if 4000 <= at_ms < 5000 else None

    path = write_flight(tmp_path / "gap.mcap", replace(PLAN, extra=hidden))
    _, found = cut(path)
    assert len(found) == 2
    assert len(found[0]) + len(found[1]) < 0.55 * PLAN.seconds * 10 - 3
    short = write_flight(tmp_path / "short.mcap", Plan(seconds=1.5))
    assert cut(short)[1] == []


def test_a_mark_starts_another_episode_and_names_its_task(recording: Path) -> None:
    found = read(recording)
    form = row_format_of(found, ["front"], 10.0)
    logs = found["logs"]
    marked = replace(logs, columns={**logs.columns, "name": np.array(["mark"] * len(logs))})
    first, second = episodes({**found, "logs": marked}, form, "circle")
    assert (first.task, second.task) == ("circle", "half way")
    assert first.frames_ns["front"][-1] <= second.frames_ns["front"][0]


def test_hovering_is_a_set_point_of_zeros_and_the_proxys_own_commands_do_not_count(recording: Path) -> None:
    found = read(recording)
    form = row_format_of(found, ["front"], 10.0)
    commands = found["commands"]
    hovers = replace(
        commands, columns={**commands.columns, "asked": np.where(commands["seq"] > 80, "hover", commands["asked"])}
    )
    (episode,) = episodes({**found, "commands": hovers}, form, "")
    assert not episode.action[25:].any()
    assert episode.action[5].any()
    own = replace(commands, columns={**commands.columns, "app_id": np.zeros(len(commands), np.int64)})
    with pytest.raises(FileFormatError, match="no set-points from an application"):
        row_format_of({**found, "commands": own}, ["front"], 10.0)


def taught(found: dict[str, Table], at_ns: Sequence[int], values: Sequence[str]) -> dict[str, Table]:
    """Add logs of a teacher's answers, and of another array."""
    columns = {
        "t_s": np.zeros(len(at_ns) + 1),
        "name": np.array(["other", *["action"] * len(at_ns)]),
        "text": np.array([""] * (len(at_ns) + 1)),
        "at_ns": np.array([0, *at_ns], np.int64),
        "values": np.array(["9", *values]),
    }
    return {**found, "logs": Table("logs", columns)}


def test_logged_actions_replace_the_flown_ones(recording: Path) -> None:
    found = read(recording)
    form, (flown,) = cut(recording)
    pictures = flown.frames_ns["front"]
    half = len(pictures) // 2
    answers = [f"{row} 0.25 -0.5 1" for row in range(len(pictures))]
    (episode,) = episodes(taught(found, pictures[::-1].tolist(), answers[::-1]), form, "")
    assert episode.action.tolist() == [[row, 0.25, -0.5, 1] for row in range(len(pictures))]
    late = (pictures[:half] + 40 * MS).tolist()  # with their computation time
    (episode,) = episodes(taught(found, late, answers[:half]), form, "")
    assert episode.action[:, 0].tolist() == list(range(half)), "no row without an answer"
    assert (episode.state == flown.state[:half]).all()
    with pytest.raises(FileFormatError, match=r"4 numbers of a set-point \(forward, left, up, yaw_rate\)"):
        episodes(taught(found, late, ["1 2 3"] * half), form, "")


def test_logged_arrays_are_read_with_their_own_time(recording: Path) -> None:
    logs = read(recording)["logs"]
    assert logs["at_ns"].dtype == np.int64
    assert abs(int(logs["at_ns"][0]) - BEGIN_NS - PLAN.seconds / 2 * NS_PER_S) < NS_PER_S


def test_unusable_recordings_are_refused(tmp_path: Path, recording: Path) -> None:
    found = read(recording)
    with pytest.raises(FileFormatError, match="no frames of back"):
        row_format_of(found, ["back"], 10.0)
    with pytest.raises(FileFormatError, match="feedback channel"):
        row_format_of({"commands": found["commands"]}, [], 10.0)
    placed = write_flight(tmp_path / "placed.mcap", replace(PLAN, places=True))
    with pytest.raises(UsageError, match="used position set-points"):
        row_format_of(read(placed), [], 10.0)
    with pytest.raises(UsageError, match=r"fps is 0 and must be from 0\.5 to 120"):
        export_lerobot([Recording.open(recording)], tmp_path / "a", fps=0)
    with pytest.raises(UnknownNameError, match="beta"):
        export_lerobot([Recording.open(recording)], tmp_path / "a", drone="beta")
    with pytest.raises(FileFormatError, match="follows set-points for at least a second"):
        export_lerobot([Recording.open(write_flight(tmp_path / "short.mcap", Plan(seconds=1.5)))], tmp_path / "a")
    with pytest.raises(UsageError, match="no recording was given"):
        export_lerobot([], tmp_path / "a")
    with pytest.raises(UsageError, match=r"placed.mcap: .*used position"):
        export_lerobot([Recording.open(recording), Recording.open(placed)], tmp_path / "a")
    assert not (tmp_path / "a").exists(), "nothing is left behind"
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    with pytest.raises(UsageError, match="full is not empty"):
        export_lerobot([Recording.open(recording)], tmp_path / "full")


def test_recordings_that_do_not_match_are_refused(
    tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.support.recorded_flights.action_at", lambda plan, at_ms: Attitude(roll=0.1))
    other = write_flight(tmp_path / "other.mcap", PLAN)
    with pytest.raises(UsageError, match=r"other.mcap has attitude .* but .*flight.mcap has velocity"):
        export_lerobot([Recording.open(recording), Recording.open(other)], tmp_path / "a")


def test_a_dataset_has_the_files_that_lerobot_reads(tmp_path: Path, recording: Path, log: Log) -> None:
    second = write_flight(tmp_path / "second.mcap", replace(PLAN, png=True))
    target = tmp_path / "set"
    ended = log("export", str(recording), str(second), "--to", "lerobot", "-o", str(target), "--task", "circle")
    assert ended.code == 0, ended.err
    assert "2 episodes" in ended.err
    info = json.loads((target / "meta" / "info.json").read_text())
    rows = pq.read_table(target / "data" / "chunk-000" / "file-000.parquet")
    whole = pq.read_table(target / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == ("v3.0", 2, rows.num_rows)
    assert info["features"]["action"]["names"] == ["forward", "left", "up", "yaw_rate"]
    assert info["features"]["observation.images.front"]["shape"] == [HEIGHT, WIDTH, 3]
    assert [one["dataset_to_index"] - one["dataset_from_index"] for one in whole] == [one["length"] for one in whole]
    assert whole[1]["videos/observation.images.front/from_timestamp"] == pytest.approx(whole[0]["length"] / 10)
    assert rows["index"].to_pylist() == list(range(rows.num_rows))
    assert rows["timestamp"].to_pylist()[whole[0]["length"]] == 0.0, "each episode has its own time"
    assert len(rows["observation.state"][0]) == 7
    tasks = pq.read_table(target / "meta" / "tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "circle"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    stats = json.loads((target / "meta" / "stats.json").read_text())
    assert stats["action"]["max"][0] == pytest.approx(0.4)
    assert np.shape(stats["observation.images.front"]["mean"]) == (3, 1, 1)
    assert 0.1 < np.mean(stats["observation.images.front"]["mean"]) < 0.5
    with av.open(str(target / "videos" / "observation.images.front" / "chunk-000" / "file-000.mp4")) as film:
        pictures = [(frame.time, frame.to_ndarray(format="bgr24")) for frame in film.decode(video=0)]
    assert [at_s for at_s, _ in pictures] == pytest.approx([row / 10 for row in range(rows.num_rows)])
    number = round((cut(recording)[1][0].frames_ns["front"][3] - BEGIN_NS + 30 * MS) / MS) // 100 + 1
    assert np.abs(pictures[3][1].astype(int) - picture_at(number)).mean() < 6


def test_a_damaged_image_is_reported_and_replaced_by_the_one_before(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "bad.mcap", replace(PLAN, packed=lambda n: b"no picture" if n in (30, 31) else None))
    found = export_lerobot([Recording.open(path)], tmp_path / "set")
    assert found.repeated == 2
    assert found.rows == len(cut(path)[1][0])
    blind = write_flight(tmp_path / "blind.mcap", replace(PLAN, packed=lambda n: b"no picture"))
    with pytest.raises(FileFormatError, match="can't be decoded"):
        export_lerobot([Recording.open(blind)], tmp_path / "none")


def test_without_cameras_there_are_no_videos(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "dark.mcap", replace(PLAN, frame_ms=0))
    found = export_lerobot([Recording.open(path)], tmp_path / "set")
    assert found.rows > 30
    assert found.form.cameras == ()
    assert not (tmp_path / "set" / "videos").exists()


def test_options_of_other_formats_are_refused(recording: Path, log: Log) -> None:
    assert "--fps has no effect on csv" in log("export", str(recording), "--fps", "5").err
    assert (
        "--channel has no effect on lerobot" in log("export", str(recording), "--to", "lerobot", "--channel", "x").err
    )
    assert "one at a time" in log("export", str(recording), str(recording)).err
    ended = log("export", str(recording), "--to", "mp4", "--camera", "front", "--camera", "back")
    assert "2 cameras given" in ended.err


def test_a_missing_pyarrow_is_named(tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match="skyloop install parquet"):
        export_lerobot([Recording.open(recording)], tmp_path / "set")


@pytest.mark.process
@pytest.mark.skipif(not PYTHON, reason="SKYLOOP_LEROBOT_PYTHON names no Python with lerobot or lerobot-dataset")
def test_lerobot_itself_reads_it(tmp_path: Path, recording: Path) -> None:
    found = export_lerobot([Recording.open(recording)] * 2, tmp_path / "set", task="circle")
    program = """
import sys
try:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
except ImportError:
    from ledataset.datasets.lerobot_dataset import LeRobotDataset
whole = LeRobotDataset("skyloop/test", root=sys.argv[1])
row = whole[len(whole) - 1]
picture = row["observation.images.front"]
print(len(whole), whole.meta.total_episodes, row["task"], *picture.shape)
print(float(row["action"][0]), float(picture.mean()))
"""
    command = [PYTHON, "-c", program, str(tmp_path / "set")]
    ended = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, "HF_HUB_OFFLINE": "1"}
    )
    rows, count, task, *rest = ended.stdout.split()
    assert (int(rows), int(count), task) == (found.rows, 2, "circle")
    assert [int(size) for size in rest[:3]] == [3, HEIGHT, WIDTH]
    assert float(rest[3]) == pytest.approx(0.4)
    assert 0.1 < float(rest[4]) < 0.5
