"""What the project holds itself to, and whether a run kept it. Pure."""

from __future__ import annotations

from typing import Final, NamedTuple

from skyloop.bench.delays import Delays
from skyloop.bench.load import (
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
from skyloop.bench.peers import FLOOR, OURS
from skyloop.bench.schedule import COMMAND, FEEDBACK, LARGE, MIDDLE, SMALL, VIDEO, Size
from skyloop.bench.statistics import Summary

#: Medians, Skyloop's to the floor's, at most; by size of the frames and channel.
FLOOR_MEDIAN: Final = {(SMALL, COMMAND): 1.3, (SMALL, FEEDBACK): 1.3, (SMALL, VIDEO): 1.5, (LARGE, VIDEO): 1.5}
#: 99th percentiles, Skyloop's to the floor's, at most.
FLOOR_P99: Final = {(SMALL, COMMAND): 2.0, (SMALL, FEEDBACK): 2.0}
#: Medians, rclpy's to Skyloop's, at least.
ROS_MEDIAN: Final = {(SMALL, COMMAND): 5.0, (SMALL, FEEDBACK): 5.0, (SMALL, VIDEO): 8.0, (LARGE, VIDEO): 30.0}
MOST_OBSERVERS: Final = 32
OBSERVED_P99: Final = 2.0  #: the pilot's command, with that many observers to none
MOST_PAGES: Final = 10
PAGED_P99: Final = 1.5  #: the pilot's command, with that many pages of a cockpit to none
RECORDED_MEDIAN: Final = 1.1  #: the pilot's command, with a recorder to none
STUCK_MEDIAN: Final = 1.1  #: feedback of the observers that go on, with one stopped to none: as good as nothing


class Verdict(NamedTuple):
    """One target."""

    what: str
    figure: float
    limit: float
    at_least: bool = False

    @property
    def held(self) -> bool:
        return self.figure >= self.limit if self.at_least else self.figure <= self.limit


def judge_delays(results: Delays) -> list[Verdict]:
    """The targets of which this run has both figures."""

    def pair(size: Size, channel: str, other: str) -> tuple[Summary, Summary] | None:
        ours = results.summary(OURS.name, str(size), channel)
        theirs = results.summary(other, str(size), channel)
        return None if ours is None or theirs is None else (ours, theirs)

    verdicts = []
    for (size, channel), limit in FLOOR_MEDIAN.items():
        if found := pair(size, channel, FLOOR.name):
            figure = found[0].median_us / found[1].median_us
            verdicts.append(Verdict(f"{_name(size, channel)}: median to the floor's", figure, limit))
    for (size, channel), limit in FLOOR_P99.items():
        if found := pair(size, channel, FLOOR.name):
            figure = found[0].p99_us / found[1].p99_us
            verdicts.append(Verdict(f"{_name(size, channel)}: 99th percentile to the floor's", figure, limit))
    for (size, channel), limit in ROS_MEDIAN.items():
        if found := pair(size, channel, "ros2"):
            figure = found[1].median_us / found[0].median_us
            verdicts.append(Verdict(f"{_name(size, channel)}: rclpy's median to ours", figure, limit, at_least=True))
    return verdicts


def judge_load(results: Load) -> list[Verdict]:
    """The targets of which this run has all figures."""
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
            continue  # its disk had room for all
        if quiet and recorded:
            figure = recorded.channels[COMMAND].median_us / quiet.channels[COMMAND].median_us
            verdicts.append(Verdict(f"command: median with a {name} to none", figure, RECORDED_MEDIAN))
            if recorded.recorder_lost is not None and name == RECORDED:
                lost = sum(recorded.recorder_lost.values())
                verdicts.append(Verdict("samples that the recorder lost", lost, 0))
    return verdicts


def _name(size: Size, channel: str) -> str:
    return f"{channel} {size}" if channel == VIDEO else channel
