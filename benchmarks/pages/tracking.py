"""Put measured trackers into ``docs/tracking.md``: its tables and its picture come from JSON alone.

``python -m benchmarks.pages.tracking`` makes them from ``docs/measured``; with a folder it first takes new results from
the output of ``python -m benchmarks.tracking --output FOLDER``.
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
    """Return the content of the page's marked places."""
    return {
        "machine": f"{results.machine}.",
        "trackers": table(results).markdown(),
        "scores": score_table(results).markdown(),
    }


if __name__ == "__main__":
    main()
