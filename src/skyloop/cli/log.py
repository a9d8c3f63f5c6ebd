"""``skyloop log``: inspects, exports, compares and repairs recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import typer
from rich.table import Table
from rich.text import Text

from skyloop.cli.naming import recordings
from skyloop.cli.text import console, named, print_json, progress_bar, tell
from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, UsageError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from skyloop.recording.layout import Channel
    from skyloop.recording.listing import Described
    from skyloop.recording.reader import Recording
    from skyloop.recording.review.compare import Comparison
    from skyloop.recording.review.summary import Delay, Row, Summary
    from skyloop.recording.review.video import Videos

log = typer.Typer(no_args_is_help=True, rich_markup_mode=None)

File = Annotated[
    Path, typer.Argument(metavar="FILE", help="Recording: an MCAP file written by Skyloop", autocompletion=recordings)
]
DroneName = Annotated[str | None, typer.Option("--drone", metavar="NAME", help="Recorded drone [the first]")]
_EXAMPLE: Final = "Example: skyloop log "


class ExportFormat(StrEnum):
    """The formats to which recordings can be exported."""

    CSV = "csv"
    PARQUET = "parquet"
    NPZ = "npz"
    MP4 = "mp4"
    LEROBOT = "lerobot"
    RRD = "rrd"


class Which(StrEnum):
    """Whether to compare commands before or after the proxy has limited them."""

    ASKED = "asked"
    APPLIED = "applied"


@log.callback()
def _log() -> None:
    """Inspect recordings: contents, reports, exports and comparisons; and repair them.

    skyloop log COMMAND --help describes each command.
    """


@log.command(short_help="Show a recording's contents", epilog=f"{_EXAMPLE}info flight.mcap")
def info(file: File, json: Annotated[bool, typer.Option("--json", help="Print one JSON object")] = False) -> None:
    """Show channels with counts, rates, gaps, missing samples and delays; also drops, and problems with the file."""
    from skyloop.recording.review.summary import summarise

    recording = _open(file)
    with progress_bar("reading") as progress:
        summary = summarise(recording, progress)
    if json:
        started_ns = recording.start.started_unix_ns
        head = {"file": recording.path, "drones": recording.drones, "started_unix_ns": started_ns}
        print_json(head | {"summary": summary})
        return
    screen = console()
    for part in info_parts(recording, summary):
        screen.print(part)


@log.command("list", short_help="List the recordings in a folder", epilog=f"{_EXAMPLE}list flights")
def list_recordings(
    folder: Annotated[Path, typer.Argument(metavar="[FOLDER]", help="Folder of recordings")] = Path(),
    json: Annotated[bool, typer.Option("--json", help="Print one JSON array")] = False,
) -> None:
    """List the recordings in a folder: drones, start and duration. Problems with a file are shown in its row."""
    from skyloop.recording.listing import ENDING, describe, shown_name

    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix == ENDING)
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}") from None
    rows = [(path, describe(path)) for path in paths]
    if json:
        found = [{"name": shown_name(path), **msgspec.structs.asdict(summary)} for path, summary in rows]
        print_json(found)
    elif rows:
        console().print(_listing(rows))
    else:
        typer.echo(f"No recordings in {folder}. Make one: skyloop record alpha")


@log.command(short_help="Create a page that shows a flight", epilog=f"{_EXAMPLE}report flight.mcap -o report.html")
def report(
    file: File,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="PAGE", help="[default: FILE with the suffix .html]")
    ] = None,
    drone: DroneName = None,
    pictures: Annotated[int, typer.Option(min=0, max=48, help="Number of key frames of each camera")] = 8,
) -> None:
    """Write one self-contained HTML page: path, attitude with set-points, battery, events, delays and key frames."""
    from skyloop.recording.review.report import write_report

    recording = _open(file)
    target = output or file.with_suffix(".html")
    with progress_bar("drawing") as progress:
        write_report(recording, recording.drone(drone).name, target, pictures=pictures, progress=progress)
    tell(f"{target}: {target.stat().st_size / 1e6:.1f} MB")


@log.command(short_help="Export samples and frames for other programs", epilog=f"{_EXAMPLE}export flight.mcap --to csv")
def export(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Recording; several for lerobot", autocompletion=recordings)
    ],
    to: Annotated[ExportFormat, typer.Option("--to", help="csv and parquet: one file per channel")] = ExportFormat.CSV,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="PATH", help="Folder for csv, parquet and lerobot, otherwise a file"),
    ] = None,
    drone: DroneName = None,
    channel: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this channel, e.g. feedback; repeatable")
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="For mp4 [default: the first]; for lerobot, repeatable [default: all]"),
    ] = None,
    burn_time: Annotated[bool, typer.Option("--burn-time", help="For mp4: write the time into the frames")] = False,
    encode: Annotated[
        bool, typer.Option("--encode", help="For mp4: re-encode H.264, otherwise copied as recorded")
    ] = False,
    fps: Annotated[float | None, typer.Option(help="For lerobot: rows per second [default: 10]")] = None,
    task: Annotated[str | None, typer.Option(help="For lerobot: description of the task")] = None,
) -> None:
    """Write the samples as tables, a camera's frames as a video, flights as training data, or all of it for Rerun.

    H.264 is copied as recorded, which takes only seconds, unless the time is drawn on the frames. For lerobot, flights
    become episodes of a LeRobotDataset: pictures, the state at the capture of each picture, and the commands. rrd is a
    file for Rerun's viewer that contains all drones. Foxglove and Lichtblick can open the recording directly.
    """
    from skyloop.recording.review import tables as ways
    from skyloop.recording.review.video import export_mp4

    if to is ExportFormat.LEROBOT:
        _refuse({"--channel": bool(channel), "--burn-time": burn_time, "--encode": encode}, to)
        _export_lerobot(files, output, drone, camera, fps, task)
        return
    _refuse({"--fps": fps is not None, "--task": task is not None}, to)
    if to is ExportFormat.RRD:
        _refuse(
            {"--channel": bool(channel), "--camera": bool(camera), "--burn-time": burn_time, "--encode": encode}, to
        )
    if len(files) > 1:
        raise UsageError(f"{len(files)} recordings given: {to.value} takes one at a time")
    (file,) = files
    recording = _open(file)
    if to is ExportFormat.RRD:
        _export_rrd(recording, _file(output, f"{file.stem}.rrd", file), drone)
        return
    name = recording.drone(drone).name
    if to is ExportFormat.MP4:
        _refuse({"--channel": bool(channel)}, to)
        if camera and len(camera) > 1:
            raise UsageError(f"{len(camera)} cameras given: mp4 takes one at a time")
        chosen = camera[0] if camera else _first_camera(recording, name)
        target = _file(output, f"{file.stem}-{chosen}.mp4", file)
        with progress_bar(f"exporting {chosen}") as progress:
            found = export_mp4(recording, name, chosen, target, burn_time=burn_time, encode=encode, progress=progress)
        for line in _exported(found, chosen):
            tell(line)
        return
    _refuse({"--camera": bool(camera), "--burn-time": burn_time, "--encode": encode}, to)
    with progress_bar("reading") as progress:
        tables = ways.read(recording, name, _channels(channel), progress)
    if to is ExportFormat.NPZ:
        written = ways.export_npz(tables, output or file.with_suffix(".npz"))
    else:
        write = ways.export_csv if to is ExportFormat.CSV else ways.export_parquet
        written = write(tables, output or file.with_name(f"{file.stem}-{to.value}"))
    rows = ", ".join(f"{len(table)} × {title}" for title, table in tables.items())
    tell(f"{written[0] if len(written) == 1 else written[0].parent}: {rows}")


@log.command(
    short_help="Compare the commands of two recordings", epilog=f"{_EXAMPLE}compare old.mcap new.mcap -o both.html"
)
def compare(
    old: Annotated[Path, typer.Argument(metavar="OLD", help="A recording", autocompletion=recordings)],
    new: Annotated[
        Path,
        typer.Argument(metavar="NEW", help="Another, such as that of a replay of the first", autocompletion=recordings),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="PAGE", help="Plot them in a .html page or .png image")
    ] = None,
    drone: DroneName = None,
    what: Annotated[Which, typer.Option(help="Commands as requested, or as applied")] = Which.ASKED,
    part: Annotated[float, typer.Option(min=0.0, help="Difference that counts as diverging [SI unit]")] = 0.01,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object")] = False,
) -> None:
    """Compare the commands of an old and a changed controller: RMS of each set-point, and where the two diverge."""
    from skyloop.recording.review.compare import compare as commands_of

    if output is not None and output.suffix not in (".html", ".png"):
        raise UsageError(f"can't draw {output}: its name must end in .html or .png")
    older, newer = _open(old), _open(new)
    found = commands_of(older, newer, drone=drone, what=what.value, part=part)
    if json:
        names = ("aligned", "seconds", "same_action", "fields", "part_at_s", "counts")
        print_json({name: getattr(found, name) for name in names})
    else:
        screen = console()
        for part_ in _comparison(found, str(old), str(new)):
            screen.print(part_)
    if output is not None:
        from skyloop.recording.review.compare import write_comparison

        write_comparison(found, str(old), str(new), output)
        tell(f"{output}: {output.stat().st_size / 1e3:.0f} kB")


@log.command(short_help="Repair a recording that was cut off", epilog=f"{_EXAMPLE}recover flight.mcap")
def recover(
    file: File,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="NEW", help="[default: FILE-recovered.mcap next to it]")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object")] = False,
) -> None:
    """Write the readable part of a damaged recording to a new file with an index. The original file is kept."""
    from skyloop.recording.review import summary as mending

    recording = _open(file)
    with progress_bar("checking") as progress:
        wrong = mending.problems(recording, progress)
    if not wrong and output is None:
        tell(f"{file} is complete: there is nothing to repair")
        if json:
            print_json({"file": file, "saved": None})
        return
    target = output or file.with_name(f"{file.stem}-recovered.mcap")
    with progress_bar("repairing") as progress:
        saved = mending.recover(recording, target, progress)
    if json:
        print_json({"file": file, "saved": saved})
        return
    for problem in saved.why:
        tell(f"{file}: {problem}")
    for topic, count in sorted(saved.messages.items()):
        typer.echo(f"{count:8} {topic}")
    lost = f"; at most {saved.lost} bytes are lost" if saved.lost else ""
    tell(f"{target}: {sum(saved.messages.values())} messages, {saved.seconds:.1f} s saved{lost}")


def _export_lerobot(
    files: list[Path],
    output: Path | None,
    drone: str | None,
    cameras: list[str] | None,
    fps: float | None,
    task: str | None,
) -> None:
    from skyloop.recording.review.lerobot import export_lerobot

    recordings = [_open(file) for file in files]
    target = output or files[0].with_name(f"{files[0].stem}-lerobot")
    with progress_bar("exporting") as progress:
        found = export_lerobot(
            recordings,
            target,
            drone=drone,
            cameras=cameras,
            fps=10.0 if fps is None else fps,
            task=task or "",
            doing=lambda _, share: progress(share),
        )
    repeated = f"; {found.repeated} damaged pictures were replaced by the ones before" if found.repeated else ""
    tell(
        f"{target}: {found.episodes} episodes, {found.rows} rows: {', '.join(found.form.state)}; "
        f"{', '.join(found.form.cameras) or 'no camera'}; action: {', '.join(found.form.action)}{repeated}"
    )


def _export_rrd(recording: Recording, target: Path, drone: str | None) -> None:
    from skyloop.recording.rerun_viewer import export_rrd

    with progress_bar("exporting") as progress:
        found = export_rrd(recording, target, drone=drone, progress=progress)
    lost = f"; {found.left_out} pictures that can't be decoded were skipped" if found.left_out else ""
    tell(f"{target}: {', '.join(found.drones)}: {found.samples} samples, {found.pictures} pictures{lost}")


# Inside --------------------------------------------------------------------------------------------------------


def _open(file: Path) -> Recording:
    from skyloop.recording.reader import Recording

    return Recording.open(file)


def _file(output: Path | None, name: str, beside: Path) -> Path:
    """Return the path of the file to write: inside the folder if a folder is given, otherwise with the right suffix."""
    if output is None:
        return beside.with_name(name)
    return output / name if output.is_dir() else output.with_suffix(output.suffix or Path(name).suffix)


def _first_camera(recording: Recording, drone: str) -> str:
    cameras = recording.cameras(drone)
    if not cameras:
        raise FileFormatError(f"{recording.path} holds no frames of {drone}")
    return cameras[0]


def _channels(names: list[str] | None) -> list[Channel] | None:
    from skyloop.errors import UnknownNameError
    from skyloop.recording.layout import Channel

    known = {channel.value for channel in Channel}
    for name in names or ():
        if name not in known:
            raise UnknownNameError("channel", name, known)
    return [Channel(name) for name in names] if names else None


def _refuse(given: dict[str, bool], to: ExportFormat) -> None:
    for option, is_given in given.items():
        if is_given:
            raise UsageError(f"{option} has no effect on {to.value}: leave it out, or choose another --to")


# As text for terminals ------------------------------------------------------------------------------------------


def info_parts(recording: Recording, summary: Summary) -> Iterator[RenderableType]:
    """Yield the lines printed by ``skyloop log info``."""
    yield _head(recording, summary)
    yield _channel_table(summary)
    for words in _losses(summary):
        yield Text(words, "yellow")
    for note in summary.notes:
        yield Text(note, "bold yellow")


def _listing(rows: Sequence[tuple[Path, Described]]) -> Table:
    from skyloop.recording.listing import shown_name

    table = Table(box=None)
    for title in ("recording", "begun", "lasts", "drones", "problem"):
        table.add_column(title, overflow="fold")
    for path, summary in rows:
        table.add_row(
            Text(shown_name(path)),
            "" if summary.started is None else time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(summary.started)),
            "" if summary.seconds is None else f"{summary.seconds:.1f} s",
            Text(", ".join(summary.drones)),
            Text(summary.problem),
        )
    return table


def _head(recording: Recording, summary: Summary) -> Table:
    table = Table.grid(padding=(0, 2))
    start = recording.start
    began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(start.started_unix_ns / NS_PER_S))
    size = recording.found.size / 1e6
    table.add_row("file", Text(f"{recording.path}" + (f", number {start.file}" if start.file > 1 else ""), "bold"))
    table.add_row("recorded", f"{began}, {summary.seconds:.1f} s, {size:.1f} MB, by Skyloop {start.skyloop}")
    for drone in recording.drones:
        what = drone.described
        cameras = ", ".join(f"{one.name} {one.width}×{one.height}" for one in what.cameras) or "none"
        table.add_row("drone", f"{drone.name}: {what.vehicle}, {drone.uri or 'no address'}; cameras: {cameras}")
    events = ", ".join(f"{count} {severity}" for severity, count in sorted(summary.events.items()))
    table.add_row("events", events or "none")
    return table


def _channel_table(summary: Summary) -> Table:
    table = Table(box=None)
    table.add_column("topic", overflow="fold")  # never truncated, because it identifies the rows
    for title in ("count", "rate", "gaps", "longest", "missing", "size"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("delay [ms]: median (p99)")
    for row in summary.rows:
        table.add_row(
            row.topic,
            str(row.count),
            _rate(row),
            str(row.gaps) if row.gaps else "",
            f"{row.longest_s:.3g} s" if row.steady and row.longest_s is not None else "",
            str(row.missing) if row.missing else "",
            _size(row.bytes),
            "\n".join(map(_delay, row.delays)),
        )
    return table


def _rate(row: Row) -> str:
    return f"{row.rate_hz:.3g} Hz" if row.steady and row.rate_hz is not None else ""


def _size(number: int) -> str:
    return f"{number / 1e6:.1f} MB" if number >= 1e5 else f"{number / 1e3:.1f} kB"


def _delay(delay: Delay) -> str:
    return f"{delay.median_s * 1e3:.2f} ({delay.p99_s * 1e3:.2f}) {delay.what}"


def _losses(summary: Summary) -> Iterator[str]:
    for what, counts in (("left out by the recorder", summary.dropped), ("never reached the recorder", summary.missed)):
        for drone, channels in counts.items():
            words = ", ".join(f"{count} of {channel}" for channel, count in channels.items() if count)
            if words:
                yield f"{drone}: {words} {what}"


def _exported(found: Videos, camera: str) -> Iterator[str]:
    """Yield a line for each exported video, and a line about missing frames."""
    for video in found.videos:
        since = f", from {video.begin_s:.3f} s on" if video is not found.videos[0] else ""
        how = "as it was recorded" if video.copied else "encoded"
        yield f"{video.path}: {video.frames} frames of {camera}{since}, {video.width}×{video.height}, {how}"
    if found.left_out:
        why = "of another size" if not found.videos[0].copied else "without the frames they depend on"
        yield f"{found.left_out} frames were skipped: damaged, or {why}"


def _comparison(found: Comparison, old: str, new: str) -> list[str | Table]:
    parts = "they never diverge" if found.part_at_s is None else f"they diverge at {found.part_at_s:.2f} s"
    table = Table(named("set-point"), "RMS", "largest", "at", "compared", box=None)
    for field in found.fields:
        table.add_row(
            field.name,
            f"{field.rms:.4f} {field.unit}",
            f"{field.largest:.4f} {field.unit}",
            f"{field.largest_at_s:.2f} s",
            f"{field.seconds:.1f} s",
        )
    return [
        f"{new} against {old}",
        table if found.fields else "no set-point occurs in both at the same time",
        f"{found.seconds:.1f} s compared, {found.aligned}; {found.counts[0]} and {found.counts[1]} commands; "
        f"the same kind of action {found.same_action:.1%} of the time; {parts}",
    ]
