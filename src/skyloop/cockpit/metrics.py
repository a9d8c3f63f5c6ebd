"""What the cockpit knows of its connections, as metrics. Read on the endpoint's thread."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

from skyloop.metrics.catalogue import Reading
from skyloop.metrics.sources import client_readings

if TYPE_CHECKING:
    from skyloop.cockpit.fleet import Fleet
    from skyloop.cockpit.station import Station
    from skyloop.metrics.endpoint import Source


def fleet_sources(fleet: Fleet) -> list[Source]:
    """Return what there is to read of a fleet now: one source for each drone, and one for the fleet."""
    stations = fleet.stations.copy()
    return [partial(_fleet_readings, fleet), *(partial(_readings, name, one) for name, one in stations.items())]


def _fleet_readings(fleet: Fleet) -> Iterator[Reading]:
    yield Reading("skyloop_cockpit_unreachable", float(len(fleet.problems)))


def _readings(name: str, station: Station) -> Iterator[Reading]:
    yield Reading("skyloop_cockpit_pilots", float(len(station.pilots)), (name,))
    yield from client_readings(name, station.drone)
