"""``skyloop record``: records drones to a file; ``skyloop view``: shows them live in Foxglove or Rerun."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, cast

import typer

from skyloop.cli import interrupt_by_signals
from skyloop.cli.naming import DronesOption, KeysOption, NamesArgument, NetworkOption, drones, join_network
from skyloop.errors import SkyloopError, UsageError

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.recording import Recorder, Status
    from skyloop.recording.options import VideoEncoding
    from skyloop.recording.taps import Screen, View

REFRESH_S: Final = 0.25  # used on a terminal
LINE_EVERY_S: Final = 1.0  # used if the output is a pipe
_POLL_S: Final = 0.5  # interval at which a viewer's subscriptions are checked


def record(
    names: NamesArgument = None,
    drone: DronesOption = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="PATH", help="File, or folder for an automatic name")
    ] = Path(),
    channels: Annotated[
        str | None,
        typer.Option(
            metavar="LIST", help="Only these, comma-separated: commands, feedback, events, video, video.front, logs …"
        ),
    ] = None,
    encoding: Annotated[
        str,
        typer.Option(
            metavar="auto|jpeg|png", help="Encoding of frames; auto keeps H.264 unchanged, else jpeg; png is lossless"
        ),
    ] = "auto",
    quality: Annotated[int, typer.Option(min=1, max=100, help="Quality of JPEG")] = 90,
    rotate_mb: Annotated[float | None, typer.Option(metavar="MB", min=1.0, help="Maximum size of a file")] = None,
    rotate_s: Annotated[float | None, typer.Option(metavar="S", min=1.0, help="Maximum time of a file")] = None,
    min_free_mb: Annotated[float, typer.Option(metavar="MB", min=0.0, help="Disk space to leave free")] = 256.0,
    buffer_mb: Annotated[float, typer.Option(metavar="MB", min=1.0, help="Buffer for a slow disk")] = 64.0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite an existing file")] = False,
    seconds: Annotated[float | None, typer.Option(metavar="S", min=0.0, help="Duration [until Ctrl-C]")] = None,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Record drones to an MCAP file until Ctrl-C. This command only observes: others may fly meanwhile.

    If the output is not a terminal, a line is printed every second.
    """
    from skyloop.recording import record as start

    join_network(network, keys)
    recorder = start(
        drones(names, drone),
        output,
        channels=None if channels is None else [name.strip() for name in channels.split(",")],
        encoding=cast("VideoEncoding", encoding),  # validated by the recorder
        quality=quality,
        rotate_mb=rotate_mb,
        rotate_s=rotate_s,
        min_free_mb=min_free_mb,
        buffer_mb=buffer_mb,
        overwrite=overwrite,
        in_process=True,
    )
    interrupt_by_signals((signal.SIGTERM,))
    with recorder, suppress(KeyboardInterrupt):  # this is the normal way to stop
        _show(recorder, math.inf if seconds is None else seconds)
    _conclude(recorder)


def _show(recorder: Recorder, seconds: float) -> None:
    live = sys.stdout.isatty()
    every_s = REFRESH_S if live else LINE_EVERY_S
    before = recorder.status
    due = time.monotonic()
    end = due + seconds
    while (now := time.monotonic()) < end:
        due = max(due + every_s, now)
        time.sleep(max(0.0, min(due, end) - time.monotonic()))
        status = recorder.status
        line = progress(status, before)
        typer.echo(f"\r\x1b[K{line}" if live else line, nl=not live)
        before = status
        if status.state.value == "failed":  # the recorder will not recover
            break
    if live:
        typer.echo()


def progress(status: Status, before: Status) -> str:
    """Return the progress as one line; rates are relative to ``before``."""
    span_s = max(1e-3, status.seconds - before.seconds)
    minutes, seconds = divmod(round(status.seconds), 60)
    parts = [
        f"{minutes:d}:{seconds:02d}",
        status.state.value + (f" ({status.reason})" if status.reason else ""),
        f"{status.bytes / 1e6:.1f} MB",
        f"{(status.bytes - before.bytes) / 1e6 / span_s:.2f} MB/s",
        f"{(status.messages - before.messages) / span_s:.0f} messages/s",
        f"dropped {counts(status.dropped)}",
    ]
    return "  ".join(parts)


def counts(by_drone: dict[str, dict[str, int]]) -> str:
    """Return counts as ``alpha feedback 3, alpha video.front 12``, or ``none``."""
    found = [f"{drone} {name} {count}" for drone, channels in by_drone.items() for name, count in channels.items()]
    return ", ".join(found) or "none"


def _conclude(recorder: Recorder) -> None:
    status = recorder.status
    files = ", ".join(status.files)
    typer.echo(
        f"{files}: {status.seconds:.0f} s, {status.bytes / 1e6:.1f} MB, {status.messages} messages, "
        f"dropped {counts(status.dropped)}, missed {counts(status.missed)}"
    )
    if status.state.value == "failed":
        raise SkyloopError(f"the recording is incomplete: {status.reason}")


def view(
    names: NamesArgument = None,
    drone: DronesOption = None,
    foxglove: Annotated[bool, typer.Option("--foxglove", help="Serve Foxglove, on this machine only")] = False,
    rerun: Annotated[bool, typer.Option("--rerun", help="Start Rerun's viewer and show them in it")] = False,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Address; beyond loopback, anyone who can reach it sees the drones")
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(metavar="PORT", min=0, max=65535, help="Port of Foxglove [8765] or Rerun [9876]; 0: any free one"),
    ] = None,
    write: Annotated[
        bool, typer.Option("--write", help="Let Foxglove write parameters, under a lease held for that moment")
    ] = False,
    priority: Annotated[
        int, typer.Option(metavar="P", min=0, max=31, help="Priority for writing: 0 is the highest, 31 the lowest")
    ] = 31,
    connect: Annotated[
        str | None, typer.Option(metavar="URL", help="Running Rerun viewer: rerun+http://HOST:PORT/proxy")
    ] = None,
    save: Annotated[
        Path | None, typer.Option(metavar="FILE", help="With --rerun: save to this .rrd file instead of a viewer")
    ] = None,
    seconds: Annotated[float | None, typer.Option(metavar="S", min=0.0, help="Duration [until Ctrl-C]")] = None,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Show drones live in Foxglove or Rerun until Ctrl-C is pressed. This only observes: others may fly meanwhile.

    Connect Foxglove to the printed address. A slow or stalled viewer does not slow down anything else.
    """
    _refuse(foxglove, rerun, write, connect, save, port)
    join_network(network, keys)
    chosen = drones(names, drone)
    interrupt_by_signals((signal.SIGTERM,))
    with ExitStack() as stack, suppress(KeyboardInterrupt):  # this is the normal way to stop
        from skyloop.client import connect as connect_to
        from skyloop.recording.taps import View, give_way

        give_way()
        known = [stack.enter_context(connect_to(name, access="observe", name="skyloop view")) for name in chosen]
        screen: Screen
        if foxglove:
            screen = _foxglove(known, host, port, priority if write else None)
        else:
            screen = _rerun(known, host, port, connect, save)
        _watch(stack.enter_context(View(known, screen)), math.inf if seconds is None else seconds)


def _foxglove(known: Sequence[Drone], host: str, port: int | None, priority: int | None) -> Screen:
    from skyloop.address import is_loopback
    from skyloop.recording.foxglove_server import PORT, FoxgloveServer

    server = FoxgloveServer(known, host=host, port=PORT if port is None else port, priority=priority)
    typer.echo(f"In Foxglove: Open connection, Foxglove WebSocket, {server.url}")
    if not is_loopback(host):
        typer.echo(
            f"WARNING: anyone who can reach {host} sees the drones: Foxglove's protocol has no passwords", err=True
        )
    return server


def _rerun(known: Sequence[Drone], host: str, port: int | None, connect: str | None, save: Path | None) -> Screen:
    from skyloop.recording.rerun_viewer import RerunViewer

    viewer = RerunViewer(known, host=host, port=port, connect=connect, save=save)
    typer.echo(f"Rerun: {viewer.target}")
    return viewer


def _refuse(foxglove: bool, rerun: bool, write: bool, connect: str | None, save: Path | None, port: int | None) -> None:
    if foxglove == rerun:
        raise UsageError("give either --foxglove or --rerun")
    if foxglove and (connect is not None or save is not None):
        raise UsageError("--connect and --save are for --rerun: leave them out, or choose --rerun")
    if rerun and write:
        raise UsageError("--write is for --foxglove: Rerun writes no parameters")
    if connect is not None and (save is not None or port is not None):
        raise UsageError("--connect names a running viewer: leave out --save and --port")


def _watch(view: View, seconds: float) -> None:
    """Print the subscriptions whenever they change."""
    end = time.monotonic() + seconds
    before: dict[str, list[str]] = {}
    while (left := end - time.monotonic()) > 0:
        time.sleep(min(_POLL_S, left))
        if (now := view.subscribed) != before:
            before = now
            words = "; ".join(f"{name}: {', '.join(channels)}" for name, channels in now.items())
            typer.echo(words or "no subscribers")
