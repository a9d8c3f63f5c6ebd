"""Put measured delays into ``docs/delays.md``: its tables and pictures come from JSON alone.

``python -m benchmarks.pages.delays`` makes them from ``docs/measured``; with a folder it first takes new results from
the output of ``skyloop bench … --output FOLDER`` and ``python -m benchmarks.… --output FOLDER``: any of
``delays.json``, ``load.json`` and ``loop.json``. Pictures are redrawn unless the new results have no ``delays.json``.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from benchmarks import load
from benchmarks import tables as load_tables
from benchmarks.measuring import delays, loop, tables
from benchmarks.measuring.figures import draw
from benchmarks.measuring.targets import judge_delays
from benchmarks.pages.fill import fill
from benchmarks.targets import judge_load

DOCS = Path(__file__).parents[2] / "docs"
MEASURED = DOCS / "measured"
PAGE = DOCS / "delays.md"
IDLE_LOAD = 0.5  # load average
FILES = ("delays.json", "load.json", "loop.json")


def main() -> None:
    if len(sys.argv) > 2:
        sys.exit(f"usage: {sys.argv[0]} [FOLDER]")
    taken = take(Path(sys.argv[1])) if len(sys.argv) == 2 else list(FILES)
    PAGE.write_text(fill(PAGE.read_text(), blocks(MEASURED)))
    if "delays.json" in taken:
        for file in draw(delays.load(MEASURED / "delays.json"), DOCS / "pictures"):
            print(file)


def take(folder: Path) -> list[str]:
    """Store the results of a run beside the page; return their names."""
    found = [folder / name for name in FILES if (folder / name).exists()]
    if not found:
        sys.exit(f"{folder} holds none of {', '.join(FILES)}")
    MEASURED.mkdir(exist_ok=True)
    for file in found:
        shutil.copy(file, MEASURED)
    return [file.name for file in found]


def blocks(folder: Path) -> dict[str, str]:
    """Return the content of the page's marked places."""
    experiment = delays.load(folder / "delays.json")
    crowd = load.load(folder / "load.json")
    trips = loop.load(folder / "loop.json")
    missed = [verdict for verdict in (*judge_delays(experiment), *judge_load(crowd)) if not verdict.held]
    return {
        "machine": machine(experiment),
        "paper": tables.paper_table(experiment).markdown(),
        "comparison": tables.comparison_table(experiment).markdown(),
        "targets": tables.verdict_table(missed).markdown(),
        "load": load_tables.load_table(crowd).markdown(),
        "loop": tables.loop_table(trips).markdown(),
    }


def machine(results: delays.Delays) -> str:
    """Return a sentence on the machine and the duration, with a warning if the machine was shared."""
    where = results.machine
    packages = ", ".join(f"{name} {version}" for name, version in where.packages.items())
    text = f"{where} ({packages}); {results.seconds:g} s for each contender with each size."
    if where.load is None or where.load > IDLE_LOAD:
        text += "\n\n**The machine had other work at the same time**: the medians are meaningful, the tails less so."
    return text


if __name__ == "__main__":
    main()
