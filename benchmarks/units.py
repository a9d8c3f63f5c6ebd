"""Derive the cost of each sample from ``benchmarks.scale`` and ``network``, and the needs of a fleet from that."""

from __future__ import annotations

import math
from typing import Final

import msgspec

from benchmarks.measuring.schedule import PACKET_PERIOD_S
from benchmarks.network import Network
from benchmarks.scale import FRAME_PERIOD_S, OBSERVED, Case, Scale
from skyloop.errors import UsageError

_PACKETS_PER_S: Final = 1 / PACKET_PERIOD_S
_FRAMES_PER_S: Final = 1 / FRAME_PERIOD_S
_MB: Final = 1e6


class Units(msgspec.Struct, frozen=True):
    """Processor time in µs, memory in MB, bytes on the wire."""

    proxy_us_per_s: float  #: of a proxy with a pilot, per second, including commands and feedback to the pilot
    pilot_us_per_s: float  #: of a pilot, per second and drone
    feedback_sent_us: float  #: by a proxy, for each further observer
    feedback_received_us: float  #: by an observer's process, including its other work
    jpeg_us: float  #: to encode one frame, once for all clients of one format
    frame_sent_us: float  #: by a proxy, for each observer
    frame_received_us: float  #: by an observer, including decoding
    feedback_routed_us: float  #: by a router, for each observer
    frame_routed_us: float
    proxy_mb: float
    observer_mb: float
    router_mb: float
    command_bytes: float
    feedback_bytes: float
    frame_bytes: float


def derive(scale: Scale, network: Network) -> Units:
    """Return the costs, as differences between cases.

    Differences of small figures can fall below zero on a busy machine; they are then reported as zero.

    Raises:
        UsageError: One of the cases is missing.
    """

    def cpu_us(case: Case, part: str) -> float:
        found = scale.case(case)
        if found is None:
            raise UsageError(
                f"the case {case.name!r} was not measured: {scale.skipped.get(case.name, 'it is missing')}"
            )
        return found.cpu.get(part, 0.0) * 1e6

    def memory_mb(case: Case, part: str) -> float:
        found = scale.case(case)
        return 0.0 if found is None else found.memory_mb.get(part, 0.0)

    if network.wire is None:
        raise UsageError("the bytes on the wire were not measured: run python -m benchmarks.network again")
    alone, watched = Case(1, 0, video=False), Case(1, OBSERVED, video=False)
    seen, routed = Case(1, OBSERVED), Case(1, OBSERVED, video=False, router=True)
    routed_video = Case(1, OBSERVED, router=True)
    packets, frames = OBSERVED * _PACKETS_PER_S, OBSERVED * _FRAMES_PER_S
    sent_us = (cpu_us(seen, "proxies") - cpu_us(watched, "proxies")) / frames - scale.jpeg_us / OBSERVED
    return Units(
        proxy_us_per_s=cpu_us(alone, "proxies"),
        pilot_us_per_s=cpu_us(alone, "pilot"),
        feedback_sent_us=max(0.0, (cpu_us(watched, "proxies") - cpu_us(alone, "proxies")) / packets),
        feedback_received_us=cpu_us(watched, "observers") / packets,
        jpeg_us=scale.jpeg_us,
        frame_sent_us=max(0.0, sent_us),
        frame_received_us=max(0.0, (cpu_us(seen, "observers") - cpu_us(watched, "observers")) / frames),
        feedback_routed_us=cpu_us(routed, "router") / packets,
        frame_routed_us=max(0.0, (cpu_us(routed_video, "router") - cpu_us(routed, "router")) / frames),
        proxy_mb=memory_mb(alone, "proxies"),
        observer_mb=memory_mb(seen, "observers"),
        router_mb=memory_mb(routed, "router"),
        command_bytes=network.wire.command,
        feedback_bytes=network.wire.feedback,
        frame_bytes=network.wire.frame,
    )


class Fleet(msgspec.Struct, frozen=True):
    """The connections of a fleet: each drone has a pilot and observers."""

    drones: int = 1000
    sites: int = 20  #: network segments with a router each, joined through a central router
    observers: int = 2  #: of each drone, for feedback; half of them at another site
    viewers: int = 1  #: observers of each drone that also get video
    frames_per_s: float = 10.0
    busy: float = 0.6  #: maximum use of a core


class Needs(msgspec.Struct, frozen=True):
    """The needs of a fleet. Bandwidths in Mbit/s."""

    proxy_cores: float  #: all proxies together
    pilot_cores: float
    observer_cores: float
    router_cores: float  #: of one site's router
    middle_cores: float  #: of the router in the middle
    drone_uplink: float  #: one proxy's link: feedback and video out
    drone_downlink: float  #: commands in
    site_link: float  #: between a site and the centre, the busier direction
    tokens: int  #: liveliness tokens: one per proxy, one per connection
    proxy_memory_gb: float
    observer_memory_gb: float
    cores: int  #: total, with none busier than allowed
    mesh_links: int  #: links if all connected to one another instead of their site's router


def needs(fleet: Fleet, units: Units) -> Needs:
    """Return the needs of a fleet, from the unit costs.

    Non-linear effects, such as a crowded machine's scheduler and caches, are not included. Proxies connect to their
    site's router, so each sends everything once, and the router distributes it. Pilots are at the site of their drone;
    half of the observers, and of the viewers among them, are at other sites.
    """
    site_drones = fleet.drones / fleet.sites
    away_observers, away_viewers = fleet.observers / 2, fleet.viewers / 2
    frame_rate = fleet.frames_per_s
    proxy_us = units.proxy_us_per_s + frame_rate * (units.jpeg_us + units.frame_sent_us)
    observer_us = _PACKETS_PER_S * units.feedback_received_us * fleet.observers
    observer_us += frame_rate * units.frame_received_us * fleet.viewers
    # For each drone: its command and its feedback to the pilot, and the observers' data, local or from the centre.
    routed_us = _PACKETS_PER_S * units.feedback_routed_us * (2 + fleet.observers)
    routed_us += frame_rate * units.frame_routed_us * fleet.viewers
    passed_us = _PACKETS_PER_S * units.feedback_routed_us * away_observers
    passed_us += frame_rate * units.frame_routed_us * away_viewers
    # A stream leaves a site once, and enters another once, for any number of receivers.
    leaving_bits = 8 * _PACKETS_PER_S * units.feedback_bytes * min(1.0, away_observers)
    leaving_bits += 8 * frame_rate * units.frame_bytes * min(1.0, away_viewers)
    feedback_bits, frame_bits = 8 * _PACKETS_PER_S * units.feedback_bytes, 8 * frame_rate * units.frame_bytes
    proxy_cores, pilot_cores = fleet.drones * proxy_us / 1e6, fleet.drones * units.pilot_us_per_s / 1e6
    observer_cores = fleet.drones * observer_us / 1e6
    router_cores = site_drones * (routed_us + passed_us) / 1e6
    middle_cores = fleet.drones * passed_us / 1e6
    every = proxy_cores + pilot_cores + observer_cores + fleet.sites * router_cores + middle_cores
    processes = fleet.drones * (2 + fleet.observers)
    return Needs(
        proxy_cores=proxy_cores,
        pilot_cores=pilot_cores,
        observer_cores=observer_cores,
        router_cores=router_cores,
        middle_cores=middle_cores,
        drone_uplink=(feedback_bits + frame_bits) / _MB,
        drone_downlink=8 * _PACKETS_PER_S * units.command_bytes / _MB,
        site_link=site_drones * leaving_bits / _MB,
        tokens=fleet.drones * (1 + 1 + fleet.observers),
        proxy_memory_gb=fleet.drones * units.proxy_mb / 1e3,
        observer_memory_gb=fleet.drones * fleet.observers * units.observer_mb / 1e3,
        cores=math.ceil(every / fleet.busy),
        mesh_links=processes * (processes - 1) // 2,
    )
