"""The network: options shared by commands that serve vehicles; the commands ``skyloop router`` and ``skyloop keys``.

``skyloop keys`` determines who may join a lab's network, and with which permissions.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from skyloop.cli.naming import MULTICAST, keys_directory, network_places
from skyloop.cli.text import columns, print_json, tell
from skyloop.clock import SWITCH_INTERVAL_S
from skyloop.errors import UsageError
from skyloop.files import expand

if TYPE_CHECKING:
    from skyloop.network import FabricSettings
    from skyloop.network.keys import Entry
    from skyloop.proxy.serve import Beside
    from skyloop.sim.options import SimOptions
    from skyloop.transport.base import TransportServer

MetricsOption = Annotated[
    str | None,
    typer.Option(
        "--metrics",
        metavar="[HOST:]PORT",
        help="Serve metrics for Prometheus there; without HOST on loopback, with port 0 on a free port",
    ),
]
ServeOption = Annotated[
    str | None,
    typer.Option(
        "--network",
        metavar="WHERE",
        help="Also serve there: multicast, or comma-separated routers [default: only this host]",
        autocompletion=network_places,
    ),
]
ListenOption = Annotated[
    list[str] | None,
    typer.Option(metavar="ADDR", help="Network: address to listen on, e.g. 10.0.0.5:7447 [all, any free port]"),
]
#: The former option for routers, used before ``--network`` accepted their addresses.
ConnectOption = Annotated[list[str] | None, typer.Option(metavar="ADDR", hidden=True)]
MulticastOption = Annotated[
    bool, typer.Option("--multicast/--no-multicast", help="Network: be found by UDP multicast, if --network names it")
]
KeysOption = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Network: folder of this proxy's identity [SKYLOOP_KEYS]")
]
OPEN: Final = (
    "WARNING: --network without keys: anyone on this network can watch and fly {names}. Use a network that only "
    "people you trust can reach, or give each of them a key: skyloop keys --help"
)

#: Creates a proxy's transport server, given the proxy's name and the vehicle's address.
MakeEnd = Callable[[str, str], "TransportServer"]


def settings_of(
    network: str | None, listen: list[str] | None, connect: list[str] | None, multicast: bool, keys: Path | None
) -> FabricSettings | None:
    """Return the settings specified by the options, or None to stay on this host."""
    if network is None:
        given = {"--listen": listen, "--connect": connect, "--keys": keys, "--no-multicast": not multicast}
        for option, value in given.items():
            if value:
                raise UsageError(f"{option} is for the network: give --network {MULTICAST} as well")
        return None
    return places(network, listen, connect, multicast, keys)


def places(
    network: str, listen: Sequence[str] | None, connect: Sequence[str] | None, multicast: bool, keys: Path | None
) -> FabricSettings:
    """Return a network's settings from the value of ``--network`` and the related options."""
    from skyloop.network.config import serving

    return serving(network, listen=tuple(listen or ()), connect=tuple(connect or ()), multicast=multicast, keys=keys)


def server_ends(settings: FabricSettings | None, group: str | None = None) -> MakeEnd:
    """Return a factory for a proxy's transport server: on this host, optionally in a group and on the network."""
    from skyloop.transport.local import LocalServer

    if settings is None:
        return lambda name, _: LocalServer(name, group=group)
    from skyloop.network.server import beside

    return lambda name, vehicle: beside(LocalServer(name, group=group), name, settings, vehicle)


def key_changes(settings: FabricSettings | None) -> Callable[[], list[str]] | None:
    """Return a function that reports changes of the keys, for :func:`skyloop.proxy.serve.serve`; None without keys."""
    return None if settings is None or settings.ring is None else settings.ring.poll


def metrics_beside(where: str | None) -> Beside | None:
    """Return the metrics server to run alongside a process's proxies, or None without ``--metrics``."""
    if where is None:
        return None
    from skyloop.metrics import serving_beside
    from skyloop.metrics.endpoint import parse_where

    parse_where(where)  # reports an invalid address before anything starts
    return serving_beside(where, tell)  # on standard error, because programs read the proxies' lines on standard output


def warn_if_open(settings: FabricSettings | None, names: list[str]) -> None:
    """Warn each time, in plain words, if the network has no keys."""
    if settings is not None and settings.tls is None:
        typer.echo(
            OPEN.format(names=" and ".join(names) if len(names) < 4 else f"these {len(names)} vehicles"), err=True
        )


def settle(options: SimOptions) -> None:
    """Make room in this process for the threads that relay commands, alongside those that step and draw.

    The GIL is released after one millisecond instead of five, and OpenCV is limited to one core. Do not call this in a
    user's process.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    if options.cameras:
        from skyloop.sim.render import use_one_core

        use_one_core()


# A router -------------------------------------------------------------------------------------------------------


_POLL_S: Final = 0.2  # interval between checks for signals and newer keys


def router(
    network: Annotated[
        str,
        typer.Option(
            "--network",
            metavar="WHERE",
            help="Networks to join: multicast, or comma-separated routers",
            autocompletion=network_places,
        ),
    ] = MULTICAST,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    multicast: MulticastOption = True,
    keys: KeysOption = None,
    metrics: MetricsOption = None,
    print_config: Annotated[
        bool,
        typer.Option("--print-config", help="Only print the configuration, for Zenoh's own router: zenohd -c FILE"),
    ] = False,
) -> None:
    """Relay between proxies and applications on several networks until Ctrl-C is pressed.

    Each proxy and application connects to a router that it can reach; routers connect to one another.
    """
    from skyloop.network import config
    from skyloop.network.config import Part
    from skyloop.network.session import FabricSession, acquire, release, renewed

    everywhere = f"{config.all_interfaces()}:{config.DEFAULT_PORT}"
    chosen = places(network, listen or [everywhere], connect, multicast, keys)
    if chosen.identity is not None:
        chosen.identity.require_router()
    if print_config:
        typer.echo(config.to_json(config.make(chosen, Part.ROUTER)))
        return
    if chosen.tls is None:
        typer.echo("WARNING: a router without keys: anyone who can reach it can watch and fly its drones", err=True)
    ended = threading.Event()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    session: FabricSession = acquire(chosen, Part.ROUTER)
    with ExitStack() as beside:
        if metrics is not None:
            from skyloop.metrics import router_readings, serve

            tell(beside.enter_context(serve(lambda: [router_readings(lambda: session)], metrics)).announcement)
        typer.echo(f"ready: a router at {', '.join(session.listens)}")
        while not ended.wait(_POLL_S):  # poll, because the kernel may deliver a signal to any thread
            if chosen.ring is None:
                continue
            for change in chosen.ring.poll():
                typer.echo(f"skyloop: {change}", err=True)
            out = session.shut_out()
            if out:
                typer.echo(f"skyloop: reconnecting without {', '.join(sorted(out))}", err=True)
                session = renewed(session)
                chosen = session.settings
    release(session, linger=False)


# Keys -----------------------------------------------------------------------------------------------------------


keys = typer.Typer(no_args_is_help=True, rich_markup_mode=None)

_EXAMPLE: Final = "Example: skyloop keys "
LabOption = Annotated[
    Path | None, typer.Option("--dir", metavar="DIR", help="The lab's folder", show_default="~/.config/skyloop/keys")
]


@keys.callback()
def _keys() -> None:
    """Manage the network's keys: create a lab's authority, and issue, show and revoke identities.

    skyloop keys COMMAND --help describes each command; docs/security.md sets up a lab in five commands.
    """


@keys.command(short_help="Create a lab's authority", epilog=f"{_EXAMPLE}init")
def init(
    directory: LabOption = None,
    days: Annotated[int, typer.Option(metavar="N", help="Validity of the authority, and so of the lab")] = 1825,
) -> None:
    """Create a lab's certificate authority. Its folder lets anyone issue keys: keep it on one machine, backed up."""
    from skyloop.network.keys import Lab

    lab = Lab.make(_place(directory), days)
    typer.echo(f"{lab.authority.name}: {lab.directory}, valid until {_day(lab.authority.expires)}")
    typer.echo("next: skyloop keys issue NAME --role pilot|observer|proxy|router")


@keys.command(
    short_help="Issue an identity, or renew one", epilog=f"{_EXAMPLE}issue jane --role pilot --drones 'alpha*'"
)
def issue(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a person, a proxy or a router")],
    role: Annotated[str, typer.Option(metavar="ROLE", help="pilot, observer, proxy or router")],
    drones: Annotated[
        str,
        typer.Option(metavar="GLOB", help="Drones that a pilot flies, an observer sees or a proxy serves: alpha,b*"),
    ] = "*",
    days: Annotated[float, typer.Option(metavar="N", help="Validity")] = 30.0,
    directory: LabOption = None,
) -> None:
    """Create a key and a certificate in a folder for their holder. An old key with the same name remains valid."""
    from skyloop.network.keys import Lab
    from skyloop.network.keys.identity import make_identity

    lab = Lab.open(_place(directory))
    entry = lab.issue(make_identity(name, role, drones), days)
    typer.echo(f"{entry.identity}: valid until {_day(entry.expires_at)}")
    typer.echo(f"copy {lab.folder(name)} to its machine, for --keys")
    _print_roster(lab.directory, [each for each in lab.roster.entries if each.name != name])


@keys.command(short_help="Show who has keys, and until when", epilog=f"{_EXAMPLE}show")
def show(
    directory: LabOption = None, json: Annotated[bool, typer.Option("--json", help="Print one JSON object")] = False
) -> None:
    """List all identities: role, drones, expiry. --dir may also be an identity's own folder, to show its copy.

    Keys that have expired or will expire within a week are also listed on standard error.
    """
    from skyloop.network.keys.credentials import expiry_warning, read_public

    authority, roster = read_public(_place(directory))
    now = datetime.now(UTC)
    if json:
        head = {"lab": roster.lab, "expires": int(authority.expires.timestamp()), "number": roster.number}
        print_json(head | {"keys": roster.entries})
    else:
        typer.echo(f"{roster.lab}, valid until {_day(authority.expires)}; roster number {roster.number}")
        rows = [(e.name, e.role, ",".join(e.drones), _day(e.expires_at), _state(e, now)) for e in roster.entries]
        typer.echo("\n".join(columns([("NAME", "ROLE", "DRONES", "VALID UNTIL", "STATE"), *rows])))
    ends = [("the lab's authority", authority.expires)]
    ends += [(f"the key of {entry.name}", entry.expires_at) for entry in roster.entries if not entry.revoked]
    for what, end in ends:
        if warning := expiry_warning(what, end, now):
            typer.echo(f"skyloop: {warning}", err=True)


@keys.command(short_help="Revoke a key", epilog=f"{_EXAMPLE}revoke jane")
def revoke(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Identity whose key was lost, or who left")],
    directory: LabOption = None,
) -> None:
    """Remove an identity from the roster. Its key is rejected wherever the new roster is used."""
    from skyloop.network.keys import Lab

    lab = Lab.open(_place(directory))
    entry = lab.revoke(name)
    typer.echo(f"{name} is revoked; holders of an older roster admit it until {_day(entry.last_at)}")
    _print_roster(lab.directory, lab.roster.entries)


def _print_roster(directory: Path, entries: tuple[Entry, ...] | list[Entry]) -> None:
    others = [entry.name for entry in entries if not entry.revoked]
    if others:
        typer.echo(f"copy {directory / 'roster.json'} into the keys of the others: {', '.join(others)}")


def _state(entry: Entry, now: datetime) -> str:
    if entry.revoked:
        return "revoked"
    return "expired" if now >= entry.expires_at else "valid"


def _place(directory: Path | None) -> Path:
    return keys_directory() if directory is None else expand(directory)


def _day(when: datetime) -> str:
    return f"{when:%Y-%m-%d %H:%M} UTC"
