"""``skyloop cockpit``: a page in the browser to watch and fly drones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skyloop.cli.naming import (
    DronesOption,
    KeysOption,
    NetworkOption,
    drone_names,
    drones,
    join_network,
    keys_directory,
)
from skyloop.cli.network import MetricsOption
from skyloop.messages import Role


def cockpit(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME...",
            help="Running proxies; without names: all, as they come and go",
            autocompletion=drone_names,
        ),
    ] = None,
    drone: DronesOption = None,
    port: Annotated[
        int | None,
        typer.Option(
            metavar="PORT", min=0, max=65535, help="Of the page; 0 takes a free one [8420, or the next free one]"
        ),
    ] = None,
    host: Annotated[
        str,
        typer.Option(metavar="ADDRESS", help="To listen on; beyond loopback --pair, tokens or certificates are needed"),
    ] = "127.0.0.1",
    token_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Who may come in: lines of ROLE TOKEN [NAME]")
    ] = None,
    https: Annotated[
        bool,
        typer.Option(
            "--https", help="With a certificate that is made for this machine; browsers need it to decode H.264"
        ),
    ] = False,
    tls_cert: Annotated[Path | None, typer.Option(metavar="FILE", help="The page's certificate, PEM")] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="FILE", help="Its key, PEM")] = None,
    client_ca: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Admit clients with a certificate of this authority; its OU is the role"),
    ] = None,
    role: Annotated[Role, typer.Option(help="Of every client, without tokens or certificates")] = Role.PILOT,
    pair: Annotated[
        bool, typer.Option("--pair", help="Let in, in --role, each browser that opens the shown link or QR code, once")
    ] = False,
    hostname: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="A name by which browsers reach this machine; repeatable")
    ] = None,
    recordings: Annotated[Path, typer.Option(metavar="FOLDER", help="Of recordings, made when needed")] = Path(
        "recordings"
    ),
    world: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="World file of the room, for the maps of drones that don't know theirs"),
    ] = None,
    network: NetworkOption = None,
    keys: KeysOption = None,
    metrics: MetricsOption = None,
) -> None:
    """Serve a page to watch and fly drones: video, instruments, map, plots, parameters, recordings. Until Ctrl-C.

    It is open to programs of the same user on this machine only, unless tokens or certificates let others in.
    """
    from skyloop.cockpit import Access, serve_cockpit, with_certificate
    from skyloop.network.config import choose

    access = Access(host, token_file, tls_cert, tls_key, client_ca, role, tuple(hostname or ()), pair)
    if https:
        access = with_certificate(access, keys_directory() / "pages")
    join_network(network, keys)
    serve_cockpit(
        drones(names, drone, needed=False),
        port=port,
        access=access,
        recordings=recordings,
        network=choose(),
        world=world,
        metrics=metrics,
    )
