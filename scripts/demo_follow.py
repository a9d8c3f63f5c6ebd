"""``python scripts/demo_follow.py``: a simulated drone follows a walking person; figures against the truth."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Final
from urllib.parse import urlencode

import msgspec
import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from skyloop.cli.app import run
from skyloop.cli.demo import PagePort, drone_and_page, land
from skyloop.cli.fly import status_line
from skyloop.errors import MissingExtraError, UsageError, install_command

if TYPE_CHECKING:
    from follow_truth import FollowReport, TargetTruth

    from skyloop.client import Drone, Frame
    from skyloop.control import FollowTarget
    from skyloop.vision import OnnxDetector
    from skyloop.vision.tracking import Box

ENOUGH_IN_VIEW: Final = 0.9
DETECTOR, LOOKS = "detector", "looks"
_REFRESH_HZ = 4
_LINE_EVERY_S = 5.0  # without a terminal
_TURN_RAD_S = 0.6
_AHEAD_RAD = 0.2  # a person closer than this to straight ahead can be pointed at,
_AHEAD_FRAMES = 15  # after this many frames in a row: the picture of a vehicle beginning to turn is blurred


def follow_anything(
    seconds: Annotated[
        float | None, typer.Option(min=0.0, metavar="S", help="Duration of following [default: until Ctrl-C]")
    ] = None,
    headless: Annotated[
        bool, typer.Option("--headless", help="No page; exit code 1 if the person was in view less than 90 %")
    ] = False,
    world: Annotated[str, typer.Option(help="World with people: park, street, yard, or a file")] = "park",
    looks: Annotated[bool, typer.Option("--looks", help="By appearance only, even if a detector is installed")] = False,
    distance: Annotated[float, typer.Option(metavar="M", help="Distance to keep; above 2")] = 4.0,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of the noise and the wind")] = 0,
    port: PagePort = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser")] = False,
    name: Annotated[str, typer.Option(help="Name of the pilot, as shown to others")] = "demo",
    json: Annotated[
        bool, typer.Option("--json", help="Print the figures as one JSON object; the rest goes to standard error")
    ] = False,
) -> None:
    """Take off in a simulated park, and follow a walking person, at 4 m. Ctrl-C lands.

    A detector finds people in the frames if ONNX Runtime and SciPy are installed (extra detect). Otherwise the
    simulator points at a person once, and the content of that box is tracked by its appearance.

    The figures at the end compare with the person's true position in the simulator.
    """
    from skyloop.control import ChaseSettings
    from skyloop.sim import load_world

    settings = ChaseSettings(distance_m=distance)  # raises for invalid values
    if not any(getattr(target, "shape", None) == "person" for target in load_world(world, seed).targets):
        raise UsageError(f"no one walks in the world {world!r}: give --world park, street or yard")
    console = Console(highlight=False, stderr=json)
    report = _Demo(console, name, seconds, world, seed).fly(settings.distance_m, looks, not headless, port, browser)
    if json:
        typer.echo(msgspec.json.encode(report.figures()).decode())
    else:
        console.print(report.table())
    if headless and not report.good(ENOUGH_IN_VIEW):
        console.print(f"[bold red]{report.verdict(ENOUGH_IN_VIEW)}[/]")
        raise typer.Exit(1)


def packaged_detector() -> OnnxDetector | None:
    """Return the detector of the simulator's figures; None if its requirements are missing."""
    from skyloop.vision import simulated_detector

    if find_spec("scipy") is None:
        return None
    try:
        return simulated_detector()
    except MissingExtraError:
        return None


@dataclass(slots=True)
class _Demo:
    """One run, from connecting to landing."""

    console: Console
    name: str
    seconds: float | None
    world: str
    seed: int
    started_s: float = field(default_factory=time.monotonic)
    _stopped: bool = False
    _on_stop: Callable[[], None] | None = None

    def fly(self, distance_m: float, looks: bool, page_shown: bool, port: int | None, browser: bool) -> FollowReport:
        """Fly it; ``port`` None: the default port of pages. Raises the errors of connecting and of take-off."""
        from follow_truth import FollowReport, TargetTruth

        from skyloop.sim import load_world

        detector = None if looks else packaged_detector()
        if detector is None and not looks:
            self.console.print(f"no detector: {install_command('detect')} installs one")
        truth = TargetTruth(load_world(self.world, self.seed))
        report = FollowReport(LOOKS if detector is None else DETECTOR, distance_m)
        uri = "sim://?" + urlencode({"world": self.world, "seed": self.seed, "cameras": "front", "fps": 15})
        with drone_and_page(uri, self.console, self.name, self._stop, port, page_shown=page_shown, browser=browser) as (
            drone,
            _,
            pictured_s,
        ):
            report.first_picture_s = pictured_s - self.started_s
            self.console.print("taking off")
            drone.takeoff()
            if not self._stopped:
                self._follow(drone, detector, truth, report)
            report.channels = dict(drone.stats)
            land(drone, self.console)
            report.collisions = sum(event.kind == "collision" for event in drone.recent_events())
        return report

    def _follow(self, drone: Drone, detector: OnnxDetector | None, truth: TargetTruth, report: FollowReport) -> None:
        box = None
        if detector is None:
            self.console.print("looking for a person to point at, to follow by appearance only")
            box = self._pointed_at(drone, truth)
            if box is None:
                return
        else:
            self.console.print("looking for a person with the detector")
        follower = _follower(drone, box, detector, truth, report)
        self._on_stop = follower.stop
        end = "Ctrl-C" if self.seconds is None else f"{self.seconds:g} s are over, or Ctrl-C"
        self.console.print(f"following at {report.distance_m:g} m until {end}")
        if self.console.is_terminal:
            with Live(
                get_renderable=lambda: Text(status_line(follower), "cyan", no_wrap=True, overflow="ellipsis"),
                console=self.console,
                refresh_per_second=_REFRESH_HZ,
                transient=True,
            ):
                follower.run(seconds=self.seconds, until=lambda: self._stopped)
        else:
            printed_s = time.monotonic()

            def look() -> bool:
                nonlocal printed_s
                if time.monotonic() - printed_s >= _LINE_EVERY_S:
                    printed_s = time.monotonic()
                    self.console.print(status_line(follower))
                return self._stopped

            follower.run(seconds=self.seconds, until=look)
        if follower.done:
            self.console.print("[yellow]the person was lost for too long[/]")

    def _pointed_at(self, drone: Drone, truth: TargetTruth) -> Box | None:
        """Turn until a person is straight ahead; return the box, or None if stopped before."""
        begun_s, ahead = time.monotonic(), 0
        for frame in drone.frames():
            if self._stopped or (self.seconds is not None and time.monotonic() - begun_s > self.seconds):
                break
            true = truth.at(frame)
            found = None if true is None else true.nearest_person()
            bearing = None if true is None or found is None else true.bearings_rad[found.name]
            ahead = ahead + 1 if bearing is not None and abs(bearing) < _AHEAD_RAD else 0
            if found is not None and ahead >= _AHEAD_FRAMES:
                x, y, width, height = found.box
                return float(x), float(y), float(width), float(height)
            turn = _TURN_RAD_S if bearing is None else max(-_TURN_RAD_S, min(_TURN_RAD_S, 1.5 * bearing))
            drone.velocity(yaw_rate=turn)
        return None

    def _stop(self) -> None:
        """End the flight in good order on the first Ctrl-C. A second one interrupts Python as usual."""
        self._stopped = True
        if self._on_stop is not None:
            self._on_stop()


def _follower(
    drone: Drone, box: Box | None, detector: OnnxDetector | None, truth: TargetTruth, report: FollowReport
) -> FollowTarget:
    from skyloop.control import FollowTarget

    class Judged(FollowTarget):
        """Counts its successes."""

        def on_frame(self, frame: Frame) -> None:
            super().on_frame(frame)
            report.enter(self.phase, self.losses)
            report.judge(frame, truth, self.status.box)

    return Judged(
        drone,
        box,
        class_name="person",  # also with a box: the size of people gives the distance
        detector=detector,
        distance_m=report.distance_m,
    )


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command()(follow_anything)
    run(app, sys.argv[1:], "demo_follow")
