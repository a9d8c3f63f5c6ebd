"""``skyloop bench``: measured delays, and how fast the simulator is here."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

if TYPE_CHECKING:
    from skyloop.bench.local import Machine, Results, Spread
    from skyloop.bench.sim import SimResults


class What(StrEnum):
    LOCAL = "local"
    SIM = "sim"


_WHAT_HELP = (
    "local: each channel against the bare hand-over, on this host; sim: the simulator's physics and drawing on one core"
)


def bench(
    what: Annotated[What, typer.Argument(help=_WHAT_HELP)],
    seconds: Annotated[float, typer.Option(min=4.0, help="About how long")] = 40.0,
    json: Annotated[Path | None, typer.Option("--json", help="Write the figures there too")] = None,
) -> None:
    """Measure, as medians and 99th percentiles: delays against the floor, or the simulator against its targets."""
    with Progress(transient=True) as progress:
        task = progress.add_task(f"measuring {what.value}", total=1.0)
        results, tables = _measured(what, seconds, lambda share: progress.update(task, completed=share))
    for shown in tables:
        Console().print(shown)
    if json is not None:
        json.write_bytes(msgspec.json.format(msgspec.json.encode(results), indent=2) + b"\n")


def _measured(
    what: What, seconds: float, progress: Callable[[float], None]
) -> tuple[Results | SimResults, list[Table]]:
    if what is What.SIM:
        from skyloop.bench import sim

        drawn = sim.measure(seconds, progress)
        return drawn, [physics_table(drawn), drawing_table(drawn)]
    from skyloop.bench import local

    results = local.measure(seconds, progress)
    return results, [table(results)]


def table(results: Results) -> Table:
    """The figures as a person reads them."""
    shown = Table(
        "channel",
        "bare hand-over",
        "Skyloop",
        "ratio",
        "target",
        "own thread",
        "samples",
        title=f"Delay in µs: median (p99). {_where(results.machine)}",
        box=None,
    )
    for row in results.rows:
        shown.add_row(
            row.channel,
            _spread(row.floor),
            _spread(row.skyloop),
            f"{row.ratio:.2f} ×",
            f"≤ {row.target} ×",
            "" if row.threaded is None else _spread(row.threaded),
            str(row.skyloop.samples),
        )
    return shown


def physics_table(results: SimResults) -> Table:
    """Flying without pictures."""
    title = "Physics alone, µs a step: median (p99)"
    shown = Table(
        "drones", "world", "a step", "real time", "target", title=title, caption=_where(results.machine), box=None
    )
    for row in results.physics:
        target = "" if row.target is None else f"≥ {row.target:g} ×"
        shown.add_row(str(row.drones), row.world, _spread(row.step), f"{row.real_time:.0f} ×", target)
    return shown


def drawing_table(results: SimResults) -> Table:
    """Pictures with the flaws of the sensor."""
    shown = Table(
        "cameras",
        "size",
        "time",
        "pictures/s",
        "target",
        "samples",
        title="Drawing on one core, ms for one picture of each camera: median (p99)",
        box=None,
    )
    for row in results.drawing:
        shown.add_row(
            row.cameras,
            f"{row.width}×{row.height}",
            f"{row.round.median_us / 1e3:.1f} ({row.round.p99_us / 1e3:.1f})",
            f"{row.frames_per_s:.0f}",
            "" if row.target is None else f"≥ {row.target:g}",
            str(row.round.samples),
        )
    return shown


def _where(machine: Machine) -> str:
    return f"Python {machine.python}, {machine.system}, {machine.cores} cores"


def _spread(spread: Spread) -> str:
    return f"{spread.median_us:.0f} ({spread.p99_us:.0f})"
