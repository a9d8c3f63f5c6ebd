"""The results as tables, for the terminal and for the page. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

from skyloop.bench.delays import PAPER_MEAN_MS, Delays
from skyloop.bench.load import PARTS, CaseResult, Load
from skyloop.bench.loop import STAGES, TOTAL, Loop
from skyloop.bench.peers import FLOOR, OURS
from skyloop.bench.schedule import CHANNELS, COMMAND, FEEDBACK, SMALL, VIDEO
from skyloop.bench.statistics import Summary
from skyloop.bench.targets import Verdict

if TYPE_CHECKING:
    from skyloop.bench.codecs import CodecResults  # which needs the simulator's parts

UNKNOWN: Final = "–"


class Table(NamedTuple):
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """Without the title, which the page has in its own words."""
        lines = [self.columns, ["---"] * len(self.columns), *self.rows]
        return "\n".join("|---" * len(row) + "|" if row[0] == "---" else f"| {' | '.join(row)} |" for row in lines)


def paper_table(results: Delays) -> Table:
    """The paper's Table 1 with our figures and, where they are known, the paper's beside them."""
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
    """Everybody's medians, with the ratio to the floor's."""
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


def load_table(results: Load) -> Table:
    """The delays in every case: the pilot's, and the age of frames at the others."""
    rows = [
        [
            case.case,
            f"{case.size}, {case.frames_per_s:.0f}/s",
            *(_pair(case.channels.get(channel)) for channel in (COMMAND, FEEDBACK, VIDEO)),
            _others(case),
        ]
        for case in results.cases
    ]
    rows += [[name, f"left out: {why}", *[""] * 4] for name, why in results.skipped.items()]
    columns = ["beside the pilot", "frames", "command", "feedback", "age of frames", "at the others"]
    return Table("The pilot's delays in µs: median (99th percentile)", columns, rows)


def cpu_table(results: Load) -> Table:
    """What each part of a case takes of the processor."""
    rows = [
        [case.case, f"{case.size}, {case.frames_per_s:.0f}/s", *(_share(case.cpu.get(part)) for part in PARTS)]
        for case in results.cases
    ]
    return Table("Processor time, in percent of one core", ["beside the pilot", "frames", *PARTS], rows)


def loop_table(results: Loop) -> Table:
    """The stages, each with all sizes."""
    rows = [
        [name, words, *(_pair(size.stages[name]) for size in results.sizes)]
        for name, words in (*STAGES.items(), (TOTAL, "from the capture to the driver"))
    ]
    return Table(
        "From the capture to the command that it caused, in µs: median (99th percentile)",
        ["stage", "until", *(size.size for size in results.sizes)],
        rows,
    )


def codecs_table(results: CodecResults) -> Table:
    """What each kind of work takes of the processor."""
    rows = [
        [
            row.what,
            row.of,
            f"{row.size / 1e3:.1f} kB",
            f"{_ms(row.once.median_us)} ({_ms(row.once.p99_us)})",
            f"{row.per_s:.0f}",
            "" if row.target is None else f"≥ {row.target:g}",
        ]
        for row in results.rows
    ]
    rows += [[name, f"left out: {why}", *[""] * 4] for name, why in results.skipped.items()]
    columns = ["work", "of", "encoded", "time", "a second on one core", "target"]
    return Table("Processor time in ms for one: median (99th percentile)", columns, rows)


def verdict_table(verdicts: Sequence[Verdict]) -> Table:
    """The targets."""
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


def _others(case: CaseResult) -> str:
    found = [summary for name, summary in case.channels.items() if name.startswith(f"{VIDEO},")]
    return _pair(found[0]) if found else ""


def _against(summary: Summary | None, floor: Summary | None) -> str:
    if summary is None:
        return UNKNOWN
    ratio = "" if floor is None or floor is summary else f" {summary.median_us / floor.median_us:.1f}×"
    return _pair(summary) + ratio


def _pair(summary: Summary | None) -> str:
    return UNKNOWN if summary is None else f"{summary.median_us:.0f} ({summary.p99_us:.0f})"


def _share(cores: float | None) -> str:
    return UNKNOWN if cores is None else f"{100 * cores:.1f}"


def _ms(us: float) -> str:
    return f"{us / 1e3:.3f}"
