"""``skyloop demo``: a simulated drone finds a marker, follows it by camera, and reports how well this went."""

from __future__ import annotations

import math
import signal
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Final, Self
from urllib.parse import urlencode

import typer
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from skyloop.cli.text import print_json
from skyloop.clock import nanoseconds
from skyloop.errors import LinkError
from skyloop.messages import Feedback, Value

if TYPE_CHECKING:
    from skyloop.client import ChannelStats, Drone
    from skyloop.cockpit.child import CockpitProcess
    from skyloop.control.follow import FollowMarker, FollowScore

MARKER_ID = 7  #: marker on the board carried around the room
ENOUGH_IN_VIEW = 0.9  #: if the marker is in view in a smaller fraction of the frames, a headless run fails
_REFRESH_HZ = 4  # of the status line
_FIRST_PICTURE_S: Final = 10.0  # time limit for the first frame

#: The option for a demonstration's port.
PagePort = Annotated[
    int | None, typer.Option(min=0, max=65535, help="Port of the page; 0: any free one [8420, or the next free one]")
]
#: Native telemetry with the true positions of a simulated vehicle and of the board, in world axes [m].
OWN_PLACE = ("truth.x", "truth.y", "truth.z")
BOARD_PLACE = ("truth.target.x", "truth.target.y", "truth.target.z")
SETTLING_S = 5.0  # time after the first sighting during which the vehicle is still approaching the marker


def demo(
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Duration of following [default: until Ctrl-C]")
    ] = None,
    headless: Annotated[
        bool, typer.Option("--headless", help="No page; exit code 1 if the marker was in view for less than 90 %")
    ] = False,
    world: Annotated[str, typer.Option(help="Name or file of a world")] = "room",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the marker's walk, the noise and the wind")] = 0,
    port: PagePort = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser")] = False,
    name: Annotated[str, typer.Option(help="Name of the pilot, as shown to others")] = "demo",
    json: Annotated[
        bool, typer.Option("--json", help="Print the figures as one JSON object; the rest goes to standard error")
    ] = False,
) -> None:
    """Take off in a simulated room, find the marker, and follow it at 1.5 m with the camera. Ctrl-C lands."""
    console = Console(highlight=False, stderr=json)
    address = "sim://?" + urlencode({"world": world, "seed": seed})
    report = _Demo(console, name, seconds).fly(address, not headless, port, browser)
    if json:
        print_json(report)
    else:
        console.print(report.table())
    if headless and not report.good(ENOUGH_IN_VIEW):
        console.print(f"[bold red]{report.verdict(ENOUGH_IN_VIEW)}[/]")
        raise typer.Exit(1)


@dataclass(slots=True)
class _Demo:
    """One run of the demonstration, from connecting to landing."""

    console: Console
    name: str
    seconds: float | None
    started_s: float = field(default_factory=time.monotonic)
    _stopped: bool = False
    _on_stop: Callable[[], None] | None = None

    def fly(self, uri: str, page_shown: bool, port: int | None, browser: bool) -> DemoReport:
        """Fly the demonstration; ``port`` is None for the default. Errors while connecting or taking off are raised."""
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
        """End the flight properly on the first Ctrl-C. A second Ctrl-C interrupts Python as usual."""
        self._stopped = True
        if self._on_stop is not None:
            self._on_stop()


def _page_counts(page: CockpitProcess) -> dict[str, Any] | None:
    try:
        return page.statistics()
    except LinkError:
        return None


def _status(drone: Drone, follower: FollowMarker) -> Text:
    """Return the status line, which is updated in place."""
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


@contextmanager
def drone_and_page(
    uri: str,
    console: Console,
    name: str,
    stop: Callable[[], None],
    port: int | None,
    *,
    page_shown: bool,
    browser: bool,
) -> Iterator[tuple[Drone, CockpitProcess | None, float]]:
    """Connect to a vehicle, wait for its first image, and show the page.

    ``name``: the pilot's name as shown to others. ``stop``: called on the first Ctrl-C. ``port``: the page's port, or
    None for the default. Yield the drone, the page if there is one, and the time of the first image (monotonic) [s].
    """
    from skyloop.client import connect
    from skyloop.cockpit.child import CockpitProcess

    with ExitStack() as stack:
        drone = stack.enter_context(connect(uri, name=name))
        stack.enter_context(interrupted_by_signals(stop))
        console.print(f"[bold]{uri}[/] is up as [bold]{drone.name}[/]")
        page = stack.enter_context(CockpitProcess(drone.name, port)) if page_shown else None
        drone.next_frame(timeout_s=_FIRST_PICTURE_S)
        pictured_s = time.monotonic()
        if page is not None:
            _show(page, console, browser)
        yield drone, page, pictured_s


def _show(page: CockpitProcess, console: Console, browser: bool) -> None:
    """Print the page's address and open the page. If there is no page, the demonstration continues without it."""
    try:
        address = page.address()
    except LinkError as error:
        console.print(f"[yellow]no page:[/] {error}")
        return
    console.print(f"watch it at [bold cyan]{address}[/]")
    if browser:
        webbrowser.open(address)


def land(drone: Drone, console: Console) -> None:
    """Land, unless another application is flying the drone."""
    status = drone.authority
    if status.state != "held":
        console.print(f"[yellow]{status.holder or 'another application'} took over: leaving the drone to it[/]")
        return
    console.print("landing")
    drone.land()


@contextmanager
def interrupted_by_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` on the first SIGINT or SIGTERM; a second one has its previous effect."""
    before: dict[int, Any] = {}

    def put_back() -> None:
        while before:
            number, handler = before.popitem()
            signal.signal(number, handler)

    def handle(_number: int, _frame: FrameType | None) -> None:
        put_back()
        stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, handle)
    try:
        yield
    finally:
        put_back()


@dataclass(frozen=True, slots=True)
class Spread:
    """Statistics of distance errors [m]."""

    rms: float
    mean: float
    worst: float
    count: int

    @classmethod
    def of(cls, errors: list[float]) -> Spread | None:
        """Return the statistics of the errors, or None if there are none."""
        if not errors:
            return None
        n = len(errors)
        return cls(math.sqrt(sum(e * e for e in errors) / n), sum(errors) / n, max(map(abs, errors)), n)

    def __str__(self) -> str:
        return f"RMS {self.rms:.3f} m, mean {self.mean:+.3f} m, worst {self.worst:.2f} m"


def true_range(native: dict[str, Value] | None) -> float | None:
    """Return the true distance between the centres of the vehicle and the carried board [m]; None if unknown."""
    if native is None:
        return None
    places = [[native.get(name) for name in names] for names in (OWN_PLACE, BOARD_PLACE)]
    own, board = [[float(value) for value in place if isinstance(value, (int, float))] for place in places]
    return math.dist(own, board) if len(own) == len(board) == 3 else None


class TruthMeter:
    """Compares the true distance with the desired one while the marker is followed, within a ``with`` block."""

    def __init__(self, drone: Drone, follower: FollowMarker) -> None:
        self.errors_m: list[float] = []
        self._follower = follower
        self._listener = drone.on_feedback(self._compare)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.cancel()

    def _compare(self, feedback: Feedback) -> None:
        first_ns = self._follower.score.first_seen_ns
        distance = true_range(feedback.native)
        if first_ns is None or distance is None or feedback.captured_ns - first_ns < nanoseconds(SETTLING_S):
            return
        self.errors_m.append(distance - self._follower.distance_m)


@dataclass(slots=True)
class DemoReport:
    """The results of a demonstration, and a table of them."""

    first_picture_s: float | None = None  #: measured from the start of the demo
    frames: int = 0  #: number of frames since the marker was first seen
    share_in_view: float | None = None
    estimated: Spread | None = None
    true: Spread | None = None
    channels: dict[str, ChannelStats] = field(default_factory=dict)
    page: dict[str, Any] | None = None
    collisions: int = 0

    def take(self, drone: Drone, score: FollowScore, truth: TruthMeter, page: dict[str, Any] | None) -> None:
        """Record all data that must be read while the drone is still connected."""
        self.frames = score.frames
        self.share_in_view = score.share_in_view
        self.estimated = Spread.of(score.range_errors_m(SETTLING_S))
        self.true = Spread.of(truth.errors_m)
        self.channels = dict(drone.stats)
        self.page = page

    def good(self, enough: float) -> bool:
        """Return whether the marker was found and was then visible in at least this fraction of the frames."""
        return self.share_in_view is not None and self.share_in_view >= enough

    def verdict(self, enough: float) -> str:
        """Return the reason why the result is bad."""
        if self.share_in_view is None:
            return "the marker was never seen"
        return f"the marker was in view in {self.share_in_view:.1%} of the frames, less than {enough:.0%}"

    def table(self) -> Table:
        """Return the results as a table for the terminal."""
        table = Table(title="The flight", title_justify="left", show_header=False, box=None)
        seen = "never seen" if self.share_in_view is None else f"{self.share_in_view:.1%} of {self.frames} frames"
        rows = [
            ("marker in view since first seen", seen),
            ("range error, by the camera", _spread_text(self.estimated)),
            ("range error, true", _spread_text(self.true)),
            ("collisions", str(self.collisions)),
            ("first frame after", "–" if self.first_picture_s is None else f"{self.first_picture_s:.1f} s"),
        ]
        for name, channel in self.channels.items():
            rows += channel_rows(name, channel)
        if self.page is not None:
            sent, skipped = self.page["frames_sent"], self.page["frames_skipped"]
            rows.append(("page", f"{sent} frames sent, {skipped} skipped for slower browsers"))
        for row in rows:
            table.add_row(*row)
        return table


def _spread_text(spread: Spread | None) -> str:
    return "unknown" if spread is None else f"{spread} (after the first {SETTLING_S:g} s)"


def channel_rows(name: str, channel: ChannelStats) -> list[tuple[str, str]]:
    """Return a channel's row, or no row if the channel is not in use."""
    if not channel.count:
        return []
    text = f"{channel.count} {'sent' if name == 'command' else 'received'}, {channel.lost} lost"
    text += f", {channel.dropped} dropped"
    if channel.delay_s is not None:
        text += f"; delay median {channel.delay_s.median * 1e3:.2f} ms, p99 {channel.delay_s.p99 * 1e3:.2f} ms"
    return [(name, text)]
