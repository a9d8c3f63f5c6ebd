"""The network: what commands that serve vehicles share of it, ``skyloop router`` and ``skyloop keys``.

``skyloop keys`` decides who may join a lab's network, and what each may do there.
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

import msgspec
import typer

from skyloop.cli.naming import MULTICAST, keys_directory, network_places
from skyloop.cli.text import columns, tell
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
        help="Serve metrics for Prometheus there; on loopback without HOST, on a free port with 0",
    ),
]
ServeOption = Annotated[
    str | None,
    typer.Option(
        "--network",
        metavar="WHERE",
        help="Serve there too: multicast, or routers' addresses with commas; else nothing leaves this host",
        autocompletion=network_places,
    ),
]
ListenOption = Annotated[
    list[str] | None,
    typer.Option(metavar="ADDR", help="Of the network: where to listen, e.g. 10.0.0.5:7447 [all, any free port]"),
]
#: As routers were given before ``--network`` took their addresses.
ConnectOption = Annotated[list[str] | None, typer.Option(metavar="ADDR", hidden=True)]
MulticastOption = Annotated[
    bool,
    typer.Option(
        "--multicast/--no-multicast", help="Of the network: be found by UDP multicast, where --network names it"
    ),
]
KeysOption = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Of the network: folder of this proxy's identity [SKYLOOP_KEYS]")
]
OPEN: Final = (
    "WARNING: --network without keys: anyone on this network can watch and fly {names}. Use it on a network that only "
    "people you trust can reach, or give each of them a key: skyloop keys --help"
)

#: Makes the transport server of a proxy: of its name and its vehicle's address.
MakeEnd = Callable[[str, str], "TransportServer"]


def settings_of(
    network: str | None,
    listen: list[str] | None,
    connect: list[str] | None,
    multicast: bool,
    keys: Path | None,
) -> FabricSettings | None:
    """Return the settings that the options give; None to stay on this host.

    Raises:
        UsageError: An option needs ``--network``, or is not valid.
    """
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
    """Return the settings of a network that is named as ``--network`` names it.

    Raises:
        UsageError: An address or the folder is not valid, or no place is named.
    """
    from skyloop.network.config import serving

    return serving(network, listen=tuple(listen or ()), connect=tuple(connect or ()), multicast=multicast, keys=keys)


def server_ends(settings: FabricSettings | None, group: str | None = None) -> MakeEnd:
    """Return what makes a proxy's transport server: on this host, for a group too, and with settings on the network."""
    from skyloop.transport.local import LocalServer

    if settings is None:
        return lambda name, _: LocalServer(name, group=group)
    from skyloop.network.server import beside

    return lambda name, vehicle: beside(LocalServer(name, group=group), name, settings, vehicle)


def key_changes(settings: FabricSettings | None) -> Callable[[], list[str]] | None:
    """Return what reports on the keys, for :func:`skyloop.proxy.serve.serve`; None without keys."""
    return None if settings is None or settings.ring is None else settings.ring.poll


def metrics_beside(where: str | None) -> Beside | None:
    """Return what serves metrics beside the proxies of a process; None without ``--metrics``.

    Raises:
        UsageError: ``where`` is no address.
    """
    if where is None:
        return None
    from skyloop.metrics import serving_beside
    from skyloop.metrics.endpoint import parse_where

    parse_where(where)
    return serving_beside(where, tell)  # on standard error, as programs read the lines of proxies on standard output


def warn_if_open(settings: FabricSettings | None, names: list[str]) -> None:
    """Warn in plain words, each time, what the network means without keys."""
    if settings is not None and settings.tls is None:
        typer.echo(
            OPEN.format(names=" and ".join(names) if len(names) < 4 else f"these {len(names)} vehicles"), err=True
        )


def settle(options: SimOptions) -> None:
    """Make room, in this whole process, for the threads that pass commands on beside those that step and draw.

    The interpreter lock is handed over after a millisecond, not five, and OpenCV keeps to one core. Do not call it in
    the user's process.

    Raises:
        MissingExtraError: Cameras are wanted, and what draws them is not installed.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    if options.cameras:
        from skyloop.sim.render import use_one_core

        use_one_core()


# A router -------------------------------------------------------------------------------------------------------


ROUTER_PORT: Final = 7447
_POLL_S: Final = 0.2


def router(
    network: Annotated[
        str,
        typer.Option(
            "--network",
            metavar="WHERE",
            help="What to join: multicast, or other routers' addresses with commas",
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
    """Pass on what proxies and applications of several networks say, until Ctrl-C.

    Each of them connects to a router that it can reach; routers connect to each other.
    """
    from skyloop.network import config
    from skyloop.network.config import Part
    from skyloop.network.session import Session, acquire, release, renewed

    everywhere = f"{config.all_interfaces()}:{ROUTER_PORT}"
    chosen = places(network, listen or [everywhere], connect, multicast, keys)
    if chosen.identity is not None:
        chosen.identity.require_router()
    if print_config:
        typer.echo(config.to_json(config.make(chosen, Part.ROUTER)))
        return
    if chosen.tls is None:
        typer.echo(
            "WARNING: a router without keys: anyone who reaches it can watch and fly what is behind it", err=True
        )
    ended = threading.Event()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    session: Session = acquire(chosen, Part.ROUTER)
    with ExitStack() as beside:
        if metrics is not None:
            from skyloop.metrics import router_readings, serve

            tell(beside.enter_context(serve(lambda: [router_readings(lambda: session)], metrics)).announcement)
        typer.echo(f"ready: a router at {', '.join(session.listens)}")
        while not ended.wait(_POLL_S):  # looks up now and then: the kernel may hand a signal to any thread
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
    Path | None,
    typer.Option("--dir", metavar="DIR", help="The lab's folder", show_default="~/.config/skyloop/keys"),
]


@keys.callback()
def _keys() -> None:
    """Keys for the network: make a lab's authority, issue identities, look at them, revoke them.

    skyloop keys COMMAND --help shows more about each; docs/security.md has a lab in five commands.
    """


@keys.command(short_help="Make a lab's authority", epilog=f"{_EXAMPLE}init")
def init(
    directory: LabOption = None,
    days: Annotated[int, typer.Option(metavar="N", help="How long it, and so the lab, is valid")] = 1825,
) -> None:
    """Make a lab's certificate authority. Who has its folder can make any key: keep it on one machine, with a copy."""
    from skyloop.network.keys import Lab

    lab = Lab.make(_place(directory), days)
    typer.echo(f"{lab.authority.name}: {lab.directory}, valid until {_day(lab.authority.expires)}")
    typer.echo("next: skyloop keys issue NAME --role pilot|observer|proxy|router")


@keys.command(
    short_help="Issue an identity, or renew one", epilog=f"{_EXAMPLE}issue jane --role pilot --drones 'alpha*'"
)
def issue(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of a person, a proxy or a router")],
    role: Annotated[str, typer.Option(metavar="ROLE", help="pilot, observer, proxy or router")],
    drones: Annotated[
        str, typer.Option(metavar="GLOB", help="A pilot flies, an observer sees, a proxy serves: alpha,b*")
    ] = "*",
    days: Annotated[float, typer.Option(metavar="N", help="How long it is valid")] = 30.0,
    directory: LabOption = None,
) -> None:
    """Make a key and a certificate, and the folder that its holder is given. An old key of that name stays valid."""
    from skyloop.network.keys import Lab
    from skyloop.network.keys.identity import make_identity

    lab = Lab.open(_place(directory))
    entry = lab.issue(make_identity(name, role, drones), days)
    typer.echo(f"{entry.identity}: valid until {_day(entry.expires_at)}")
    typer.echo(f"copy {lab.folder(name)} to its machine, for --keys")
    _print_roster(lab.directory, [each for each in lab.roster.entries if each.name != name])


@keys.command(short_help="Who has keys, until when", epilog=f"{_EXAMPLE}show")
def show(
    directory: LabOption = None,
    json: Annotated[bool, typer.Option("--json", help="For programs: one JSON object")] = False,
) -> None:
    """List all identities: role, drones, end. --dir may also be the folder of an identity, to see its copy of the list.

    Keys that expire within a week, or have expired, are listed on standard error as well.
    """
    from skyloop.network.keys.credentials import expiry_warning, read_public

    authority, roster = read_public(_place(directory))
    now = datetime.now(UTC)
    if json:
        head = {"lab": roster.lab, "expires": int(authority.expires.timestamp()), "number": roster.number}
        typer.echo(msgspec.json.encode(head | {"keys": roster.entries}).decode())
    else:
        typer.echo(f"{roster.lab}, valid until {_day(authority.expires)}; roster number {roster.number}")
        rows = [(e.name, e.role, ",".join(e.drones), _day(e.expires_at), _state(e, now)) for e in roster.entries]
        for line in columns([("NAME", "ROLE", "DRONES", "VALID UNTIL", "STATE"), *rows]):
            typer.echo(line)
    ends = [("the lab's authority", authority.expires)]
    ends += [(f"the key of {entry.name}", entry.expires_at) for entry in roster.entries if not entry.revoked]
    for what, end in ends:
        if warning := expiry_warning(what, end, now):
            typer.echo(f"skyloop: {warning}", err=True)


@keys.command(short_help="Revoke a key", epilog=f"{_EXAMPLE}revoke jane")
def revoke(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Whose key was lost, or who left")],
    directory: LabOption = None,
) -> None:
    """Take an identity off the roster. Its key opens nothing wherever the new roster is in use."""
    from skyloop.network.keys import Lab

    lab = Lab.open(_place(directory))
    entry = lab.revoke(name)
    typer.echo(f"{name} is revoked; who has an older roster lets it in until {_day(entry.last_at)}")
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
