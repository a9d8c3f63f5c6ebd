"""``skyloop proxy`` serves one vehicle as a node; ``skyloop host`` serves many vehicles from one process."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skyloop.cli import network as net
from skyloop.cli.text import columns, print_json
from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.host.fleet import Fleet
    from skyloop.host.serve import HostAnswer, Request
    from skyloop.host.vehicle import VehicleStatus

FleetArgument = Annotated[Path, typer.Argument(metavar="FILE", help="File of vehicles; see docs/host.md")]
GroupOption = Annotated[str | None, typer.Option(metavar="GROUP", help="Group of users whose members may also do this")]
HostOption = Annotated[
    str | None, typer.Option("--host", metavar="NAME", help="Name of the host, if several run [the one that runs]")
]
NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Vehicle, as shown by skyloop host status")]


def proxy(
    uri: Annotated[str, typer.Argument(metavar="URI", help="Vehicle, e.g. sim:// or video://flight.mp4")],
    name: Annotated[str, typer.Option(metavar="NAME", help="Name that applications connect to")] = "alpha",
    group: Annotated[
        str | None, typer.Option(metavar="GROUP", help="Group of users whose members may also connect")
    ] = None,
    network: net.ServeOption = None,
    listen: net.ListenOption = None,
    connect: net.ConnectOption = None,
    multicast: net.MulticastOption = True,
    keys: net.KeysOption = None,
    audit: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File for the audit trail of flights [in the user's state directory]"),
    ] = None,
    metrics: net.MetricsOption = None,
    parent_fd: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Serve one vehicle to applications until Ctrl-C is pressed, and land it before exiting.

    Serves applications on this host and, with --network, on other hosts too.
    """
    from skyloop.child_process import handed_over
    from skyloop.drivers.uri import parse_uri
    from skyloop.proxy.serve import serve

    settings = net.settings_of(network, listen, connect, multicast, keys)
    vehicle = parse_uri((handed_over() if parent_fd is not None else None) or uri)
    if vehicle.scheme == "sim":
        from skyloop.vehicles.sim.options import options_of

        net.settle(options_of(vehicle))
    net.warn_if_open(settings, [name])
    serve(
        vehicle,
        name,
        make_end=net.server_ends(settings, group),
        parent_fd=parent_fd,
        poll=net.key_changes(settings),
        audit=audit,
        beside=net.metrics_beside(metrics),
    )


def host(fleet: FleetArgument, group: GroupOption = None, metrics: net.MetricsOption = None) -> None:
    """Serve all vehicles listed in a file from one process until Ctrl-C is pressed, and land them before exiting.

    skyloop host status, add and remove show and change its vehicles while it is running; each has its own --help.
    """
    from skyloop.host.fleet import read_fleet
    from skyloop.host.serve import serve

    found = read_fleet(fleet)
    _prepare(found)
    serve(found, group=group, metrics=metrics)


def status(
    json: Annotated[bool, typer.Option("--json", help="Print one JSON array")] = False,
    host: HostOption = None,
    group: GroupOption = None,
) -> None:
    """Show the vehicles of a running host: their states, their pilots, and the reason for any failure."""
    from skyloop.host.serve import StatusRequest

    rows = _ask(StatusRequest(), host, group).vehicles
    if json:
        print_json(rows)
        return
    typer.echo("\n".join(lines(rows)))


def add(
    what: Annotated[str, typer.Argument(metavar="NAME|FILE", help="Name of a vehicle, or file of several")],
    address: Annotated[
        str | None,
        typer.Argument(metavar="[ADDRESS]", help="Its address [from the host's own file]", show_default=False),
    ] = None,
    own_process: Annotated[
        bool | None,
        typer.Option("--own-process/--shared", help="Whether its proxy gets its own process [as in the host's file]"),
    ] = None,
    host: HostOption = None,
    group: GroupOption = None,
) -> None:
    """Add vehicles to a running host: one by its address, all vehicles in a file, or one from the host's own file.

    A vehicle given by address uses the defaults of the host's file. Vehicles that are already running are not affected.
    """
    from skyloop.host.fleet import read_fleet
    from skyloop.host.serve import Add, AddNamed

    if address is None and (what.endswith(".toml") or "/" in what):
        if own_process is not None:
            raise UsageError('--own-process is for one vehicle: write process = "own" in the file')
        answer = _ask(Add(read_fleet(Path(what)).vehicles), host, group)
    else:
        answer = _ask(AddNamed(what, address, own_process), host, group)
    typer.echo("\n".join(lines(answer.vehicles)))
    for name, why in answer.problems.items():
        typer.echo(f"skyloop: {name} was not added: {why}", err=True)
    if answer.problems:
        raise typer.Exit(1)


def remove(
    name: NameArgument,
    land: Annotated[bool, typer.Option("--land", help="Land it even if another application has the authority")] = False,
    host: HostOption = None,
    group: GroupOption = None,
) -> None:
    """Land a vehicle of a running host and stop serving it.

    The request is refused while the vehicle flies under an application's authority, unless --land is given.
    """
    from skyloop.host.serve import Remove

    answer = _ask(Remove(name, land), host, group)
    typer.echo(f"removed {name}: {answer.vehicles[0].address}")


def lines(rows: tuple[VehicleStatus, ...]) -> list[str]:
    """Return the rows as a text table. The reason comes last because it may be long."""
    if not rows:
        return ["This host has no vehicle. Add one: skyloop host add NAME ADDRESS"]
    cells = [("NAME", "ADDRESS", "PROXY", "PROCESS", "STATE", "LINK", "BATTERY", "PILOT", "UP", "WHY")]
    cells += [
        (
            row.name,
            row.address,
            row.condition.value,
            f"own, {row.pid}" if row.pid is not None else row.process,
            row.state or "-",
            row.link or "-",
            "-" if row.battery is None else f"{row.battery:.0%}",
            row.pilot or "-",
            _duration(row.uptime_s),
            "; ".join(filter(None, (row.failed, row.link_reason, row.link_remedy, _restarts(row)))),
        )
        for row in rows
    ]
    return columns(cells)


def _restarts(row: VehicleStatus) -> str:
    return f"restarted {row.restarts} {'time' if row.restarts == 1 else 'times'}" if row.restarts else ""


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _ask(request: Request, host: str | None, group: str | None) -> HostAnswer:
    from skyloop.host.serve import ask, chosen_host

    return ask(chosen_host(host, group), request, group=group)


def _prepare(fleet: Fleet) -> None:
    """Warn about an open network, and prepare this process for the threads of simulators."""
    from skyloop.host.vehicle import network_of
    from skyloop.vehicles.sim.options import options_of

    opened = [vehicle.name for vehicle in fleet.vehicles if (joined := network_of(vehicle)) and joined.tls is None]
    for vehicle in fleet.vehicles:
        if opened[:1] == [vehicle.name]:
            net.warn_if_open(network_of(vehicle), opened)
        uri = vehicle.address
        if uri.scheme == "sim" and not vehicle.own_process:
            net.settle(options_of(uri))
