"""The report at the end of the demo: how well the marker was followed, and how long everything took on its way."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rich.table import Table

from skyloop.clock import nanoseconds
from skyloop.messages import Feedback, Value

if TYPE_CHECKING:
    from skyloop.client import ChannelStats, Drone
    from skyloop.control.follow import FollowMarker, FollowScore

#: Where a simulated vehicle's native telemetry has its own true place and that of the board, in world axes [m].
OWN_PLACE = ("truth.x", "truth.y", "truth.z")
BOARD_PLACE = ("truth.target.x", "truth.target.y", "truth.target.z")
SETTLING_S = 5.0  # after the first sighting the vehicle is still on its way to the marker


@dataclass(frozen=True, slots=True)
class Spread:
    """Errors of a range [m]."""

    rms: float
    mean: float
    worst: float
    count: int

    @classmethod
    def of(cls, errors: list[float]) -> Spread | None:
        """None of none."""
        if not errors:
            return None
        n = len(errors)
        return cls(math.sqrt(sum(e * e for e in errors) / n), sum(errors) / n, max(map(abs, errors)), n)

    def __str__(self) -> str:
        return f"RMS {self.rms:.3f} m, mean {self.mean:+.3f} m, worst {self.worst:.2f} m"


def true_range(native: dict[str, Value] | None) -> float | None:
    """Return the true distance from the vehicle's centre to the carried board's [m].

    Args:
        native: A simulated vehicle's telemetry.

    Returns:
        None where it is not known.
    """
    if native is None:
        return None
    places = [[native.get(name) for name in names] for names in (OWN_PLACE, BOARD_PLACE)]
    own, board = [[float(value) for value in place if isinstance(value, (int, float))] for place in places]
    return math.dist(own, board) if len(own) == len(board) == 3 else None


class TruthMeter:
    """Compares the true distance with the wanted one while the marker is followed.

    It does so for as long as its ``with`` block lasts.

    Args:
        drone: Simulated; its telemetry has the truth.
        follower: Flies it.
    """

    def __init__(self, drone: Drone, follower: FollowMarker) -> None:
        self.errors_m: list[float] = []
        self._follower = follower
        self._listener = drone.on_feedback(self._look)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._listener.cancel()

    def _look(self, feedback: Feedback) -> None:
        first_ns = self._follower.score.first_seen_ns
        distance = true_range(feedback.native)
        if first_ns is None or distance is None or feedback.captured_ns - first_ns < nanoseconds(SETTLING_S):
            return
        self.errors_m.append(distance - self._follower.distance_m)


@dataclass(slots=True)
class DemoReport:
    """The figures, and how they look."""

    first_picture_s: float | None = None  #: from the start of the demo
    frames: int = 0  #: since the marker was first seen
    share_in_view: float | None = None
    estimated: Spread | None = None
    true: Spread | None = None
    channels: dict[str, ChannelStats] = field(default_factory=dict)
    page: dict[str, Any] | None = None
    collisions: int = 0

    def take(self, drone: Drone, score: FollowScore, truth: TruthMeter, page: dict[str, Any] | None) -> None:
        """Note everything that must be asked while the drone is connected."""
        self.frames = score.frames
        self.share_in_view = score.share_in_view
        self.estimated = Spread.of(score.range_errors_m(SETTLING_S))
        self.true = Spread.of(truth.errors_m)
        self.channels = dict(drone.stats)
        self.page = page

    def good(self, enough: float) -> bool:
        """Return whether the marker was found, and in view for at least this share of the frames since."""
        return self.share_in_view is not None and self.share_in_view >= enough

    def verdict(self, enough: float) -> str:
        """Return why it was not good."""
        if self.share_in_view is None:
            return "the marker was never seen"
        return f"the marker was in view in {self.share_in_view:.1%} of the frames, less than {enough:.0%}"

    def table(self) -> Table:
        """Return the figures for the terminal."""
        table = Table(title="The flight", title_justify="left", show_header=False, box=None)
        seen = "never seen" if self.share_in_view is None else f"{self.share_in_view:.1%} of {self.frames} frames"
        rows = [
            ("marker in view since first seen", seen),
            ("range error, by the camera", _spread_text(self.estimated)),
            ("range error, truly", _spread_text(self.true)),
            ("collisions", str(self.collisions)),
            ("first frame after", "–" if self.first_picture_s is None else f"{self.first_picture_s:.1f} s"),
        ]
        for name, channel in self.channels.items():
            rows += channel_rows(name, channel)
        if self.page is not None:
            sent, skipped = self.page["frames_sent"], self.page["frames_skipped"]
            rows.append(("page", f"{sent} frames sent, {skipped} left out for slower browsers"))
        for row in rows:
            table.add_row(*row)
        return table


def _spread_text(spread: Spread | None) -> str:
    return "not known" if spread is None else f"{spread} (after the first {SETTLING_S:g} s)"


def channel_rows(name: str, channel: ChannelStats) -> list[tuple[str, str]]:
    """Return the row of a channel; none for one that nothing came by."""
    if not channel.count:
        return []
    text = f"{channel.count} {'sent' if name == 'command' else 'received'}, {channel.lost} lost"
    text += f", {channel.dropped} dropped"
    if channel.delay_s is not None:
        text += f"; delay median {channel.delay_s.median * 1e3:.2f} ms, p99 {channel.delay_s.p99 * 1e3:.2f} ms"
    return [(name, text)]
