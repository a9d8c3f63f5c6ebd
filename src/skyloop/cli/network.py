"""What commands that serve vehicles share: their options of the network, its servers, and settings of the process."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from skyloop.cli.naming import MULTICAST, network_places
from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.network import FabricSettings
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
SWITCH_INTERVAL_S: Final = 0.001


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
    """Return what makes a proxy's transport server: on this host, and with settings on the network too.

    Args:
        settings: How to join the network, None for this host only.
        group: The group of users that may connect on this host.
    """
    from skyloop.transport.local import LocalServer

    if settings is None:
        return lambda name, _: LocalServer(name, group=group)
    from skyloop.network import FabricServer
    from skyloop.transport.composite import CompositeServer

    return lambda name, vehicle: CompositeServer(
        [LocalServer(name, group=group), FabricServer(name, settings, vehicle=vehicle)]
    )


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
    return serving_beside(where, announce)


def announce(line: str) -> None:
    """Print a line about metrics; on standard error, as programs read the lines of proxies on standard output."""
    typer.echo(line, err=True)


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
