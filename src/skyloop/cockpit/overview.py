"""The row that pages show of each drone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from skyloop.cockpit.beat import Beat
from skyloop.cockpit.telemetry import encode_json

if TYPE_CHECKING:
    from skyloop.cockpit.fleet import Fleet
    from skyloop.cockpit.recordings import Recordings

PERIOD_S: Final = 0.5


class Overview:
    """All drones, made twice a second for all pages."""

    def __init__(self, fleet: Fleet, recordings: Recordings, period_s: float = PERIOD_S) -> None:
        self._fleet = fleet
        self._recordings = recordings
        self.beat = Beat(period_s, self._make, lambda _: None)

    def rows(self) -> list[dict[str, Any]]:
        """By name; those that were found and did not answer, too."""
        recorded = self._recordings.drones()
        rows = []
        for name, station in self._fleet.stations.items():
            replay = name in self._recordings.replays
            rows.append({**station.view.overview(), "recording": name in recorded, "replay": replay})
        for name, problem in self._fleet.problems.items():
            rows.append(_silent(name, problem))
        return sorted(rows, key=lambda row: str(row["name"]))

    def _make(self) -> bytes:
        return encode_json({"type": "overview", "drones": self.rows()})


def _silent(name: str, problem: str) -> dict[str, Any]:
    unknown = ("battery", "position", "altitude", "yaw", "owner")
    return {
        "name": name,
        "uri": "",
        "vehicle": "",
        "transport": "",
        "state": "unknown",
        "airborne": False,
        "can_fly": False,
        "why_not": problem,
        "cameras": [],
        "me": False,
        "links": {"application": "lost", "vehicle": "connecting", "reason": problem},
        "alarms": [problem],
        "recording": False,
        "replay": False,
        **dict.fromkeys(unknown),
    }
