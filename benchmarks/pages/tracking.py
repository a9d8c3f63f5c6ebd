"""Puts measured trackers into ``docs/tracking.md``: its tables and its picture are made from JSON and nothing else.

``python -m benchmarks.pages.tracking`` makes them anew from ``docs/measured``; with a folder it takes new results from
what ``python -m benchmarks.tracking --output FOLDER`` wrote.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from benchmarks.pages.fill import fill
from benchmarks.tracking import TrackingResults, draw, score_table, table
from skyloop.files import read_json

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "tracking.md"
MEASURED = DOCS / "measured" / "tracking.json"
_MOST_BYTES = 1_000_000


def main() -> None:
    if len(sys.argv) > 2:
        sys.exit(f"usage: {sys.argv[0]} [FOLDER]")
    if len(sys.argv) == 2:
        shutil.copy(Path(sys.argv[1]) / MEASURED.name, MEASURED)
    results = read_json(MEASURED, TrackingResults, "the results of benchmarks.tracking", _MOST_BYTES)
    PAGE.write_text(fill(PAGE.read_text(), blocks(results)))
    draw(results, DOCS / "pictures" / "tracking.png")


def blocks(results: TrackingResults) -> dict[str, str]:
    """Return what belongs into the marked places of the page."""
    return {
        "machine": f"{results.machine}.",
        "trackers": table(results).markdown(),
        "scores": score_table(results).markdown(),
    }


if __name__ == "__main__":
    main()
