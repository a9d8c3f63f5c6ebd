"""Put a flight of ``python -m benchmarks.paper`` into ``docs/paper.md``: ``python -m benchmarks.pages.paper FOLDER``.

The page's tables are made from ``docs/measured/paper.json``, the flight's ``results.json`` without the single samples.
Its pictures are those of the flight. Without a folder, only the tables are made again.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import msgspec

from benchmarks.pages.fill import fill
from benchmarks.paper import report
from benchmarks.paper.evaluation import Experiment, Way, load

DOCS = Path(__file__).parents[2] / "docs"
MEASURED = DOCS / "measured" / "paper.json"
PAGE = DOCS / "paper.md"


def main() -> None:
    if len(sys.argv) > 2:
        sys.exit(f"usage: {sys.argv[0]} [FOLDER]")
    if len(sys.argv) == 2:
        take(Path(sys.argv[1]))
    PAGE.write_text(fill(PAGE.read_text(), blocks(load(MEASURED))))


def take(folder: Path) -> None:
    """Store the figures and the pictures of a flight."""
    found = load(folder / "results.json")
    delays = msgspec.structs.replace(found.delays, series=[])
    found = msgspec.structs.replace(found, delays=delays, way=Way([], [], [], [], []))
    MEASURED.write_bytes(msgspec.json.format(msgspec.json.encode(found)) + b"\n")
    for name in report.PICTURES:
        shutil.copy(folder / f"{name}.png", DOCS / "pictures" / f"paper-{name}.png")


def blocks(results: Experiment) -> dict[str, str]:
    """Return the content of the page's marked places."""
    return {
        "machine": machine(results),
        "delays": report.delay_table(results).markdown(),
        "recorder": report.recorder_table(results).markdown(),
        "path": report.path_table(results).markdown(),
    }


def machine(results: Experiment) -> str:
    """Return a sentence on the machine, the duration and the load of the flight."""
    waypoints = 0 if results.tracking is None else results.tracking.waypoints
    text = f"{results.delays.machine}; {results.seconds:.0f} s, {waypoints} waypoints, seed 0."
    if results.load is not None and results.load > results.delays.machine.cores:
        text += (
            f" **The machine was shared**: {results.load:.1f} processes wanted one of its cores at the flight's end. "
            "Means, deviations and maxima are those of waiting for a processor; the medians say more."
        )
    return text


if __name__ == "__main__":
    main()
