"""Targets for the delays with other applications connected, and checks of a run against them."""

from __future__ import annotations

from typing import Final

from benchmarks.load import (
    ALONE,
    FULL,
    KILLED,
    RECORDED,
    RECORDED_PERIOD_S,
    STUCK_AMONG,
    Load,
    observers_name,
    pages_name,
)
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, MIDDLE, VIDEO
from benchmarks.measuring.targets import Verdict

MOST_OBSERVERS: Final = 32
OBSERVED_P99: Final = 2.0  #: ratio of the pilot's command delay with that many observers to that with none
MOST_PAGES: Final = 10
PAGED_P99: Final = 1.5  #: ratio of the pilot's command delay with that many cockpit pages to that with none
RECORDED_MEDIAN: Final = 1.1  #: ratio of the pilot's command delay with a recorder to that with none
STUCK_MEDIAN: Final = 1.1  #: ratio of the other observers' feedback delay with one stopped to that with none


def judge_load(results: Load) -> list[Verdict]:
    """Return the verdicts on the targets for which this run has all figures."""
    verdicts = []
    alone = results.case(ALONE)
    crowd = results.case(observers_name(MOST_OBSERVERS))
    if alone and crowd:
        figure = crowd.channels[COMMAND].p99_us / alone.channels[COMMAND].p99_us
        verdicts.append(
            Verdict(f"command: 99th percentile with {MOST_OBSERVERS} observers to none", figure, OBSERVED_P99)
        )
    going = results.case(observers_name(STUCK_AMONG))
    stuck = results.case(observers_name(STUCK_AMONG, stuck=True))
    if going and stuck:
        for channel in (COMMAND, f"{FEEDBACK}, observers", f"{VIDEO}, observers"):
            figure = stuck.channels[channel].median_us / going.channels[channel].median_us
            verdicts.append(Verdict(f"{channel}: median with one observer stopped to none", figure, STUCK_MEDIAN))
    return [*verdicts, *_judge_pages(results), *_judge_recorder(results)]


def _judge_pages(results: Load) -> list[Verdict]:
    none, paged = results.case(ALONE, MIDDLE), results.case(pages_name(MOST_PAGES), MIDDLE)
    if not none or not paged:
        return []
    figure = paged.channels[COMMAND].p99_us / none.channels[COMMAND].p99_us
    return [Verdict(f"command: 99th percentile with {pages_name(MOST_PAGES)} to none", figure, PAGED_P99)]


def _judge_recorder(results: Load) -> list[Verdict]:
    verdicts = []
    quiet = results.case(ALONE, MIDDLE, RECORDED_PERIOD_S)
    for name in (RECORDED, KILLED, FULL):
        recorded = results.case(name, MIDDLE, RECORDED_PERIOD_S)
        if name == FULL and recorded and not recorded.recorder_stopped:
            continue  # its disk had enough space
        if quiet and recorded:
            figure = recorded.channels[COMMAND].median_us / quiet.channels[COMMAND].median_us
            verdicts.append(Verdict(f"command: median with a {name} to none", figure, RECORDED_MEDIAN))
            if recorded.recorder_lost is not None and name == RECORDED:
                lost = sum(recorded.recorder_lost.values())
                verdicts.append(Verdict("samples that the recorder lost", lost, 0))
    return verdicts
