"""``skyloop cockpit``: a page in the browser that watches a drone."""

from __future__ import annotations

from typing import Annotated

import typer


def cockpit(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A running proxy; skyloop list shows them")],
    port: Annotated[int, typer.Option(metavar="PORT", min=0, max=65535, help="Of the page; 0 takes a free one")] = 0,
) -> None:
    """Serve a page on loopback with live video, attitude, authority and link health of one drone, until Ctrl-C."""
    from skyloop.cockpit import serve_cockpit

    serve_cockpit(name, port=port)
