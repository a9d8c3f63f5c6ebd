"""``docs/recording.md`` matches the code."""

from __future__ import annotations

import inspect
import re

import skyloop
from skyloop.cli.app import build
from skyloop.recording import layout
from skyloop.recording.backlog import RESERVE
from skyloop.recording.options import CHOICES, MB, RecorderState
from tests.support.pages import ROOT, rows, section

PAGE = "docs/recording.md"
TEXT = (ROOT / PAGE).read_text()


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def test_the_options_are_those_of_the_function_and_the_command() -> None:
    from typer.main import get_command

    table = rows(section(PAGE, "## How it records").partition("### H.264 passthrough")[0])
    parameters = inspect.signature(skyloop.record).parameters
    listed = [name for row in table for name in names(row[0])]
    assert sorted(names(table[0][3])) == sorted([*CHOICES, "video.CAMERA"])
    assert listed == [name for name in parameters if name not in ("drones", "path", "in_process")]
    command = get_command(build()).commands["record"]  # type: ignore[attr-defined]
    options = {flag for one in command.params for flag in one.opts}
    for options_cell in (row[1] for row in table):
        assert set(names(options_cell)) <= options
    for row in table:
        default = parameters[names(row[0])[0]].default
        assert row[2].strip("`") == {None: row[2], False: "no"}.get(
            default, f"{default:g}" if isinstance(default, float) else str(default)
        )


def test_the_topics_are_those_of_the_layout() -> None:
    own = [names(row[0])[0] for row in rows(section(PAGE, "### Our own samples"))]
    expected = [f"/NAME/{channel}" + ("/CAMERA" if channel == "frames" else "") for channel in layout.Channel]
    assert own == expected
    shown = [names(row[0])[0] for row in rows(section(PAGE, "### For viewers"))]
    makers = (layout.image_topic, layout.video_topic, layout.calibration_topic, layout.drawing_topic)
    assert shown == [
        *(make("NAME", "CAMERA") for make in makers),
        layout.pose_topic("NAME"),
        layout.mocap_topic("NAME"),
        layout.path_topic("NAME"),
        layout.TF,
        layout.LOG,
    ]


def test_the_metadata_are_those_of_the_layout() -> None:
    table = rows(section(PAGE, "### Metadata"))
    kinds = {layout.META_CLOCK: layout.ClockPair, layout.META_RECORDING: layout.Start, layout.META_END: layout.End}
    assert [names(row[0])[0] for row in table] == list(kinds)
    for row, kind in zip(table, kinds.values(), strict=True):
        assert set(kind.__struct_fields__) <= set(names(row[2])), kind


def test_figures_and_states() -> None:
    assert f"until {RESERVE // MB} MB more" in TEXT
    states = [state.value for state in RecorderState if state is not RecorderState.STARTING]
    assert ", ".join(f"`{state}`" for state in states) in TEXT
