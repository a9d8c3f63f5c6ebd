"""The options of commands that serve vehicles to the network, and the transport servers that they ask for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.transport.base import TransportServer
    from skyloop.transport.fabric import FabricSettings

NetworkOption = Annotated[
    bool, typer.Option("--network", help="Serve to the network as well; without it nothing leaves this host")
]
ListenOption = Annotated[
    list[str] | None,
    typer.Option(metavar="ADDR", help="Of the network: where to listen, e.g. 10.0.0.5:7447 [all, any free port]"),
]
ConnectOption = Annotated[
    list[str] | None, typer.Option(metavar="ADDR", help="Of the network: a router to join; may be repeated")
]
MulticastOption = Annotated[
    bool, typer.Option("--multicast/--no-multicast", help="Of the network: be found by UDP multicast on this segment")
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
    network: bool,
    listen: list[str] | None,
    connect: list[str] | None,
    multicast: bool,
    keys: Path | None,
) -> FabricSettings | None:
    """Return the settings that the options give; None to stay on this host.

    Raises:
        UsageError: An option needs ``--network``, or is not valid.
    """
    if not network:
        given = {"--listen": listen, "--connect": connect, "--keys": keys, "--no-multicast": not multicast}
        for option, value in given.items():
            if value:
                raise UsageError(f"{option} is for the network: give --network as well")
        return None
    from skyloop.transport.fabric.environment import settings

    return settings(listen=tuple(listen or ()), connect=tuple(connect or ()), multicast=multicast, keys=keys)


def server_ends(settings: FabricSettings | None, group: str | None = None) -> MakeEnd:
    """Return what makes a proxy's transport server: on this host, and with settings on the network too.

    Args:
        settings: How to join the network, None for this host only.
        group: The group of users that may connect on this host.
    """
    from skyloop.transport.local import LocalServer

    if settings is None:
        return lambda name, _: LocalServer(name, group=group)
    from skyloop.transport.composite import CompositeServer
    from skyloop.transport.fabric import FabricServer

    return lambda name, vehicle: CompositeServer(
        [LocalServer(name, group=group), FabricServer(name, settings, vehicle=vehicle)]
    )


def key_changes(settings: FabricSettings | None) -> Callable[[], list[str]] | None:
    """Return what reports on the keys, for :func:`skyloop.proxy.serve.serve`; None without keys."""
    return None if settings is None or settings.ring is None else settings.ring.poll


def warn_if_open(settings: FabricSettings | None, names: list[str]) -> None:
    """Warn in plain words, each time, what the network means without keys."""
    if settings is not None and settings.tls is None:
        typer.echo(
            OPEN.format(names=" and ".join(names) if len(names) < 4 else f"these {len(names)} vehicles"), err=True
        )
