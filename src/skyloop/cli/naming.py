"""How a command line names drones and the network: the same words, help and completion for every command.

A drone is named by NAME; ``--drone NAME`` means the same everywhere. The network is ``--network WHERE``.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from skyloop.errors import UsageError

ANSWER_WITHIN_S: Final = 2.0
MULTICAST: Final = "multicast"
NETWORK_VARIABLE: Final = "SKYLOOP_NETWORK"
KEYS_VARIABLE: Final = "SKYLOOP_KEYS"


def drone_names(incomplete: str) -> list[str]:
    """Return the names of proxies that run on this host, sorted. Their sockets are read, nobody is asked."""
    with suppress(Exception):  # a shell that completes shows no errors
        from skyloop.transport.local import list_names

        return sorted(proxy.name for proxy in list_names() if proxy.name.startswith(incomplete))
    return []


def parameter_names(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the parameters of the drone that the command line names already."""
    name = ctx.params.get("name") or ctx.params.get("drone")
    if not name:
        return []
    with suppress(Exception):
        from skyloop.client import connect

        with connect(name, access="observe", name="skyloop completion", timeout_s=ANSWER_WITHIN_S) as drone:
            return [each.name for each in drone.config.parameters() if each.name.startswith(incomplete)]
    return []


def network_places(incomplete: str) -> list[str]:
    """Return the place that needs no address."""
    return [place for place in ("multicast",) if place.startswith(incomplete)]


def recordings(incomplete: str) -> list[str]:
    """Return recordings, and folders that may hold some."""
    return files_ending(incomplete, {".mcap"})


def python_files(incomplete: str) -> list[str]:
    """Return Python files, and folders that may hold some."""
    return files_ending(incomplete, {".py"})


def files_ending(incomplete: str, endings: Iterable[str]) -> list[str]:
    """Return files with these endings, and folders, that begin with what was typed."""
    folder, _, start = incomplete.rpartition("/")
    wanted, found = set(endings), []
    with suppress(OSError):
        for path in sorted(Path(folder or ("/" if incomplete.startswith("/") else ".")).iterdir()):
            if not path.name.startswith(start) or (path.name.startswith(".") and not start):
                continue
            shown = f"{folder}/{path.name}" if "/" in incomplete else path.name
            if path.is_dir():
                found.append(f"{shown}/")
            elif path.suffix in wanted:
                found.append(shown)
    return found


def _name(metavar: str, what: str) -> Any:
    return typer.Argument(metavar=metavar, help=what, autocompletion=drone_names, show_default=False)


NameArgument = Annotated[str | None, _name("NAME", "A running proxy's, as skyloop list shows them")]
AnyNameArgument = Annotated[str | None, _name("NAME", "A running proxy's, or a vehicle's address such as sim://")]
OptionalNameArgument = Annotated[
    str | None, _name("[NAME]", "A running proxy's, or a vehicle's address; without: sim://")
]
NamesArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="NAME...", help="Running proxies; skyloop list shows them", autocompletion=drone_names),
]
DroneOption = Annotated[
    str | None, typer.Option("--drone", metavar="NAME", help="The same as NAME", autocompletion=drone_names)
]
DronesOption = Annotated[
    list[str] | None,
    typer.Option("--drone", metavar="NAME", help="The same as NAME; repeatable", autocompletion=drone_names),
]
NetworkOption = Annotated[
    str | None,
    typer.Option(
        "--network",
        metavar="WHERE",
        help=f"Search there too: multicast, or addresses with commas [{NETWORK_VARIABLE}]",
        autocompletion=network_places,
    ),
]
KeysOption = Annotated[
    Path | None,
    typer.Option("--keys", metavar="DIR", help=f"Of the network: folder of an identity [{KEYS_VARIABLE}]"),
]


def keys_directory() -> Path:
    """Return the folder of this user's lab."""
    import platformdirs

    return platformdirs.user_config_path("skyloop", appauthor=False) / "keys"


def one_drone(name: str | None, drone: str | None, default: str | None = None) -> str:
    """Return the drone that a command is about.

    Args:
        name: As NAME.
        drone: As ``--drone``.
        default: Where neither is given; None: one must be.

    Raises:
        UsageError: None is named, or two are.
    """
    if name is not None and drone is not None and name != drone:
        raise UsageError(f"NAME {name} and --drone {drone} name two drones: give one of them")
    chosen = name or drone or default
    if chosen is None:
        raise UsageError(f"no drone is named: give its NAME, or --drone NAME; {_running()}")
    return chosen


def drones(names: Sequence[str] | None, others: Sequence[str] | None, *, needed: bool = True) -> list[str]:
    """Return the drones that a command is about, each once: those that it has as NAME, then those as ``--drone``.

    Raises:
        UsageError: None is named and one is needed.
    """
    chosen = list(dict.fromkeys([*(names or ()), *(others or ())]))
    if needed and not chosen:
        raise UsageError(f"no drone is named: give its NAME, or --drone NAME; {_running()}")
    return chosen


def _running() -> str:
    found = drone_names("")
    return f"running: {', '.join(found)}" if found else "none is running: skyloop sim starts a simulated one"


def join_network(network: str | None, keys: Path | None) -> None:
    """Search the network as the options say, in this process and those that it starts.

    Raises:
        UsageError: An address or the folder is not valid, or keys are given without a network.
    """
    if network is None and keys is None:
        return
    from skyloop.network.config import choose

    choose(network, keys)  # refuses what is not valid
    for variable, value in ((NETWORK_VARIABLE, network), (KEYS_VARIABLE, keys)):
        if value is not None:
            os.environ[variable] = str(value)


def with_place(arguments: Sequence[str]) -> list[str]:
    """Return the words of a command line with ``multicast`` behind a ``--network`` that names no place."""
    words: list[str] = []
    for index, word in enumerate(arguments):
        words.append(word)
        if word == "--":
            return [*words, *arguments[index + 1 :]]
        following = arguments[index + 1] if index + 1 < len(arguments) else "--"
        if word == "--network" and (following.startswith("-") or "://" in following):
            words.append(MULTICAST)
    return words
