"""Targets for the delays, and checks of a run against them."""

from __future__ import annotations

from typing import Final, NamedTuple

from benchmarks.measuring.contenders import FLOOR, OURS
from benchmarks.measuring.delays import Delays
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, LARGE, SMALL, VIDEO, Size
from benchmarks.measuring.statistics import Summary

#: Maximum ratio of Skyloop's median to the floor's, by frame size and channel.
FLOOR_MEDIAN: Final = {(SMALL, COMMAND): 1.4, (SMALL, FEEDBACK): 1.4, (SMALL, VIDEO): 1.4, (LARGE, VIDEO): 1.1}
#: Maximum ratio of Skyloop's 99th percentile to the floor's.
FLOOR_P99: Final = {(SMALL, COMMAND): 2.0, (SMALL, FEEDBACK): 2.0, (SMALL, VIDEO): 2.0, (LARGE, VIDEO): 2.0}
#: Minimum ratio of rclpy's median to Skyloop's.
ROS_MEDIAN: Final = {(SMALL, COMMAND): 5.0, (SMALL, FEEDBACK): 5.0, (SMALL, VIDEO): 8.0, (LARGE, VIDEO): 30.0}
#: Minimum ratio of ZeroMQ's median to Skyloop's.
ZEROMQ_MEDIAN: Final = {(SMALL, COMMAND): 1.0}


class Verdict(NamedTuple):
    """One target, and the measured figure."""

    what: str
    figure: float
    limit: float
    at_least: bool = False

    @property
    def held(self) -> bool:
        """Whether the figure meets the target."""
        return self.figure >= self.limit if self.at_least else self.figure <= self.limit


def judge_delays(results: Delays) -> list[Verdict]:
    """Return the verdicts on the targets for which this run has both figures."""

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
    for peer, title, limits in (("ros2", "rclpy", ROS_MEDIAN), ("zeromq", "ZeroMQ", ZEROMQ_MEDIAN)):
        for (size, channel), limit in limits.items():
            if found := pair(size, channel, peer):
                figure, what = (
                    found[1].median_us / found[0].median_us,
                    f"{_name(size, channel)}: {title}'s median to ours",
                )
                verdicts.append(Verdict(what, figure, limit, at_least=True))
    return verdicts


def _name(size: Size, channel: str) -> str:
    return f"{channel} {size}" if channel == VIDEO else channel
