"""``skyloop list``: the proxies of this host."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated

import msgspec
import typer

from skyloop.cli.text import columns
from skyloop.errors import SkyloopError

ANSWER_WITHIN_S = 1.0


class Row(msgspec.Struct, frozen=True):
    """One proxy as ``list`` shows it."""

    name: str
    transport: str = "local"
    pid: int | None = None
    vehicle: str = ""
    uri: str = ""
    state: str = ""
    battery: float | None = None
    owner: str | None = None
    vehicle_link: str = ""
    problem: str = ""


def list_proxies(
    json: Annotated[bool, typer.Option("--json", help="For programs: one JSON array")] = False,
) -> None:
    """Show the running proxies, what they fly, in which state, and who holds the authority."""
    rows = running()
    if json:
        typer.echo(msgspec.json.encode(rows).decode())
    elif not rows:
        typer.echo("No proxy is running on this host. Start one: skyloop proxy sim:// --name alpha")
    else:
        for line in lines(rows):
            typer.echo(line)


def running() -> list[Row]:
    """All proxies of this host, by name, asked at the same time: one that is stopped delays the list once."""
    from skyloop.transport.local import list_names

    proxies = list_names()
    if not proxies:
        return []
    with ThreadPoolExecutor(max_workers=min(32, len(proxies))) as pool:
        return list(pool.map(lambda proxy: describe(proxy.name, proxy.pid), proxies))


def describe(name: str, pid: int | None = None) -> Row:
    """What a proxy says of itself; one that does not answer is described by the reason."""
    from skyloop.client import connect

    try:
        with connect(name, access="observe", name="skyloop list", timeout_s=ANSWER_WITHIN_S) as drone:
            feedback = drone.feedback()
            return Row(
                name,
                pid=pid,
                vehicle=drone.capabilities.vehicle,
                uri=drone.uri,
                state=feedback.state.value,
                battery=feedback.battery,
                owner=feedback.owner,
                vehicle_link=feedback.vehicle_link.value,
            )
    except SkyloopError as error:
        return Row(name, pid=pid, problem=str(error))


def lines(rows: Iterable[Row]) -> list[str]:
    """As a table of text, the address last because it may be long."""
    cells = [("NAME", "STATE", "BATTERY", "PILOT", "LINK", "ADDRESS")]
    cells += [
        (
            row.name,
            row.state or "?",
            "" if row.battery is None else f"{row.battery:.0%}",
            row.owner or ("?" if row.problem else "nobody"),
            row.vehicle_link or "?",
            row.problem or row.uri,
        )
        for row in rows
    ]
    return columns(cells)
