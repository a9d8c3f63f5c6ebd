"""``python -m benchmarks.paper``: the paper's test flight on a simulated AR.Drone, its table and its figures."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final
from urllib.parse import urlencode

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from benchmarks.one_command import one_command
from skyloop.cli.app import run
from skyloop.cli.demo import PagePort, drone_and_page, land
from skyloop.errors import UsageError

if TYPE_CHECKING:
    from benchmarks.measuring import tables
    from benchmarks.paper.evaluation import Experiment
    from benchmarks.paper.flight import PaperFlight
    from skyloop.bench import Machine
    from skyloop.client import Drone

RECORDING: Final = "flight.mcap"
LEAST_MINUTES: Final = 0.05
CAMERA: Final = "front"
#: The paper's rates: telemetry every 31.25 ms, and 15 frames of 320×240 a second.
VEHICLE: Final = {
    "vehicle": "ardrone",
    "cameras": CAMERA,
    "width": 320,
    "height": 240,
    "fps": 15,
    "rate": 32,
    "position": 1,
    "truth": 1,
}
_PRINT_EVERY_S = 30.0  # without a terminal


def paper(
    minutes: Annotated[
        float, typer.Option(min=LEAST_MINUTES, metavar="MIN", help="Duration of the flight; the paper's were 5")
    ] = 5.0,
    output: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for all output", show_default="paper-DATE-TIME")
    ] = None,
    headless: Annotated[bool, typer.Option("--headless", help="No page to watch and fly")] = False,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of noise and wind")] = 0,
    port: PagePort = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser")] = False,
) -> None:
    """Fly the paper's test flight on a simulated AR.Drone, record it, and make the paper's table and figures from it.

    It flies through waypoints by motion capture. The recording gives the paper's Table 1 and figures 3 to 5, with the
    tracking error. You can fly from the page, too: take control there, and release it.

    Ctrl-C lands, and the figures then cover the flight up to that point.
    """
    from skyloop.bench import Machine

    console = Console(highlight=False)
    folder = _prepared(output)
    machine = Machine.here()
    flight = _Flight(console, minutes * 60.0, folder / RECORDING)
    flight.fly(f"sim://?{urlencode({**VEHICLE, 'seed': seed})}", not headless, port, browser)
    results = _evaluated(console, folder, machine, flight.load)
    console.print(f"report [bold]{folder / 'report.html'}[/], recording {RECORDING}, figures results.json")
    if results.tracking is None:
        console.print("[bold red]the drone never started its path[/]")
        raise typer.Exit(1)


def _prepared(output: Path | None) -> Path:
    """Create the folder, and check before the flight what would otherwise fail after it."""
    from benchmarks.measuring.figures import check_installed as check_figures
    from skyloop.recording.recorder import check_installed as check_recording

    check_figures()
    check_recording()
    folder = output or Path(time.strftime("paper-%Y%m%d-%H%M%S"))
    if (folder / RECORDING).exists():
        raise UsageError(f"{folder} already holds a recording: give another --output")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} can't be made: {error.strerror}") from error
    return folder


def _evaluated(console: Console, folder: Path, machine: Machine, load: float | None) -> Experiment:
    from benchmarks.paper import report
    from benchmarks.paper.evaluation import evaluate

    with console.status("working out the figures"):
        results = evaluate(folder / RECORDING, machine, load)
        report.write(results, folder)
    for found in (report.delay_table(results), report.recorder_table(results), report.path_table(results)):
        console.print(_shown(found))
    console.print("  ·  ".join(f"{what} {value}" for what, value in report.flown(results)))
    return results


def _shown(found: tables.Table) -> Table:
    table = Table(title=found.title, title_justify="left", box=None)
    for number, column in enumerate(found.columns):
        table.add_column(column, justify="right" if number else "left")
    for row in found.rows:
        table.add_row(*row)
    return table


@dataclass(slots=True)
class _Flight:
    """One flight, from connecting to landing."""

    console: Console
    seconds: float
    recording: Path
    load: float | None = None  #: load average of the flight's last minute
    _stopped: bool = False
    _on_stop: Callable[[], None] | None = None
    _printed_s: float = field(default_factory=time.monotonic)

    def fly(self, uri: str, page_shown: bool, port: int | None, browser: bool) -> None:
        """Fly, with the page on a port (None: the default). Raises the errors of connecting, recording and take-off."""
        from benchmarks.paper.flight import DelayLog, PaperFlight
        from skyloop.motion_capture import mocap
        from skyloop.recording import record

        with ExitStack() as stack:
            drone, _, _ = stack.enter_context(
                drone_and_page(uri, self.console, "paper", self._stop, port, page_shown=page_shown, browser=browser)
            )
            capture = stack.enter_context(mocap("sim://", {drone.name: drone.name}))
            found = capture.calibrate(drone)
            self.console.print(f"motion capture: {found.poses} poses at rest, spread {found.spread_m * 1e3:.1f} mm")
            stack.enter_context(record(drone, self.recording))
            stack.enter_context(capture.link(drone))
            flight = PaperFlight(drone, capture.source(drone), self.seconds)
            self._on_stop = flight.stop
            self.console.print("taking off")
            drone.takeoff()
            with DelayLog(drone, CAMERA):
                self._follow(drone, flight)
            self.load = round(os.getloadavg()[0], 1)
            land(drone, self.console)

    def _follow(self, drone: Drone, flight: PaperFlight) -> None:
        """Fly until the time is over, whoever else flies; take off again once a pilot that landed it releases it."""
        began_s = time.monotonic()
        self.console.print(f"flying through waypoints for {self.seconds:g} s, or until Ctrl-C")
        with Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TimeRemainingColumn(),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        ) as bar:
            task = bar.add_task("", total=self.seconds)

            def look() -> bool:
                flown_s = time.monotonic() - began_s
                words = _status(drone, flight)
                bar.update(task, completed=flown_s, description=words)
                self._print(f"{flown_s:4.0f} s  {words}")
                return self._stopped or _put_down(drone)

            while not self._stopped and (left_s := began_s + self.seconds - time.monotonic()) > 0.0:
                if _put_down(drone):
                    drone.takeoff()
                flight.run(seconds=left_s, until=look)
                if flight.done or drone.closed:
                    return

    def _print(self, words: str) -> None:
        now_s = time.monotonic()
        if not self.console.is_terminal and now_s - self._printed_s >= _PRINT_EVERY_S:
            self._printed_s = now_s
            self.console.print(words)

    def _stop(self) -> None:
        """End the flight normally on the first Ctrl-C."""
        self._stopped = True
        if self._on_stop is not None:
            self._on_stop()


def _put_down(drone: Drone) -> bool:
    """Return whether we may fly the drone and another application has landed it."""
    return drone.authority.state == "held" and not drone.feedback().state.airborne


def _status(drone: Drone, flight: PaperFlight) -> str:
    if flight.off_m is None:
        holder = drone.authority.holder
        return f"{holder} flies" if flight.away and holder != "paper" else "on its way back"
    return f"{flight.reached} waypoints, {flight.off_m * 1e2:.0f} cm off, RMS {flight.error.rms_m * 1e2:.1f} cm"


if __name__ == "__main__":
    run(one_command(paper), sys.argv[1:], "benchmarks.paper")
