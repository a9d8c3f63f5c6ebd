"""``skyloop proxy``: turns one vehicle into a node."""

from __future__ import annotations

from typing import Annotated

import typer


def proxy(
    uri: Annotated[str, typer.Argument(metavar="URI", help="The vehicle, e.g. sim:// or video://flight.mp4")],
    name: Annotated[str, typer.Option(metavar="NAME", help="What applications connect to")] = "alpha",
    group: Annotated[
        str | None, typer.Option(metavar="GROUP", help="A group of users whose members may connect too")
    ] = None,
    parent_fd: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> None:
    """Serve one vehicle to the applications of this host, until Ctrl-C, which lands it first."""
    from skyloop.drivers.uri import parse_uri
    from skyloop.proxy.serve import serve

    vehicle = parse_uri(uri)
    if vehicle.scheme == "sim":
        from skyloop.cli.simulating import settle
        from skyloop.drivers.sim import options_of

        settle(options_of(vehicle))
    serve(uri, name, group=group, parent_fd=parent_fd)
