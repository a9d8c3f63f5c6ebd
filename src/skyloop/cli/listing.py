"""``skyloop list``: shows proxies on this host and the network, with their pilots; ``skyloop audit``: who flew when."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Unpack

import msgspec
import typer

from skyloop.cli.naming import DroneOption, KeysOption, NetworkOption, drone_names, join_network, one_drone
from skyloop.cli.text import columns, print_json
from skyloop.errors import AuthorityError, SkyloopError, UnknownNameError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from skyloop.client import Drone
    from skyloop.client.connect import ConnectOptions
    from skyloop.messages import Feedback, VehicleOverview
    from skyloop.network import FabricSettings
    from skyloop.proxy.records import Tenure

ANSWER_WITHIN_S = 1.0  #: time limit for each proxy; a suspended one does not answer
HEAD = ("DRONE", "WHO", "IDENTITY", "PRIORITY", "FROM", "TO", "TAKE-OFFS", "HOW IT ENDED")


class Row(msgspec.Struct, frozen=True):
    """A proxy as a row in the output of ``skyloop list``."""

    name: str
    transport: str = "local"  #: ``local``, ``fabric`` (the network) or both
    pid: int | None = None
    host: str = ""
    vehicle: str = ""
    uri: str = ""
    state: str = ""
    battery: float | None = None
    owner: str | None = None
    vehicle_link: str = ""
    problem: str = ""
    link_reason: str = ""  #: reason why the vehicle's link is not up
    link_remedy: str = ""  #: advice on how to fix the link


def list_proxies(
    json: Annotated[bool, typer.Option("--json", help="Print one JSON array")] = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Show the running proxies, their hosts, vehicles and states, and who holds authority.

    Lists this host's proxies and, with --network, those that can be reached over the network.
    """
    from skyloop.network.config import choose

    join_network(network, keys)
    settings = choose()
    rows = running(settings)
    if json:
        print_json(rows)
    elif not rows:
        typer.echo(none_runs(settings))
    else:
        typer.echo("\n".join(lines(rows)))
        if others := of_others():
            typer.echo(others, err=True)


def none_runs(settings: FabricSettings | None) -> str:
    """Return a message that no proxy was found here or on the network. It names other users whose proxies run here."""
    also = "" if settings is None else f" or can be reached over the network ({settings.reach})"
    others = of_others()
    ours = f"No proxy of yours is running on this host{also}" if others else f"No proxy is running on this host{also}"
    return f"{ours}. {f'{others} ' if others else ''}Start one: skyloop proxy sim:// --name alpha"


def of_others() -> str:
    """Return a sentence about the proxies that other users run on this host; empty if there are none."""
    from skyloop.transport.local import names_of_others

    theirs = [f"{user} runs {', '.join(sorted(names))}" for user, names in sorted(names_of_others().items())]
    if not theirs:
        return ""
    return f"{'; '.join(theirs)}: a user's proxies are closed to others, except to a group (SKYLOOP_GROUP)."


def running(settings: FabricSettings | None = None) -> list[Row]:
    """Return all proxies on this host and, with settings, on the network, by name.

    They are queried in parallel, so suspended proxies delay the list only once.
    """
    from skyloop.transport.local import list_names

    here = platform.node()
    found = [Row(proxy.name, pid=proxy.pid, host=here) for proxy in list_names()]
    if settings is not None:
        found = merged(found, settings)
    if not found:
        return []
    processes = of_one_process(found)
    with ThreadPoolExecutor(max_workers=min(32, len(processes))) as pool:
        described_rows = [row for rows in pool.map(lambda rows: reported(rows, settings), processes) for row in rows]
    return sorted(described_rows, key=lambda row: (row.name, row.host))


def of_one_process(rows: Iterable[Row]) -> list[list[Row]]:
    """Group the rows by process, because each process describes all of its vehicles in one overview."""
    found: dict[tuple[object, ...], list[Row]] = {}
    for row in rows:
        found.setdefault((row.host, row.pid) if row.pid else (row.host, row.name), []).append(row)
    return list(found.values())


def reported(rows: list[Row], settings: FabricSettings | None) -> list[Row]:
    """Return the reports of a process's proxies; query several of them over one connection if possible."""
    overview: dict[str, VehicleOverview] = {}
    if len(rows) > 1:
        try:
            with observed(rows[0], settings) as drone:
                overview = {vehicle.name: vehicle for vehicle in drone.overview().vehicles}
        except SkyloopError:
            pass  # each proxy is then queried separately
    return [
        with_state(row, seen.vehicle, seen.uri, seen) if (seen := overview.get(row.name)) else described(row, settings)
        for row in rows
    ]


def with_state(row: Row, vehicle: str, uri: str, seen: Feedback | VehicleOverview) -> Row:
    """Return the row, completed with the proxy's report on the vehicle."""
    return msgspec.structs.replace(
        row,
        vehicle=vehicle,
        uri=uri,
        state=seen.state.value,
        battery=seen.battery,
        owner=seen.owner,
        vehicle_link=seen.vehicle_link.value,
        link_reason=seen.link_reason,
        link_remedy=seen.link_remedy,
    )


def merged(near: list[Row], settings: FabricSettings) -> list[Row]:
    """Merge these proxies with those on the network. A proxy that can be reached both ways gets one row."""
    from skyloop.network import list_proxies as far

    rows = {(row.host, row.pid, row.name): row for row in near}
    for proxy in far(settings):
        key = (proxy.host, proxy.pid, proxy.name)
        way = "local, fabric" if key in rows else "fabric"
        rows[key] = Row(proxy.name, way, proxy.pid, proxy.host, uri=proxy.vehicle)
    return sorted(rows.values(), key=lambda row: (row.name, row.host))


def describe(name: str) -> Row:
    """Return the report of the proxy with this name, on this host or the network."""
    from skyloop.network.config import choose

    return described(Row(name, transport=""), choose())


def described(row: Row, settings: FabricSettings | None) -> Row:
    """Return a proxy's description of itself, or the reason why it does not answer."""
    try:
        with observed(row, settings) as drone:
            return with_state(row, drone.capabilities.vehicle, drone.uri, drone.feedback())
    except SkyloopError as error:
        return msgspec.structs.replace(row, problem=str(error))


def observed(row: Row, settings: FabricSettings | None, name: str = "skyloop list") -> Drone:
    """Connect to a proxy as an observer with the given name, over the transport listed in the proxy's row."""
    from skyloop.client import connect

    far = "local" not in row.transport
    return connect(
        row.name, access="observe", name=name, timeout_s=ANSWER_WITHIN_S, network=(settings or False) if far else False
    )


def lines(rows: Iterable[Row]) -> list[str]:
    """Return the rows as a text table. The address comes last because it may be long."""
    cells = [("NAME", "HOST", "BY", "STATE", "BATTERY", "PILOT", "LINK", "ADDRESS")]
    cells += [
        (
            row.name,
            row.host,
            row.transport,
            row.state or "?",
            "" if row.battery is None else f"{row.battery:.0%}",
            row.owner or ("?" if row.problem else "nobody"),
            row.vehicle_link or "?",
            row.problem or ": ".join(filter(None, (row.uri, row.link_reason, row.link_remedy))),
        )
        for row in rows
    ]
    return columns(cells)


def audit(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Only this drone [all]", autocompletion=drone_names)
    ] = None,
    drone: DroneOption = None,
    file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Audit file of a proxy started with --audit FILE")
    ] = None,
    last: Annotated[int | None, typer.Option(metavar="N", min=1, help="Only the last N")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON array")] = False,
) -> None:
    """Show who held authority over a drone, from when to when, and how it ended. Times are in local time."""
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
        print_json(rows)
    elif not rows:
        typer.echo("The audit trail has no flights yet.")
    else:
        typer.echo("\n".join(flight_lines(rows)))
    if bad:
        typer.echo(f"Skipped {bad} {'line' if bad == 1 else 'lines'} that can't be parsed.", err=True)


def flight_lines(rows: Sequence[Tenure]) -> list[str]:
    """Return the periods of authority as a text table."""
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


def connect_pilot(target: str, advice: str, **options: Unpack[ConnectOptions]) -> Drone:
    """Connect like :func:`skyloop.connect`. If another client is flying, the error names it and gives advice."""
    from skyloop.client import connect

    try:
        return connect(target, **options)
    except AuthorityError as error:
        if error.code != "busy":
            raise
        holder = describe(target).owner or "another application"
        raise AuthorityError(f"{holder} holds the authority over {target}: {advice}", code=error.code) from error
