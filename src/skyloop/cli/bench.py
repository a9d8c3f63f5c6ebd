"""``skyloop bench``: measured delays, and how fast the simulator and the codecs are here."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import msgspec
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.bench import tables
    from skyloop.bench.schedule import Size
    from skyloop.bench.sim import SimResults
    from skyloop.bench.statistics import Spread


class What(StrEnum):
    DELAYS = "delays"
    LOAD = "load"
    LOOP = "loop"
    SIM = "sim"
    CODECS = "codecs"
    NETWORK = "network"
    SWARM = "swarm"
    SCALE = "scale"


LEAST_S = 0.5
_WHAT_HELP = (
    "delays: the paper's experiment, and the same by a bare hand-over and by other libraries; load: what observers, a "
    "slow processor, a recorder and pages of the cockpit do to the pilot; loop: from a frame to its command, by stage; "
    "sim: the simulator; codecs: the AR.Drones' video and navdata; network: two hosts with a lossy path between (needs "
    "root); swarm: drones over the network whose users fail; scale: more and more proxies and observers"
)
_ONLY = {  # options that mean something for one thing only
    "--peers": (What.DELAYS,),
    "--ros-python": (What.DELAYS,),
    "--sizes": (What.DELAYS, What.LOOP),
    "--observers": (What.LOAD, What.SWARM),
    "--slow-processor": (What.LOAD,),
    "--stuck": (What.LOAD,),
    "--recorder": (What.LOAD,),
    "--disk-full": (What.LOAD,),
    "--record-to": (What.LOAD,),
    "--pages": (What.LOAD,),
    "--losses": (What.NETWORK,),
    "--drones": (What.SWARM,),
    "--users": (What.SWARM,),
    "--counts": (What.SCALE,),
}


def bench(
    what: Annotated[What, typer.Argument(help=_WHAT_HELP)],
    seconds: Annotated[
        float | None, typer.Option(min=LEAST_S, help="How long to measure each contender, case or size [default: 30]")
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0.01, help="The same in minutes; the paper's were 5")] = None,
    sizes: Annotated[
        str | None, typer.Option(help="delays, loop: of the frames, such as 320x240,640x480 [default: 320x240]")
    ] = None,
    peers: Annotated[
        str | None, typer.Option(help="delays: compare with fabric, ros2, zenoh, zeromq, several with commas, or all")
    ] = None,
    ros_python: Annotated[
        str | None, typer.Option(help="delays: the Python that has rclpy [default: $SKYLOOP_ROS_PYTHON or this one]")
    ] = None,
    observers: Annotated[
        str | None,
        typer.Option(help="load: how many, one case for each number [default: 1,8,32]; swarm: how many [default: 0]"),
    ] = None,
    slow_processor: Annotated[
        bool | None, typer.Option("--slow-processor/--no-slow-processor", help="load: 200 ms a frame")
    ] = None,
    stuck: Annotated[bool | None, typer.Option("--stuck/--no-stuck", help="load: one of 8 observers stopped")] = None,
    recorder: Annotated[
        bool | None, typer.Option("--recorder/--no-recorder", help="load: record 640x480 at 30 frames a second")
    ] = None,
    disk_full: Annotated[
        bool | None, typer.Option("--disk-full/--no-disk-full", help="load: the same onto a disk that fills up")
    ] = None,
    record_to: Annotated[Path | None, typer.Option(help="load: the folder that the recorder writes to")] = None,
    pages: Annotated[
        int | None,
        typer.Option(min=0, max=50, help="load: of a cockpit, on 640x480 at 15 frames a second [default: 10]"),
    ] = None,
    losses: Annotated[
        str | None, typer.Option(help="network: shares of the packets that are lost [default: 0,0.01,0.1,0.3]")
    ] = None,
    drones: Annotated[int | None, typer.Option(min=1, max=50, help="swarm: how many [default: 10]")] = None,
    users: Annotated[
        int | None, typer.Option(min=1, max=10, help="swarm: processes that share the drones [default: 1]")
    ] = None,
    counts: Annotated[
        str | None, typer.Option(help="scale: of proxies, and of observers [default: 1,2,5,10,20,50]")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="A folder for the figures as JSON and, of delays and scale, the diagrams")
    ] = None,
) -> None:
    """Measure delays, as medians and 99th percentiles, or how fast the simulator and the codecs are.

    Targets stand beside the figures. Example: skyloop bench load --pages 10 --seconds 60 --output results

    load and the recorder's cases start up to 35 processes. Nothing else should run meanwhile.
    """
    given = {
        "--sizes": sizes,
        "--peers": peers,
        "--ros-python": ros_python,
        "--observers": observers,
        "--slow-processor": slow_processor,
        "--stuck": stuck,
        "--recorder": recorder,
        "--disk-full": disk_full,
        "--record-to": record_to,
        "--pages": pages,
        "--losses": losses,
        "--drones": drones,
        "--users": users,
        "--counts": counts,
    }
    check_options(what, given)
    if seconds is not None and minutes is not None:
        raise UsageError("--seconds and --minutes say the same: give one of them")
    duration_s = max(LEAST_S, minutes * 60.0) if minutes is not None else seconds if seconds is not None else 30.0
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
    with Progress(transient=True, disable=not sys.stderr.isatty(), console=Console(stderr=True)) as bar:
        task = bar.add_task(f"measuring {what.value}", total=1.0)

        def progress(share: float, doing: str = "") -> None:
            bar.update(task, completed=share, description=doing or f"measuring {what.value}")

        match what:
            case What.DELAYS:
                results, shown = _delays(duration_s, sizes, peers, ros_python, progress)
            case What.LOAD:
                wanted = _LoadOptions(
                    parse_numbers(observers),
                    slow_processor is not False,
                    stuck is not False,
                    recorder is not False,
                    disk_full is not False,
                    10 if pages is None else pages,
                )
                results, shown = _load(duration_s, wanted, record_to, progress)
            case What.LOOP:
                results, shown = _loop(duration_s, sizes, progress)
            case What.SIM:
                results, shown = _sim(duration_s, progress)
            case What.CODECS:
                results, shown = _codecs(duration_s, progress)
            case What.NETWORK:
                results, shown = _network(duration_s, parse_shares(losses), progress)
            case What.SWARM:
                looking_on = parse_numbers(observers, "0")[0]
                results, shown = _swarm(duration_s, drones or 10, users or 1, looking_on, progress)
            case What.SCALE:
                results, shown = _scale(duration_s, parse_numbers(counts, "1,2,5,10,20,50", "--counts"), progress)
    for table in shown:
        Console().print(table)
    if output is not None:
        for file in write(what, results, output):
            typer.echo(f"wrote {file}")


def check_options(what: What, given: Mapping[str, object]) -> None:
    """Raises :class:`UsageError` for an option that means nothing for this."""
    for option, value in given.items():
        if value is not None and what not in _ONLY[option]:
            raise UsageError(f"{option} is for bench {' and '.join(_ONLY[option])}, not for bench {what.value}")


def parse_sizes(text: str | None) -> list[Size]:
    """Sizes of frames such as ``320x240,640x480``. Raises :class:`UsageError`."""
    from skyloop.bench.schedule import LARGE, SMALL, Size

    if text is None:
        return [SMALL]
    sizes = []
    for word in text.split(","):
        width, _, height = word.strip().replace("×", "x").partition("x")
        size = Size(int(width), int(height)) if width.isdecimal() and height.isdecimal() else Size(0, 0)
        if not 0 < size.frame_bytes <= LARGE.frame_bytes:
            raise UsageError(
                f"{word!r} is no size of frames: give such as 320x240, at most {LARGE.width}x{LARGE.height}"
            )
        sizes.append(size)
    return list(dict.fromkeys(sizes))


def parse_numbers(text: str | None, default: str = "1,8,32", option: str = "--observers") -> list[int]:
    """Numbers such as ``1,8,32``. Raises :class:`UsageError`."""
    words = [word.strip() for word in (default if text is None else text).split(",")]
    if not all(word.isdecimal() and int(word) <= 100 for word in words):
        raise UsageError(f"{option} is {text!r} and must be numbers up to 100 with commas, such as 1,8,32")
    return [int(word) for word in words]


def parse_shares(text: str | None) -> list[float]:
    """Shares such as ``0,0.1``. Raises :class:`UsageError`."""
    from skyloop.bench.network import LOSSES

    if text is None:
        return list(LOSSES)
    try:
        shares = [float(word) for word in text.split(",")]
    except ValueError:
        shares = [math.nan]
    if not all(0.0 <= share < 1.0 for share in shares):
        raise UsageError(f"--losses is {text!r} and must be shares from 0 to below 1 with commas, such as 0,0.1,0.3")
    return list(dict.fromkeys(shares))


def write(what: What, results: Any, folder: Path) -> list[Path]:
    """The results as JSON, and the diagrams of delays and scale.

    Raises :class:`MissingExtraError` after the JSON is written.
    """
    file = folder / f"{what.value}.json"
    file.write_bytes(msgspec.json.encode(results) + b"\n")
    if what is What.DELAYS:
        from skyloop.bench.figures import draw

        return [file, *draw(results, folder)]
    if what is What.SCALE:
        from skyloop.bench.scale_figure import draw as draw_scale

        return [file, *draw_scale(results, folder)]
    return [file]


def _delays(
    seconds: float, sizes: str | None, peers: str | None, ros_python: str | None, progress: Any
) -> tuple[Any, list[Table]]:
    from skyloop.bench import delays, tables
    from skyloop.bench.peers import chosen, find
    from skyloop.bench.targets import judge_delays

    wanted = parse_sizes(sizes)
    found, skipped = find(chosen(peers or "none"), ros_python)
    for name, why in skipped.items():
        typer.echo(f"without {name}: {why}", err=True)
    results = delays.measure(seconds, wanted, found, skipped, progress)
    verdicts = tables.verdict_table(judge_delays(results))
    return results, _rich(
        [tables.paper_table(results), tables.comparison_table(results), verdicts], str(results.machine)
    )


class _LoadOptions(NamedTuple):
    """As :func:`skyloop.bench.load.cases_of` takes them."""

    observers: list[int]
    slow_processor: bool
    stuck: bool
    recorder: bool
    disk_full: bool
    pages: int


def _load(seconds: float, wanted: _LoadOptions, record_to: Path | None, progress: Any) -> tuple[Any, list[Table]]:
    from skyloop.bench import load, tables
    from skyloop.bench.onlookers import cockpit_problem, recorder_problem
    from skyloop.bench.targets import judge_load

    skipped = {}
    if (wanted.recorder or wanted.disk_full) and (problem := recorder_problem()):
        wanted = wanted._replace(recorder=False, disk_full=False)
        skipped[load.RECORDED] = problem
    if wanted.pages and (problem := cockpit_problem()):
        skipped[load.pages_name(wanted.pages)] = problem
        wanted = wanted._replace(pages=0)
    cases = load.cases_of(**wanted._asdict())
    results = load.measure(seconds, cases, record_to=record_to, skipped=skipped, progress=progress)
    for name, why in results.skipped.items():
        typer.echo(f"without {name}: {why}", err=True)
    return results, _rich(
        [tables.load_table(results), tables.cpu_table(results), tables.verdict_table(judge_load(results))],
        str(results.machine),
    )


def _loop(seconds: float, sizes: str | None, progress: Any) -> tuple[Any, list[Table]]:
    from skyloop.bench import loop, tables

    results = loop.measure(seconds, parse_sizes(sizes), progress)
    return results, _rich([tables.loop_table(results)], str(results.machine))


def _sim(seconds: float, progress: Any) -> tuple[Any, list[Table]]:
    from skyloop.bench import sim

    results = sim.measure(seconds, progress)
    return results, [physics_table(results), drawing_table(results)]


def _codecs(seconds: float, progress: Any) -> tuple[Any, list[Table]]:
    from skyloop.bench import codecs, tables

    results = codecs.measure(seconds, progress)
    for name, why in results.skipped.items():
        typer.echo(f"without {name}: {why}", err=True)
    return results, _rich([tables.codecs_table(results)], str(results.machine))


def _network(seconds: float, losses: Sequence[float], progress: Any) -> tuple[Any, list[Table]]:
    from skyloop.bench import network, network_tables

    results = network.measure(seconds, losses, progress=progress)
    found = [network_tables.network_table(results), network_tables.path_table(results)]
    return results, _rich(found, str(results.machine))


def _swarm(seconds: float, drones: int, users: int, observers: int, progress: Any) -> tuple[Any, list[Table]]:
    from skyloop.bench import network_tables, swarm

    if users > drones:
        raise UsageError(f"--users is {users}, and there are only {drones} drones to share")
    results = swarm.measure(seconds, drones, users, observers, progress)
    return results, _rich([network_tables.swarm_table([results])], str(results.machine))


def _scale(seconds: float, counts: Sequence[int], progress: Any) -> tuple[Any, list[Table]]:
    from skyloop.bench import network_tables, scale

    results = scale.measure(seconds, scale.cases_of(counts), progress)
    for name, why in results.skipped.items():
        typer.echo(f"without {name}: {why}", err=True)
    found = [network_tables.scale_table(results, many) for many in ("proxies", "observers")]
    return results, _rich(found, str(results.machine))


def _rich(found: Sequence[tables.Table], where: str) -> list[Table]:
    shown = []
    for one in found:
        if one.rows:
            table = Table(*one.columns, title=one.title, caption=where, box=None)
            for row in one.rows:
                table.add_row(*row)
            shown.append(table)
    return shown


def physics_table(results: SimResults) -> Table:
    """Flying without pictures."""
    title = "Physics alone, µs a step: median (p99)"
    shown = Table(
        "drones", "world", "a step", "real time", "target", title=title, caption=str(results.machine), box=None
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


def _spread(spread: Spread) -> str:
    return f"{spread.median_us:.0f} ({spread.p99_us:.0f})"
