"""``skyloop keys``: who may join a lab's network, and what each may do there."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import typer

from skyloop.cli.naming import keys_directory
from skyloop.cli.text import columns
from skyloop.files import expand

if TYPE_CHECKING:
    from skyloop.network.keys import Entry

keys = typer.Typer(no_args_is_help=True, rich_markup_mode=None)

_EXAMPLE: Final = "Example: skyloop keys "
Directory = Annotated[
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
    directory: Directory = None,
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
    directory: Directory = None,
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
    directory: Directory = None,
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
    directory: Directory = None,
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
