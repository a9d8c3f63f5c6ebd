"""Options that name drones and the network, with the same names, help and completion in every command.

A drone is given as NAME; ``--drone NAME`` means the same everywhere. The network is given as ``--network WHERE``.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from skyloop.errors import UsageError

ANSWER_WITHIN_S: Final = 2.0  #: time limit for a completion that asks a drone
MULTICAST: Final = "multicast"
NETWORK_VARIABLE: Final = "SKYLOOP_NETWORK"
KEYS_VARIABLE: Final = "SKYLOOP_KEYS"


def drone_names(incomplete: str) -> list[str]:
    """Return the sorted names of proxies on this host, taken from their sockets, without querying them."""
    with suppress(Exception):  # shells don't show errors during completion
        from skyloop.transport.local import list_names

        return sorted(proxy.name for proxy in list_names() if proxy.name.startswith(incomplete))
    return []


def parameter_names(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the parameters of the drone that the command line already names."""
    name = ctx.params.get("name") or ctx.params.get("drone")
    if not name:
        return []
    with suppress(Exception):
        from skyloop.client import connect

        with connect(name, access="observe", name="skyloop completion", timeout_s=ANSWER_WITHIN_S) as drone:
            return [each.name for each in drone.config.parameters() if each.name.startswith(incomplete)]
    return []


def network_places(incomplete: str) -> list[str]:
    """Return ``multicast``, the only network place that is not an address."""
    return [MULTICAST] if MULTICAST.startswith(incomplete) else []


def recordings(incomplete: str) -> list[str]:
    return files_ending(incomplete, {".mcap"})


def python_files(incomplete: str) -> list[str]:
    return files_ending(incomplete, {".py"})


def files_ending(incomplete: str, endings: Iterable[str]) -> list[str]:
    """Return folders, and files with these suffixes, whose names begin with the typed text."""
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


NameArgument = Annotated[str | None, _name("NAME", "Running proxy, as shown by skyloop list")]
AnyNameArgument = Annotated[str | None, _name("NAME", "Running proxy, or a vehicle's address such as sim://")]
OptionalNameArgument = Annotated[str | None, _name("[NAME]", "Running proxy, or a vehicle's address [default: sim://]")]
NamesArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="NAME...", help="Running proxies, as shown by skyloop list", autocompletion=drone_names),
]
DroneOption = Annotated[
    str | None, typer.Option("--drone", metavar="NAME", help="Same as NAME", autocompletion=drone_names)
]
DronesOption = Annotated[
    list[str] | None,
    typer.Option("--drone", metavar="NAME", help="Same as NAME; repeatable", autocompletion=drone_names),
]
NetworkOption = Annotated[
    str | None,
    typer.Option(
        "--network",
        metavar="WHERE",
        help=f"Also search there: multicast, or comma-separated addresses [{NETWORK_VARIABLE}]",
        autocompletion=network_places,
    ),
]
KeysOption = Annotated[
    Path | None, typer.Option("--keys", metavar="DIR", help=f"Network: folder of an identity [{KEYS_VARIABLE}]")
]
PriorityOption = Annotated[
    int, typer.Option("--priority", metavar="P", min=0, max=31, help="0 is the highest, 31 the lowest")
]
WaitOption = Annotated[
    float, typer.Option("--wait", metavar="S", min=0.0, help="Maximum wait in the queue for the authority")
]
SecondsOption = Annotated[
    float | None, typer.Option("--seconds", metavar="S", min=0.0, help="Duration [default: until Ctrl-C]")
]


def keys_directory() -> Path:
    """Return the folder of the current user's lab."""
    import platformdirs

    return platformdirs.user_config_path("skyloop", appauthor=False) / "keys"


def one_drone(name: str | None, drone: str | None, default: str | None = None) -> str:
    """Return the drone that a command is for; ``default`` if none is given (None: then one is required)."""
    if name is not None and drone is not None and name != drone:
        raise UsageError(f"NAME {name} and --drone {drone} name two drones: give only one")
    chosen = name or drone or default
    if chosen is None:
        raise UsageError(f"no drone given: give NAME or --drone NAME; {_running()}")
    return chosen


def drones(names: Sequence[str] | None, others: Sequence[str] | None, *, needed: bool = True) -> list[str]:
    """Return the drones that a command is for, each once: those given as NAME, then those given as ``--drone``."""
    chosen = list(dict.fromkeys([*(names or ()), *(others or ())]))
    if needed and not chosen:
        raise UsageError(f"no drone given: give NAME or --drone NAME; {_running()}")
    return chosen


def _running() -> str:
    found = drone_names("")
    return f"running: {', '.join(found)}" if found else "none is running: skyloop sim starts a simulated one"


def join_network(network: str | None, keys: Path | None) -> None:
    """Search the network that the options specify, in this process and its children."""
    if network is None and keys is None:
        return
    from skyloop.network.config import choose

    choose(network, keys)  # raises an error if values are invalid
    for variable, value in ((NETWORK_VARIABLE, network), (KEYS_VARIABLE, keys)):
        if value is not None:
            os.environ[variable] = str(value)


def with_place(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with ``multicast`` inserted after each ``--network`` that has no value."""
    words: list[str] = []
    for index, word in enumerate(arguments):
        words.append(word)
        if word == "--":
            return [*words, *arguments[index + 1 :]]
        following = arguments[index + 1] if index + 1 < len(arguments) else "--"
        if word == "--network" and (following.startswith("-") or "://" in following):
            words.append(MULTICAST)
    return words
