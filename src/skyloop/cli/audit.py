"""``skyloop audit``: who flew which drone when."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from skyloop.cli.completion import drone_names
from skyloop.cli.naming import DroneOption, one_drone
from skyloop.cli.text import columns
from skyloop.errors import UnknownNameError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from skyloop.proxy.records import Tenure

HEAD = ("DRONE", "WHO", "IDENTITY", "PRIORITY", "FROM", "TO", "TAKE-OFFS", "HOW IT ENDED")


def audit(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="One drone's; else those of all", autocompletion=drone_names)
    ] = None,
    drone: DroneOption = None,
    file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Of a proxy that was started with --audit FILE")
    ] = None,
    last: Annotated[int | None, typer.Option(metavar="N", min=1, help="Only the last N")] = None,
    json: Annotated[bool, typer.Option("--json", help="For programs: one JSON array")] = False,
) -> None:
    """Show who held the authority over a drone, from when to when, and how it ended. The times are local."""
    from skyloop.proxy.records import read, tenures

    name = one_drone(name, drone) if name is not None or drone is not None else None
    entries, bad = [], 0
    for path in _files(name, file):
        found, torn = read(path)
        entries += found
        bad += torn
    entries.sort(key=lambda entry: entry.at)
    if name is not None:
        entries = [entry for entry in entries if entry.proxy == name]
    rows = tenures(entries)
    rows = rows[-last:] if last is not None else rows
    if json:
        typer.echo(msgspec.json.encode(rows).decode())
    elif not rows:
        typer.echo("The audit trail has no flights yet.")
    else:
        for line in lines(rows):
            typer.echo(line)
    if bad:
        typer.echo(f"{bad} {'line' if bad == 1 else 'lines'} can't be understood, and left out.", err=True)


def lines(rows: Sequence[Tenure]) -> list[str]:
    """Return the tenures as a table of text."""
    cells = [HEAD]
    cells += [
        (
            row.proxy,
            row.who,
            row.identity,
            str(row.priority),
            _local(row.begin),
            _local(row.end) if row.end is not None else ("?" if row.how else "now"),
            str(row.takeoffs),
            row.how or "in progress",
        )
        for row in rows
    ]
    return columns(cells)


def _local(at: datetime) -> str:
    return at.astimezone().strftime("%Y-%m-%d %H:%M:%S")


def _files(name: str | None, file: Path | None) -> list[Path]:
    from skyloop.proxy.records import SUFFIX, audit_folder, audit_path

    if file is not None:
        return [file]
    if name is not None and ("/" in name or name.endswith(SUFFIX)):
        raise UsageError(f"{name} is a file, not the name of a proxy: skyloop audit --file {name}")
    folder = audit_folder()
    known = sorted(path.name.removesuffix(SUFFIX) for path in folder.glob("*" + SUFFIX)) if folder.is_dir() else []
    if name is None:
        return [audit_path(each) for each in known]
    if name not in known:
        if not known:
            raise UsageError(f"there is no audit trail in {folder}: no named proxy of this user has run yet")
        raise UnknownNameError("proxy with an audit trail", name, known)
    return [audit_path(name)]
