"""What the shell completes besides words of the command line: names of running drones, parameters, files."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

import typer

ANSWER_WITHIN_S: Final = 2.0


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
