"""Put measurements over the network into ``docs/network-loss.md`` and ``docs/scale.md``, from JSON alone.

``python -m benchmarks.pages.network`` makes their tables from ``docs/measured``; with a folder it first takes new
results from the output of ``python -m benchmarks.… --output FOLDER``: any of ``network.json``, ``scale.json`` and
``swarm.json``.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from benchmarks import network, scale, swarm, tables, units
from benchmarks.pages.fill import fill
from benchmarks.scale_figure import SERIES, draw
from benchmarks.units import Fleet
from skyloop.bench import Machine

DOCS = Path(__file__).parents[2] / "docs"
MEASURED = DOCS / "measured"
LOSS_PAGE, SCALE_PAGE = DOCS / "network-loss.md", DOCS / "scale.md"
IDLE_LOAD = 0.5  # load average
SWARMS = ("swarm-1.json", "swarm-3.json")


def main() -> None:
    if len(sys.argv) > 2:
        sys.exit(f"usage: {sys.argv[0]} [FOLDER]")
    if len(sys.argv) == 2:
        take(Path(sys.argv[1]))
    LOSS_PAGE.write_text(fill(LOSS_PAGE.read_text(), loss_blocks(MEASURED)))
    SCALE_PAGE.write_text(fill(SCALE_PAGE.read_text(), scale_blocks(MEASURED)))
    for file in draw(scale.load(MEASURED / "scale.json"), DOCS / "pictures"):
        print(file)


def take(folder: Path) -> None:
    """Store the results of a run beside the pages; a swarm's under the number of its users."""
    found = [folder / name for name in ("network.json", "scale.json", "swarm.json") if (folder / name).exists()]
    if not found:
        sys.exit(f"{folder} holds none of network.json, scale.json and swarm.json")
    for file in found:
        name = f"swarm-{swarm.load(file).users}.json" if file.name == "swarm.json" else file.name
        shutil.copy(file, MEASURED / name)


def loss_blocks(folder: Path) -> dict[str, str]:
    results = network.load(folder / "network.json")
    runs = [swarm.load(folder / name) for name in SWARMS]
    return {
        "machine": machine(results.machine, results.seconds),
        "network": tables.network_table(results).markdown(),
        "swarm": tables.swarm_table(runs).markdown(),
    }


def scale_blocks(folder: Path) -> dict[str, str]:
    results = scale.load(folder / "scale.json")
    costs = units.derive(results, network.load(folder / "network.json"))
    fleet = Fleet()
    return {
        "machine": machine(results.machine, results.seconds),
        **{many: tables.scale_table(results, many).markdown() for many in SERIES},
        "bend": " ".join(tables.bend_text(results, many) for many in SERIES),
        "units": tables.units_table(costs).markdown(),
        "needs": tables.needs_table(fleet, units.needs(fleet, costs)).markdown(),
    }


def machine(where: Machine, seconds: float) -> str:
    """Return a sentence on the machine and the duration, with a warning if the machine was shared."""
    text = f"{where}; {seconds:g} s for each case."
    if where.load is None or where.load > IDLE_LOAD:
        text += "\n\n**The machine had other work at the same time**: the medians are meaningful, the tails less so."
    return text


if __name__ == "__main__":
    main()
