"""``skyloop preflight``: the checklist before a flight."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.text import Text

from skyloop.cli.naming import DroneOption, KeysOption, NameArgument, NetworkOption, join_network, one_drone
from skyloop.client.preflight import Level, PreflightFinding
from skyloop.errors import NoAnswerError

_MARKS = {Level.OK: ("✓", "green"), Level.WARN: ("!", "yellow"), Level.FAIL: ("✗", "red")}
FEEDBACK_S = 2.0
VIDEO_S = 5.0  #: a vehicle that was just started, such as a Tello, sends its first picture after some seconds


def preflight(
    name: NameArgument = None,
    drone: DroneOption = None,
    folder: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Where recordings are to go, to see whether there is room")
    ] = Path("recordings"),
    json: Annotated[bool, typer.Option("--json", help="For programs: a JSON array of findings")] = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Check a drone before it flies: link, battery, position, zones, video, its own failsafes. It flies nothing.

    Marks: ✓ as it should be, ! it can fly without, ✗ it would not fly, or not safely. The exit code is 1 with any ✗.
    """
    from contextlib import suppress

    from skyloop.client import connect

    join_network(network, keys)
    with connect(one_drone(name, drone), access="observe", name="skyloop preflight") as checked:
        with suppress(NoAnswerError):
            checked.next_feedback(FEEDBACK_S)
        findings = checked.preflight(video_s=VIDEO_S, folder=folder)
    if json:
        typer.echo(msgspec.json.encode([asdict(finding) for finding in findings]).decode())
    else:
        console = Console(soft_wrap=True)
        for finding in findings:
            console.print(_line(finding))
    if any(finding.level is Level.FAIL for finding in findings):
        raise typer.Exit(1)


def _line(finding: PreflightFinding) -> Text:
    mark, colour = _MARKS[finding.level]
    text = Text.assemble((mark, colour), f" {finding.check}: {finding.detail}")
    if finding.why:
        text.append(f"\n  {finding.why}")
    return text.append(f"\n  → {finding.remedy}", "bold") if finding.remedy else text
