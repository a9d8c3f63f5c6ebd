"""``skyloop demo``: a simulated drone finds a marker and follows it by its camera."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlencode

import msgspec
import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from skyloop.cli.demo_parts import PagePort, drone_and_page, land
from skyloop.cli.demo_report import DemoReport, TruthMeter
from skyloop.errors import LinkError

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.child import CockpitProcess
    from skyloop.control.follow import FollowMarker

MARKER_ID = 7  #: on the board that is carried about the room
ENOUGH_IN_VIEW = 0.9
_REFRESH_HZ = 4


def demo(
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="How long to follow; until Ctrl-C if not given")
    ] = None,
    headless: Annotated[
        bool, typer.Option("--headless", help="No page; exit code 1 if the marker was in view less than 90 %")
    ] = False,
    world: Annotated[str, typer.Option(help="A world's name or file")] = "room",
    seed: Annotated[int, typer.Option(min=0, help="Decides the marker's walk, the noise and the wind")] = 0,
    port: PagePort = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser")] = False,
    name: Annotated[str, typer.Option(help="Who flies, for those who watch")] = "demo",
    json: Annotated[
        bool, typer.Option("--json", help="For programs: the figures as one JSON object; the rest on standard error")
    ] = False,
) -> None:
    """Take off in a simulated room, find the marker, follow it at 1.5 m by the camera. Ctrl-C lands."""
    console = Console(highlight=False, stderr=json)
    report = _Demo(console, name, seconds).fly(_address(world, seed), not headless, port, browser)
    if json:
        typer.echo(msgspec.json.encode(report).decode())
    else:
        console.print(report.table())
    if headless and not report.good(ENOUGH_IN_VIEW):
        console.print(f"[bold red]{report.verdict(ENOUGH_IN_VIEW)}[/]")
        raise typer.Exit(1)


def _address(world: str, seed: int) -> str:
    return "sim://?" + urlencode({"world": world, "seed": seed})


@dataclass(slots=True)
class _Demo:
    """One run, from connecting to landing."""

    console: Console
    name: str
    seconds: float | None
    started_s: float = field(default_factory=time.monotonic)
    _stopped: bool = False
    _on_stop: Callable[[], None] | None = None

    def fly(self, uri: str, page_shown: bool, port: int | None, browser: bool) -> DemoReport:
        """``port`` None: the default one of pages. Raises the errors of connecting and of take-off."""
        from skyloop.control.follow import FollowMarker

        report = DemoReport()
        with drone_and_page(uri, self.console, self.name, self._stop, port, page_shown=page_shown, browser=browser) as (
            drone,
            page,
            pictured_s,
        ):
            report.first_picture_s = pictured_s - self.started_s
            follower = FollowMarker(drone, MARKER_ID)
            with TruthMeter(drone, follower) as truth:
                self._follow(drone, follower)
            report.take(drone, follower.score, truth, None if page is None else _page_counts(page))
            land(drone, self.console)
            report.collisions = sum(event.kind == "collision" for event in drone.recent_events())
        return report

    def _follow(self, drone: Drone, follower: FollowMarker) -> None:
        self._on_stop = follower.stop
        self.console.print("taking off")
        drone.takeoff()
        if self._stopped:
            return
        end = "Ctrl-C" if self.seconds is None else f"{self.seconds:g} s are over, or Ctrl-C"
        self.console.print(f"looking for marker {MARKER_ID}, then following it until {end}")
        if not self.console.is_terminal:
            follower.run(seconds=self.seconds, until=lambda: self._stopped)
            return
        with Live(
            get_renderable=lambda: _status(drone, follower),
            console=self.console,
            refresh_per_second=_REFRESH_HZ,
            transient=True,
        ):
            follower.run(seconds=self.seconds, until=lambda: self._stopped)

    def _stop(self) -> None:
        """First Ctrl-C: end the flight in good order. The second one is the user's impatience, and Python's."""
        self._stopped = True
        if self._on_stop is not None:
            self._on_stop()


def _page_counts(page: CockpitProcess) -> dict[str, Any] | None:
    try:
        return page.statistics()
    except LinkError:
        return None


def _status(drone: Drone, follower: FollowMarker) -> Text:
    """The line that lives in the terminal."""
    feedback, score = drone.feedback(), follower.score
    frame = drone.frame()
    share = score.share_in_view
    parts = [
        str(follower.mode),
        "not seen yet" if share is None else f"in view {share:.0%}",
        f"{score.ranges[-1][1] + follower.distance_m:.2f} m away" if score.ranges else "",
        "" if feedback.altitude_m is None else f"altitude {feedback.altitude_m:.2f} m",
        "" if feedback.battery is None else f"battery {feedback.battery:.0%}",
        "" if frame is None else f"frame {frame.age_s * 1e3:.0f} ms old",
    ]
    return Text("  ·  ".join(part for part in parts if part), style="cyan", no_wrap=True, overflow="ellipsis")
