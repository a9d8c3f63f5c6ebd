"""A flight's progress in one line; a machine's cameras; shell completion; tables in narrow terminals."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from skyloop.cli import bench, doctor, fly, naming
from skyloop.cli.doctor import Health
from skyloop.cli.install import EXTRAS
from skyloop.cli.text import console as skyloop_console
from skyloop.cli.text import named
from skyloop.vehicles.video.v4l2 import CameraDevice, cameras, described
from tests.support.commands import FAST_SIM, Run
from tests.support.processes import Process, in_terminal
from tests.support.systems import only_on

ROOT = Path(__file__).parents[2]
HOVER = """
import skyloop
class Mine(skyloop.Controller):
    def on_feedback(self, feedback):
        self.drone.hover()
"""


# fly -------------------------------------------------------------------------------------------------------------


@pytest.mark.process
def test_a_flight_shows_its_progress_line_by_line_in_a_pipe(
    run: Run, alpha: Process, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert alpha.pid
    monkeypatch.setattr(fly, "LINE_EVERY_S", 0.1)
    (tmp_path / "mine.py").write_text(HOVER)
    ended = run("fly", str(tmp_path / "mine.py"), "alpha", "--seconds", "0.6")
    assert ended.code == 0, ended.err
    lines = [line for line in ended.err.splitlines() if "battery" in line]
    assert len(lines) >= 2
    assert lines[0].startswith(("hovering  0 s  altitude ", "taking off  0 s  altitude "))
    assert "\x1b" not in ended.err


@pytest.mark.process
@pytest.mark.daily
def test_a_flight_keeps_one_line_up_to_date_in_a_terminal(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(HOVER)
    text = in_terminal("fly", str(tmp_path / "mine.py"), "--drone", FAST_SIM, "--seconds", "1", columns=40)
    assert re.search(r"hovering  \d s  altitude ", text)
    assert text.count("\x1b[2K") >= 3, "the line is written anew"


# video:// --------------------------------------------------------------------------------------------------------


def machine(tmp_path: Path, **names: tuple[str, str]) -> tuple[Path, Path]:
    """Create folders like the kernel's, for cameras with these names and node numbers."""
    system, devices = tmp_path / "sys", tmp_path / "dev"
    for folder in (system, devices):
        folder.mkdir()
    for node, (name, index) in names.items():
        (system / node).mkdir()
        (system / node / "name").write_text(f"{name}\n")
        (system / node / "index").write_text(f"{index}\n")
        (devices / node).touch()
    return system, devices


@only_on("linux", reason="reads the nodes in /sys and /dev")
def test_cameras_are_listed_by_name_and_node(tmp_path: Path) -> None:
    system, devices = machine(
        tmp_path, video10=("Another", "0"), video2=("HD Webcam", "0"), video3=("HD Webcam", "1"), v4l=("no node", "0")
    )
    found = cameras(system, devices)
    assert [(Path(camera.path).name, camera.name) for camera in found] == [
        ("video2", "HD Webcam"),
        ("video10", "Another"),
    ]
    assert described(found).startswith(f"cameras of this machine: video://{devices}/video2 (HD Webcam), video://")
    assert cameras(tmp_path / "none", devices) == []
    assert described([]) == "no camera is connected to this machine"
    closed = CameraDevice(Path("/dev/video0"), "HD Webcam", allowed=False)
    assert "this user may not open it: sudo usermod -aG video $USER" in described([closed])


def test_video_without_a_camera_says_which_there_are(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    webcam = CameraDevice(Path("/dev/video4"), "HD Webcam", allowed=True)
    monkeypatch.setattr("skyloop.vehicles.video.driver.cameras", lambda: [webcam])
    ended = run("proxy", "video://")
    assert ended.code == 2
    assert ended.err.endswith("cameras of this machine: video:///dev/video4 (HD Webcam)\n")


# doctor ----------------------------------------------------------------------------------------------------------


def test_the_doctor_knows_every_optional_part() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {extra for extra, _, _ in EXTRAS} == extras.keys() - {"all"}


def test_the_doctor_s_findings_for_programs(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_import_time", lambda: iter(()))
    monkeypatch.setattr(doctor, "_free", lambda kind, port: port != 14550)
    found = json.loads(run("doctor", "--json").out)
    by_name = {each["what"]: each for each in found}
    assert by_name["Python"]["health"] == "good"
    assert by_name["ports"]["health"] == Health.MISSING
    assert by_name["ports"]["detail"] == "in use: UDP 14550 (MAVLink ground stations)"
    assert "camera" in by_name or "cameras" in by_name
    assert "browser" in by_name


# completion ------------------------------------------------------------------------------------------------------


@pytest.mark.process
@pytest.mark.usefixtures("alpha")
def test_names_of_drones_parameters_and_files_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def complete(line: str) -> set[str]:
        words = line.split(" ")
        environment = {"_SKYLOOP_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
        done = subprocess.run(
            [sys.executable, "-c", "import sys; sys.argv[0] = 'skyloop'; from skyloop.cli import main; main()"],
            env={**os.environ, **environment},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
            timeout=30,
        )
        assert done.stderr == ""
        return set(done.stdout.split())

    (tmp_path / "mine.py").touch()
    (tmp_path / "flight.mcap").touch()
    (tmp_path / "folder").mkdir()
    assert complete("skyloop wat") == {"watch"}
    assert complete("skyloop watch al") == {"alpha"}
    assert complete("skyloop land --drone ") == {"alpha"}
    assert complete("skyloop param alpha limits.ti") == {"limits.tilt"}
    assert complete("skyloop fly m") == {"mine.py"}
    assert complete("skyloop log info f") == {"flight.mcap", "folder/"}
    monkeypatch.chdir(tmp_path)
    assert naming.python_files("folder") == ["folder/"]
    assert naming.network_places("mu") == ["multicast"]


# tables ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [40, 60])
def test_distinguishing_columns_are_complete_in_narrow_terminals(columns: int) -> None:
    names = [f"alpha/video/front_{letter * 20}" for letter in "ab"]
    table = Table(named("topic"), "count", "a long heading", "another one", box=None)
    for name in names:
        table.add_row(name, "12345", "0.123456", "some more words")
    console = Console(width=columns, file=io.StringIO(), record=True)
    console.print(table)
    text = console.export_text()
    assert all(text.count(letter) >= 20 for letter in "ab"), "the ends of the names, by which they differ"
    assert max(map(len, text.splitlines())) <= columns


def test_tables_in_a_pipe_have_no_boxes_and_are_not_cut(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    skyloop_console().print(bench._table("Delays", ("channel", "median"), (("a" * 200, "1"),), "this machine"))
    out = capsys.readouterr().out
    assert "a" * 200 in out
    assert not set(out) & set("─│┌┐└┘├┤┬┴┼━┃┏┓")
