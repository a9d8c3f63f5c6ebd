"""``skyloop install``: installs optional parts into this environment, and reports missing ones.

There is no single way to name an extra to pip that works for a checkout, a wheel and a release. The requirements are
therefore read from the package's own metadata, which all three of them have.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from importlib.metadata import requires
from typing import Annotated, Final

import typer

from skyloop.errors import SkyloopError, UnknownNameError, UnsupportedError, install_command

#: Optional parts: the name of the extra, its purpose, and the modules that it needs.
EXTRAS: Final = (
    ("sim", "simulator's cameras", ("cv2",)),
    ("fast", "simulator's cameras, several times faster", ("numba", "cv2")),
    ("vision", "markers and other vision", ("cv2", "PIL")),
    ("detect", "detectors from an ONNX file", ("onnxruntime", "cv2", "scipy")),
    ("video", "recorded video, H.264", ("av",)),
    ("control", "poses and splines", ("scipy",)),
    ("mavlink", "ArduCopter and PX4", ("pymavlink", "serial")),
    ("msp", "Betaflight and INAV over a serial port", ("serial",)),
    ("crazyflie", "Crazyflie through a Crazyradio", ("usb",)),
    ("ros", "ROS 2", ("rclpy", "cv2")),
    ("cockpit", "page in the browser", ("starlette", "uvicorn", "websockets", "cv2")),
    ("record", "recordings", ("mcap", "foxglove_schemas_protobuf", "google.protobuf", "cv2")),
    ("foxglove", "drones live in Foxglove", ("foxglove", "foxglove_schemas_protobuf", "google.protobuf", "cv2")),
    ("rerun", "drones and recordings in Rerun", ("rerun", "foxglove_schemas_protobuf", "google.protobuf", "cv2")),
    ("parquet", "tables as Parquet", ("pyarrow",)),
    ("network", "network and its keys", ("zenoh", "cryptography", "cv2")),
    ("metrics", "metrics for Prometheus", ("prometheus_client",)),
    ("mocap", "motion capture", ("motioncapture", "scipy")),
    ("gym", "reinforcement learning", ("gymnasium", "cv2")),
    ("bench", "figures and diagrams", ("matplotlib",)),
    ("ray", "processors on a Ray cluster", ("ray",)),
)

_EXTRA: Final = re.compile(r"\s*(?:\band\s+)?\bextra\s*==\s*[\"']([\w-]+)[\"']")


def install(
    parts: Annotated[list[str], typer.Argument(metavar="PART...", help="Such as vision; all: nearly all of them")],
    anew: Annotated[bool, typer.Option("--anew", help="Reinstall existing packages too, to repair them")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only show what would be installed")] = False,
) -> None:
    """Install optional parts of Skyloop into the Python environment that runs this command.

    skyloop doctor lists all parts and says which of them are missing.
    """
    wanted = requirements(parts)
    if dry_run:
        for requirement in wanted:
            typer.echo(requirement)
        return
    if subprocess.run([*_installer(anew), *wanted]).returncode:
        raise SkyloopError(f"{', '.join(parts)} can't be installed: see above")


def requirements(parts: Iterable[str]) -> list[str]:
    """Return the requirements of optional parts in pip's syntax.

    Raise ``UnknownNameError`` if there is no part with this name, and ``SkyloopError`` if Skyloop's own metadata is
    missing because Skyloop runs from a folder without having been installed.
    """
    table: dict[str, list[str]] = {}
    for line in _metadata():
        requirement, _, marker = line.partition(";")
        for extra in _EXTRA.findall(marker):
            rest = _EXTRA.sub("", marker).strip()
            table.setdefault(extra, []).append(f"{requirement.strip()}; {rest}" if rest else requirement.strip())
    found: dict[str, None] = {}
    for part in parts:
        if part not in table:
            raise UnknownNameError("optional part", part, table)
        found |= dict.fromkeys(table[part])
    return list(found)


def _metadata() -> list[str]:
    try:
        return requires("skyloop") or []
    except ModuleNotFoundError:
        raise SkyloopError(
            "this Skyloop runs from a folder and was never installed: run pip install -e FOLDER, then try again"
        ) from None


def _installer(anew: bool) -> list[str]:
    """Return the command that installs packages into this environment: the environment's pip or, if it has none, uv."""
    if importlib.util.find_spec("pip"):
        return [sys.executable, "-m", "pip", "install", *(["--force-reinstall"] if anew else [])]
    if shutil.which("uv"):
        return ["uv", "pip", "install", "--python", sys.executable, *(["--reinstall"] if anew else [])]
    raise UnsupportedError(f"{sys.prefix} has no pip, and there is no uv: install the list of --dry-run by other means")


def missing(parts: Iterable[str]) -> Iterator[str]:
    """Yield the parts that are not installed."""
    modules = {extra: needed for extra, _, needed in EXTRAS}
    for part in parts:
        if not all(map(_is_there, modules.get(part, ()))):
            yield part


def _is_there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the module's parent package is missing
        return False


def with_all_missing(text: str, parts: Iterable[str]) -> str:
    """Extend an error about one missing part so that it names all of ``parts`` that are missing."""
    before, command, first = text.rpartition(install_command(""))
    return before + command + " ".join((first, *(part for part in missing(parts) if part != first)))
