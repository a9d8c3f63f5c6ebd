"""``skyloop record``: everything that drones send, into a file."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NoReturn, cast

import typer

from skyloop.cli.naming import DronesOption, KeysOption, NamesArgument, NetworkOption, drones, join_network
from skyloop.errors import SkyloopError

if TYPE_CHECKING:
    from skyloop.recording import Recorder, Status
    from skyloop.recording.options import VideoEncoding

REFRESH_S: Final = 0.25  # on a terminal
LINE_EVERY_S: Final = 1.0  # in a pipe


def record(
    names: NamesArgument = None,
    drone: DronesOption = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="PATH", help="A file, or a folder to choose a name in")
    ] = Path(),
    channels: Annotated[
        str | None,
        typer.Option(
            metavar="LIST", help="Only these, with commas: commands, feedback, events, video, video.front, logs …"
        ),
    ] = None,
    encoding: Annotated[
        str,
        typer.Option(
            metavar="auto|jpeg|png", help="Of frames; auto keeps H.264 as it came, else jpeg; png is without any loss"
        ),
    ] = "auto",
    quality: Annotated[int, typer.Option(min=1, max=100, help="Of JPEG")] = 90,
    rotate_mb: Annotated[float | None, typer.Option(metavar="MB", min=1.0, help="A new file after so much")] = None,
    rotate_s: Annotated[float | None, typer.Option(metavar="S", min=1.0, help="A new file after so long")] = None,
    min_free_mb: Annotated[float, typer.Option(metavar="MB", min=0.0, help="Room to leave on the disk")] = 256.0,
    buffer_mb: Annotated[float, typer.Option(metavar="MB", min=1.0, help="What may wait for a slow disk")] = 64.0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Write over an existing file")] = False,
    seconds: Annotated[float | None, typer.Option(metavar="S", min=0.0, help="How long; else until Ctrl-C")] = None,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Record drones to an MCAP file until Ctrl-C. It only looks on: any application may fly meanwhile.

    Where the output is no terminal: one line a second.
    """
    from skyloop.recording import record as start

    join_network(network, keys)
    recorder = start(
        drones(names, drone),
        output,
        channels=None if channels is None else [name.strip() for name in channels.split(",")],
        encoding=cast("VideoEncoding", encoding),  # which is checked there
        quality=quality,
        rotate_mb=rotate_mb,
        rotate_s=rotate_s,
        min_free_mb=min_free_mb,
        buffer_mb=buffer_mb,
        overwrite=overwrite,
        in_process=True,
    )
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _interrupt)
    with recorder, suppress(KeyboardInterrupt):  # how it is meant to end
        _show(recorder, math.inf if seconds is None else seconds)
    _conclude(recorder)


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


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
        if status.state.value == "failed":  # it does not come back
            break
    if live:
        typer.echo()


def progress(status: Status, before: Status) -> str:
    """Return the progress in one line; rates are since ``before``."""
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
        raise SkyloopError(f"the recording is not complete: {status.reason}")
