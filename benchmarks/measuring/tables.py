"""The measured delays as tables, for the terminal and for the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from benchmarks.measuring.contenders import FLOOR, OURS
from benchmarks.measuring.delays import PAPER_MEAN_MS, Delays
from benchmarks.measuring.loop import STAGES, TOTAL, Loop
from benchmarks.measuring.schedule import CHANNELS, SMALL, VIDEO
from benchmarks.measuring.statistics import Summary
from benchmarks.measuring.targets import Verdict

UNKNOWN: Final = "–"


class Table(NamedTuple):
    """A table of text."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """Return the table as Markdown, without the title, which the page words differently."""
        lines = [self.columns, ["---"] * len(self.columns), *self.rows]
        return "\n".join("|---" * len(row) + "|" if row[0] == "---" else f"| {' | '.join(row)} |" for row in lines)


def paper_table(results: Delays) -> Table:
    """Return the paper's Table 1 with our figures and, where known, the paper's beside them."""
    size = results.sizes[0]
    names, columns = [], []
    for channel in CHANNELS:
        found = results.summary(OURS.name, size, channel)
        if found is not None:
            names.append(f"{channel} {size}" if channel == VIDEO else channel)
            paper_ms = None if channel == VIDEO and size != str(SMALL) else PAPER_MEAN_MS[channel]
            columns.append(_paper_column(found, paper_ms))
    rows = [[word, *cells] for word, *cells in zip(_PAPER_ROWS, *columns, strict=True)]
    return Table("Delays in ms, as in the paper's Table 1", ["", *names], rows)


_PAPER_ROWS: Final = (
    *("mean (of the period)", "the paper's mean", "minimum", "maximum", "median", "99th percentile"),
    *("99.9th percentile", "samples", "lost", "share under 1 % of the period"),
)


def _paper_column(found: Summary, paper_ms: float | None) -> list[str]:
    return [
        f"{_ms(found.mean_us)} ({found.mean_of_period:.2%})",
        UNKNOWN if paper_ms is None else f"{paper_ms:.3f} ({paper_ms / found.period_ms:.2%})",
        *(_ms(us) for us in (found.minimum_us, found.maximum_us, found.median_us, found.p99_us, found.p999_us)),
        str(found.samples),
        str(found.lost),
        f"{found.under_1_percent:.1%}",
    ]


def comparison_table(results: Delays) -> Table:
    """Return the medians of all contenders, with their ratio to the floor's median."""
    rows = []
    for size in results.sizes:
        for name, title in results.contenders.items():
            version = results.versions.get(name, "")
            cells = [
                _against(results.summary(name, size, channel), results.summary(FLOOR.name, size, channel))
                for channel in CHANNELS
            ]
            rows.append([size, f"{title} {version}".strip(), *cells])
    title = "Delays in µs: median (99th percentile), and the median to the floor's"
    return Table(title, ["frames", "", *CHANNELS], rows)


def loop_table(results: Loop) -> Table:
    """Return a row for each stage, with all frame sizes."""
    rows = [
        [name, words, *(median_and_p99(size.stages[name]) for size in results.sizes)]
        for name, words in (*STAGES.items(), (TOTAL, "from the capture to the driver"))
    ]
    return Table(
        "From the capture to the command that it caused, in µs: median (99th percentile)",
        ["stage", "until", *(size.size for size in results.sizes)],
        rows,
    )


def verdict_table(verdicts: Sequence[Verdict]) -> Table:
    """Return the targets, and whether they were met."""
    rows = [
        [
            verdict.what,
            f"{verdict.figure:.2f}",
            f"{'≥' if verdict.at_least else '≤'} {verdict.limit:g}",
            "yes" if verdict.held else "no",
        ]
        for verdict in verdicts
    ]
    return Table("Targets", ["what", "measured", "target", "held"], rows)


def _against(summary: Summary | None, floor: Summary | None) -> str:
    if summary is None:
        return UNKNOWN
    ratio = "" if floor is None or floor is summary else f" {summary.median_us / floor.median_us:.1f}×"
    return median_and_p99(summary) + ratio


def median_and_p99(summary: Summary | None) -> str:
    """Return both as text in µs, the second in parentheses."""
    return UNKNOWN if summary is None else f"{summary.median_us:.0f} ({summary.p99_us:.0f})"


def _ms(us: float) -> str:
    return f"{us / 1e3:.3f}"
