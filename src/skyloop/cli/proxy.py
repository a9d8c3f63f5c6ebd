"""``skyloop proxy``: turns one vehicle into a node."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skyloop.cli.network import (
    ConnectOption,
    KeysOption,
    ListenOption,
    MetricsOption,
    MulticastOption,
    ServeOption,
    key_changes,
    metrics_beside,
    server_ends,
    settings_of,
    warn_if_open,
)


def proxy(
    uri: Annotated[str, typer.Argument(metavar="URI", help="The vehicle, e.g. sim:// or video://flight.mp4")],
    name: Annotated[str, typer.Option(metavar="NAME", help="What applications connect to")] = "alpha",
    group: Annotated[
        str | None, typer.Option(metavar="GROUP", help="A group of users whose members may connect too")
    ] = None,
    network: ServeOption = None,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    multicast: MulticastOption = True,
    keys: KeysOption = None,
    audit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where who flew when is written [the user's directory of state]")
    ] = None,
    metrics: MetricsOption = None,
    parent_fd: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Serve one vehicle to applications, until Ctrl-C, which lands it first.

    Applications are of this host, and with --network of others too.
    """
    from skyloop.child_process import handed_over
    from skyloop.drivers.uri import parse_uri
    from skyloop.proxy.serve import serve

    settings = settings_of(network, listen, connect, multicast, keys)
    vehicle = parse_uri((handed_over() if parent_fd is not None else None) or uri)
    if vehicle.scheme == "sim":
        from skyloop.cli.simulating import settle
        from skyloop.vehicles.sim.options import options_of

        settle(options_of(vehicle))
    warn_if_open(settings, [name])
    serve(
        vehicle,
        name,
        make_end=server_ends(settings, group),
        parent_fd=parent_fd,
        look=key_changes(settings),
        audit=audit,
        beside=metrics_beside(metrics),
    )
