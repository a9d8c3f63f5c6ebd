"""``skyloop watch``: shows a drone's state, as a live display in a terminal or line by line in a pipe."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import typer
from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from skyloop.cli import naming
from skyloop.cli.text import json_text, named
from skyloop.messages import Event, Failsafe, Feedback, ReturnPhase, Severity

if TYPE_CHECKING:
    from skyloop.client import Drone

REFRESH_HZ: Final = 8  #: of the live display
WIDE_COLUMNS: Final = 60  #: at this width and above, two facts are shown side by side
ROOMY_COLUMNS: Final = 90  #: at this width and above, there is space between them
LINE_EVERY_S: Final = 1.0  #: interval between lines if the output is not a terminal
EVENTS_SHOWN: Final = 8  #: number of newest events in the live display
COLOURS: Final = {Severity.INFO: "cyan", Severity.WARNING: "yellow", Severity.ERROR: "red"}


def watch(
    name: naming.NameArgument = None,
    drone: naming.DroneOption = None,
    seconds: naming.SecondsOption = None,
    video: Annotated[bool, typer.Option(help="Request the first camera's frames, to show their rate and age")] = True,
    json: Annotated[
        bool, typer.Option("--json", help="Print JSON lines, one each second and one for each event")
    ] = False,
    network: naming.NetworkOption = None,
    keys: naming.KeysOption = None,
) -> None:
    """Show state, attitude, authority, links, channels and events of a drone, live. Read-only.

    If the output is not a terminal, a line is printed each second, and one for each event.
    """
    from skyloop.client import connect

    naming.join_network(network, keys)
    with connect(naming.one_drone(name, drone), access="observe", name="skyloop watch") as watched:
        duration_s = math.inf if seconds is None else seconds
        if video and watched.capabilities.cameras:
            watched.frame()  # the first call subscribes to frames
        try:
            if json:
                _lines(watched, duration_s, _state_json, _event_json)
            elif sys.stdout.isatty():
                _live(watched, duration_s)
            else:
                _lines(watched, duration_s, state_line, event_line)
        except KeyboardInterrupt:
            pass  # this is the normal way to stop


def _lines(drone: Drone, duration_s: float, state: Callable[[Drone], str], event: Callable[[Event], str]) -> None:
    """Print a line every second, with absolute deadlines; the first line is printed immediately."""
    due = time.monotonic()
    end = due + duration_s

    def show(one: Event) -> None:
        with suppress(BrokenPipeError):  # the reader has exited; printing the next line will raise the same error
            typer.echo(event(one))

    with drone.on_event(show):
        typer.echo(state(drone))
        while (due := due + LINE_EVERY_S) <= end:
            time.sleep(max(0.0, due - time.monotonic()))
            typer.echo(state(drone))


def _live(drone: Drone, duration_s: float) -> None:
    end = time.monotonic() + duration_s
    with Live(console=Console(), refresh_per_second=REFRESH_HZ) as live:
        while time.monotonic() < end:
            live.update(picture(drone))
            time.sleep(1 / REFRESH_HZ)


# Lines ---------------------------------------------------------------------------------------------------------


def state_line(drone: Drone) -> str:
    feedback, link = drone.feedback(), drone.link
    rates = [f"{name} {channel.rate_hz:.0f}/s" for name, channel in drone.stats.items() if channel.count > 1]
    parts = [
        time.strftime("%H:%M:%S"),
        feedback.state.value,
        f"altitude {_metres(feedback.altitude_m)}",
        f"battery {_share(feedback.battery)}",
        f"pilot {feedback.owner or 'nobody'}",
        f"proxy {link.application.value}",
        f"vehicle {link.vehicle.value}",
        *([f"failsafe {feedback.failsafe.value}"] if feedback.failsafe is not Failsafe.NONE else []),
        *([f"return {feedback.return_phase}"] if feedback.return_phase is not ReturnPhase.NONE else []),
        *rates,
    ]
    return "  ".join(parts)


def event_line(event: Event) -> str:
    return f"{time.strftime('%H:%M:%S')}  {event.severity.value}: {event.text}"


def _state_json(drone: Drone) -> str:
    shown = {"feedback": msgspec.structs.asdict(drone.feedback()), "link": drone.link, "stats": drone.stats}
    return json_text(shown)


def _event_json(event: Event) -> str:
    return json_text({"event": msgspec.structs.asdict(event)})


# The live picture ----------------------------------------------------------------------------------------------


def picture(drone: Drone) -> Group:
    return Group(state_panel(drone), channels(drone), *events(drone, EVENTS_SHOWN))


def state_panel(drone: Drone) -> Panel:
    return Panel(_state(drone), title=Text(f"{drone.name} · {drone.uri}"), title_align="left")


def events(drone: Drone, count: int) -> list[Text]:
    """Return the newest events, one line each."""
    newest_ns = drone.feedback().captured_ns
    return [
        Text.assemble((f"{(event.at_ns - newest_ns) / 1e9:+7.1f} s", COLOURS[event.severity]), f" {event.text}")
        for event in drone.recent_events()[-count:]
    ]


def _state(drone: Drone) -> Table:
    feedback, link = drone.feedback(), drone.link
    table = Table.grid(padding=(0, 3 if _width() > ROOMY_COLUMNS else 1))
    pairs: list[tuple[str, str | Text]] = [
        ("state", Text(feedback.state.value, "bold")),
        ("pilot", Text(feedback.owner or "nobody")),
        ("battery", _share(feedback.battery)),
        ("failsafe", feedback.failsafe.value),
        ("roll, pitch, yaw", _angles(feedback)),
        ("link to proxy", link.application.value),
        ("altitude", _metres(feedback.altitude_m)),
        ("link to vehicle", link.vehicle.value),
        ("velocity", _vector(feedback.velocity_m_s, "m/s")),
        ("position", _vector(feedback.position_m, "m")),
    ]
    if _is_narrow():
        for pair in pairs:
            table.add_row(*pair)
    else:
        for left, right in zip(pairs[::2], pairs[1::2], strict=True):
            table.add_row(*left, *right)
    return table


def channels(drone: Drone) -> Table:
    """Return rates, delays and ages, one line per channel; a narrow terminal shows only the most important ones."""
    titles = ("rate", "delay median", "age", "p99", "lost", "dropped")
    table = Table(named("channel"), *((*titles[:1], "delay", "age") if _is_narrow() else titles), box=None)
    for name, channel in drone.stats.items():
        delay = channel.delay_s
        cells = (
            f"{channel.rate_hz:.1f} Hz",
            "–" if delay is None else f"{delay.median * 1e3:.2f} ms",
            "–" if channel.age_s is None else f"{channel.age_s * 1e3:.0f} ms",
            "–" if delay is None else f"{delay.p99 * 1e3:.2f} ms",
            str(channel.lost),
            str(channel.dropped),
        )
        table.add_row(name, *cells[: len(table.columns) - 1])
    return table


def _is_narrow() -> bool:
    """Return whether the terminal is too narrow to show two facts side by side."""
    return _width() < WIDE_COLUMNS


def _width() -> int:
    return shutil.get_terminal_size().columns


def _angles(feedback: Feedback) -> str:
    if feedback.roll_rad is None or feedback.pitch_rad is None or feedback.yaw_rad is None:
        return "unknown"
    return " ".join(f"{math.degrees(a):5.1f}°" for a in (feedback.roll_rad, feedback.pitch_rad, feedback.yaw_rad))


def _share(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.0%}"


def _metres(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} m"


def _vector(value: tuple[float, float, float] | None, unit: str) -> str:
    return "unknown" if value is None else " ".join(f"{v:5.2f}" for v in value) + f" {unit}"
