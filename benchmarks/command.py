"""The benchmarks' command lines: ``python -m benchmarks.NAME``, each with its own options."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from benchmarks.measuring.command_line import (
    Minutes,
    Output,
    Seconds,
    Sizes,
    as_rich,
    duration_s,
    finish,
    measure_delays,
    measuring,
    parse_sizes,
    print_skipped,
)
from benchmarks.measuring.tables import verdict_table
from benchmarks.one_command import one_command
from skyloop.cli.app import run
from skyloop.errors import MissingExtraError, UsageError


def peers(
    peers: Annotated[
        str, typer.Option(help="Compare with portable, fabric, ros2, zenoh, zeromq (comma-separated), all or none")
    ] = "all",
    ros_python: Annotated[
        str | None, typer.Option(help="Python interpreter with rclpy [default: $SKYLOOP_ROS_PYTHON or this one]")
    ] = None,
    sizes: Sizes = None,
    seconds: Seconds = None,
    minutes: Minutes = None,
    output: Output = None,
) -> None:
    """Measure other libraries beside Skyloop and the bare hand-over, in turns: the paper's experiment."""
    from benchmarks.measuring.figures import draw
    from benchmarks.peers import chosen, find

    wanted_s, wanted = duration_s(seconds, minutes), parse_sizes(sizes)
    found, skipped = find(chosen(peers), ros_python)
    with measuring("delays", output) as progress:
        results, shown = measure_delays(wanted_s, wanted, found, skipped, progress)
    finish("delays", results, shown, output, draw)


def loop(sizes: Sizes = None, seconds: Seconds = None, minutes: Minutes = None, output: Output = None) -> None:
    """Measure the path from a frame to the resulting command, by stage."""
    from benchmarks.measuring import loop
    from benchmarks.measuring.tables import loop_table

    wanted_s, wanted = duration_s(seconds, minutes), parse_sizes(sizes)
    with measuring("loop", output) as progress:
        results = loop.measure(wanted_s, wanted, progress)
    finish("loop", results, as_rich([loop_table(results)], str(results.machine)), output)


def load(
    observers: Annotated[str | None, typer.Option(help="Numbers of observers, one case each [default: 1,8,32]")] = None,
    slow_processor: Annotated[
        bool, typer.Option("--slow-processor/--no-slow-processor", help="A processor that takes 200 ms per frame")
    ] = True,
    stuck: Annotated[bool, typer.Option("--stuck/--no-stuck", help="8 observers, one of which is stopped")] = True,
    recorder: Annotated[
        bool, typer.Option("--recorder/--no-recorder", help="Record 640x480 at 30 frames per second")
    ] = True,
    disk_full: Annotated[
        bool, typer.Option("--disk-full/--no-disk-full", help="The same, to a disk that fills up")
    ] = True,
    record_to: Annotated[Path | None, typer.Option(help="Folder for the recorder")] = None,
    pages: Annotated[
        int, typer.Option(min=0, max=50, help="Pages of a cockpit, with 640x480 at 15 frames per second; 0 for none")
    ] = 10,
    encoded: Annotated[
        bool, typer.Option("--encoded/--no-encoded", help="8 viewers of H.264, one of them stopped")
    ] = True,
    viewed: Annotated[
        bool, typer.Option("--viewed/--no-viewed", help="A viewer of skyloop view --foxglove, and a stopped one")
    ] = True,
    seconds: Seconds = None,
    minutes: Minutes = None,
    output: Output = None,
) -> None:
    """Measure how observers, a slow processor, a recorder, cockpit pages and a viewer affect the pilot.

    Starts up to 35 processes. Close all other programs first.
    """
    from benchmarks import load, tables
    from benchmarks.onlookers import cockpit_problem, recorder_problem, view_problem
    from benchmarks.targets import judge_load

    wanted_s, numbers = duration_s(seconds, minutes), parse_numbers(observers)
    skipped = {}
    if (recorder or disk_full) and (problem := recorder_problem()):
        recorder = disk_full = False
        skipped[load.RECORDED] = problem
    if pages and (problem := cockpit_problem()):
        skipped[load.pages_name(pages)] = problem
        pages = 0
    if encoded and find_spec("av") is None:
        skipped[load.ENCODED] = str(MissingExtraError("encoding H.264", "video"))
        encoded = False
    if viewed and (problem := view_problem()):
        skipped[load.VIEWED] = problem
        viewed = False
    cases = load.cases_of(
        numbers,
        slow_processor=slow_processor,
        stuck=stuck,
        recorder=recorder,
        disk_full=disk_full,
        pages=pages,
        encoded=encoded,
        viewed=viewed,
    )
    with measuring("load", output) as progress:
        results = load.measure(wanted_s, cases, record_to=record_to, skipped=skipped, progress=progress)
    print_skipped(results.skipped)
    found = [tables.load_table(results), tables.cpu_table(results), verdict_table(judge_load(results))]
    finish("load", results, as_rich(found, str(results.machine)), output)


def codecs(seconds: Seconds = None, minutes: Minutes = None, output: Output = None) -> None:
    """Measure the processor time of the AR.Drones' video and navdata on one core."""
    from benchmarks import codecs, tables

    wanted_s = duration_s(seconds, minutes)
    with measuring("codecs", output) as progress:
        results = codecs.measure(wanted_s, progress)
    print_skipped(results.skipped)
    finish("codecs", results, as_rich([tables.codecs_table(results)], str(results.machine)), output)


def network(
    losses: Annotated[str | None, typer.Option(help="Fractions of packets lost [default: 0,0.01,0.1,0.3]")] = None,
    seconds: Seconds = None,
    minutes: Minutes = None,
    output: Output = None,
) -> None:
    """Measure the channels between two hosts over a lossy path. Needs root."""
    from benchmarks import network, tables

    wanted_s, shares = duration_s(seconds, minutes), parse_shares(losses)
    with measuring("network", output) as progress:
        results = network.measure(wanted_s, shares, progress=progress)
    found = [tables.network_table(results), tables.path_table(results)]
    finish("network", results, as_rich(found, str(results.machine)), output)


def swarm(
    drones: Annotated[int, typer.Option(min=1, max=50, help="How many")] = 10,
    users: Annotated[int, typer.Option(min=1, max=10, help="Processes that share the drones")] = 1,
    observers: Annotated[str | None, typer.Option(help="Numbers of observers [default: 0]")] = None,
    seconds: Seconds = None,
    minutes: Minutes = None,
    output: Output = None,
) -> None:
    """Fly simulated drones over the network with users that stall and die, and count missed failsafes."""
    from benchmarks import swarm, tables

    wanted_s, looking_on = duration_s(seconds, minutes), parse_numbers(observers, "0")[0]
    if users > drones:
        raise UsageError(f"--users is {users}, and there are only {drones} drones to share")
    with measuring("swarm", output) as progress:
        results = swarm.measure(wanted_s, drones, users, looking_on, progress)
    finish("swarm", results, as_rich([tables.swarm_table([results])], str(results.machine)), output)


def scale(
    counts: Annotated[
        str | None, typer.Option(help="Numbers of proxies, and of observers [default: 1,2,5,10,20,50]")
    ] = None,
    seconds: Seconds = None,
    minutes: Minutes = None,
    output: Output = None,
) -> None:
    """Measure growing numbers of proxies and observers on one host."""
    from benchmarks import scale, tables
    from benchmarks.scale_figure import draw

    wanted_s, numbers = duration_s(seconds, minutes), parse_numbers(counts, "1,2,5,10,20,50", "--counts")
    with measuring("scale", output) as progress:
        results = scale.measure(wanted_s, scale.cases_of(numbers), progress)
    print_skipped(results.skipped)
    found = [tables.scale_table(results, many) for many in ("proxies", "observers")]
    finish("scale", results, as_rich(found, str(results.machine)), output, draw)


def fleet(
    vehicles: Annotated[int, typer.Option(min=0, max=500, help="Vehicles in one host; 0: none")] = 100,
    observers: Annotated[
        int, typer.Option(min=0, max=100, help="Observers of one of them, in another case; 0: none")
    ] = 50,
    networked: Annotated[int, typer.Option(min=0, max=500, help="Vehicles over the network; 0: none")] = 50,
    mavlink: Annotated[
        int, typer.Option(min=0, max=500, help="Emulated MAVLink vehicles, half of them in formation; 0: none")
    ] = 40,
    busy_ms: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Processor time of each driver for a command, to create overload")
    ] = 0.0,
    seconds: Seconds = None,
    minutes: Minutes = None,
    output: Output = None,
) -> None:
    """Measure many vehicles in one host, flown from one process."""
    from benchmarks import fleet, tables

    wanted_s = duration_s(seconds, minutes)
    with measuring("fleet", output) as progress:
        cases = fleet.cases_of(vehicles, observers, networked, busy_ms / 1e3)
        results = fleet.measure(wanted_s, cases, progress, mavlink=mavlink)
    shown = [tables.fleet_table(results)] if results.cases else []
    if results.mavlink is not None:
        shown.append(tables.mavlink_table(results.mavlink))
    finish("fleet", results, as_rich(shown, str(results.machine)), output)


def learning(seconds: Seconds = None, minutes: Minutes = None, output: Output = None) -> None:
    """Measure how fast Gymnasium environments step, with pictures and without."""
    from benchmarks import learning

    wanted_s = duration_s(seconds, minutes)
    with measuring("learning", output) as progress:
        results = learning.measure(wanted_s, progress=lambda share: progress(share, "environments"))
    finish("learning", results, as_rich([learning.table(results)], str(results.machine)), output)


def ros(
    ros_python: Annotated[
        str | None,
        typer.Option(help="Python interpreter with rclpy and Skyloop [default: $SKYLOOP_ROS_PYTHON or this one]"),
    ] = None,
    seconds: Seconds = None,
    minutes: Minutes = None,
    output: Output = None,
) -> None:
    """Measure what the bridge to ROS 2 adds to the delays of commands and images."""
    from benchmarks import ros

    wanted_s = duration_s(seconds, minutes)
    with measuring("ros", output) as progress:
        results = ros.measure(wanted_s, ros_python, progress)
    finish("ros", results, as_rich([ros.table(results)], str(results.machine)), output)


def recordings(
    encode: Annotated[
        bool, typer.Option("--encode/--no-encode", help="Also measure the export that encodes each picture")
    ] = True,
    seconds: Annotated[float | None, typer.Option(min=1.0, help="Length of the flight [default: 600]")] = None,
    minutes: Annotated[float | None, typer.Option(min=0.1, help="The same in minutes")] = None,
    output: Output = None,
) -> None:
    """Measure how long it takes to open, inspect, seek in and export a recording."""
    from benchmarks import recordings

    flight = 600.0 if seconds is minutes is None else duration_s(seconds, minutes)
    with measuring("recordings", output) as progress:
        results = recordings.measure(flight, encode=encode, progress=lambda share: progress(share, "a recording"))
    finish("recordings", results, as_rich([recordings.table(results)], str(results.machine)), output)


def video_path(
    traces: Annotated[
        str | None, typer.Option(help="Uplinks, comma-separated [default: the recorded ones, or synthetic]")
    ] = None,
    contenders: Annotated[str | None, typer.Option(help="Prefixes of names, comma-separated [default: all]")] = None,
    seconds: Seconds = None,
    minutes: Minutes = None,
    output: Output = None,
) -> None:
    """Measure video over replayed uplinks of mobile networks, beside WebRTC. Needs root."""
    from benchmarks import video_path
    from benchmarks.hosts.traces import find
    from benchmarks.video_path_figure import draw

    wanted_s, found = duration_s(seconds, minutes), find(parse_words(traces))
    chosen = parse_beginnings(contenders, video_path.CONTENDERS)
    with measuring("video_path", output) as progress:
        results = video_path.measure(wanted_s, found, chosen, progress)
    print_skipped(results.skipped)
    finish("video_path", results, as_rich([video_path.table(results)], str(results.machine)), output, draw)


BENCHMARKS: Final[Mapping[str, Callable[..., Any]]] = {
    function.__name__: function
    for function in (
        peers,
        loop,
        load,
        codecs,
        network,
        swarm,
        scale,
        fleet,
        learning,
        ros,
        recordings,
        video_path,
    )
}


def build(name: str) -> typer.Typer:
    """Return the command line of one benchmark."""
    return one_command(BENCHMARKS[name])


def main(name: str) -> None:
    """Run one benchmark; exit as ``skyloop`` does."""
    run(build(name), sys.argv[1:], f"benchmarks.{name}")


def parse_numbers(text: str | None, default: str = "1,8,32", option: str = "--observers") -> list[int]:
    """Parse numbers such as ``1,8,32``.

    Raises:
        UsageError: The text is anything else.
    """
    words = [word.strip() for word in (default if text is None else text).split(",")]
    if not all(word.isdecimal() and int(word) <= 100 for word in words):
        raise UsageError(f"{option} is {text!r} and must be comma-separated numbers up to 100, such as 1,8,32")
    return [int(word) for word in words]


def parse_shares(text: str | None) -> list[float]:
    """Parse fractions such as ``0,0.1``.

    Raises:
        UsageError: The text is anything else.
    """
    from benchmarks.network import LOSSES

    if text is None:
        return list(LOSSES)
    try:
        shares = [float(word) for word in text.split(",")]
    except ValueError:
        shares = [math.nan]
    if not all(0.0 <= share < 1.0 for share in shares):
        raise UsageError(f"--losses is {text!r} and must be fractions from 0 to below 1, such as 0,0.1,0.3")
    return list(dict.fromkeys(shares))


def parse_words(text: str | None) -> tuple[str, ...]:
    """Parse comma-separated names."""
    return tuple(word.strip() for word in (text or "").split(",") if word.strip())


def parse_beginnings(text: str | None, names: Sequence[str]) -> list[str]:
    """Return the names that begin with one of the words, ignoring case; without words, return all names.

    Raises:
        UsageError: No name begins with one of the words.
    """
    words = [word.lower() for word in parse_words(text)]
    for word in words:
        if not any(name.lower().startswith(word) for name in names):
            raise UsageError(f"no contender begins with {word!r}: there are {'; '.join(names)}")
    return [name for name in names if not words or name.lower().startswith(tuple(words))]
