"""``skyloop cockpit``: a web page to watch and fly drones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skyloop.cli import naming
from skyloop.cli.network import MetricsOption
from skyloop.messages import Role


def cockpit(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME...",
            help="Running proxies; without names: all, as they come and go",
            autocompletion=naming.drone_names,
        ),
    ] = None,
    drone: naming.DronesOption = None,
    port: Annotated[
        int | None,
        typer.Option(
            metavar="PORT", min=0, max=65535, help="Port of the page; 0: any free one [8420, or the next free one]"
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Address; beyond loopback this needs --pair, tokens or certificates")
    ] = "127.0.0.1",
    token_file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File of people to admit: lines of ROLE TOKEN [NAME]")
    ] = None,
    https: Annotated[
        bool,
        typer.Option("--https", help="Use a certificate made for this machine; browsers need https to decode H.264"),
    ] = False,
    tls_cert: Annotated[Path | None, typer.Option(metavar="FILE", help="The page's certificate, PEM")] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="FILE", help="Its key, PEM")] = None,
    client_ca: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Admit clients with a certificate from this authority; its OU is the role"),
    ] = None,
    role: Annotated[Role, typer.Option(help="Everyone's role if there are no tokens or certificates")] = Role.PILOT,
    pair: Annotated[
        bool, typer.Option("--pair", help="Admit, in --role, the first browser that opens each link or QR code shown")
    ] = False,
    hostname: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Name by which browsers reach this machine; repeatable")
    ] = None,
    recordings: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for recordings")] = Path("recordings"),
    world: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="World file of the room, for maps of drones that don't report theirs"),
    ] = None,
    network: naming.NetworkOption = None,
    keys: naming.KeysOption = None,
    metrics: MetricsOption = None,
) -> None:
    """Serve a page to watch and fly drones: video, instruments, map, plots, parameters, recordings. Until Ctrl-C.

    Only programs of the same user on this machine are admitted, unless tokens or certificates admit other users.
    """
    from skyloop.cockpit import Access, serve_cockpit, with_certificate
    from skyloop.network.config import choose

    access = Access(host, token_file, tls_cert, tls_key, client_ca, role, tuple(hostname or ()), pair)
    if https:
        access = with_certificate(access, naming.keys_directory() / "pages")
    naming.join_network(network, keys)
    serve_cockpit(
        naming.drones(names, drone, needed=False),
        port=port,
        access=access,
        recordings=recordings,
        network=choose(),
        world=world,
        metrics=metrics,
    )
