"""Metrics of proxies, the cockpit and routers for Prometheus, collected only when they are scraped.

They can be read on any thread, without acquiring any lock that a command waits for. Requires the ``metrics`` extra.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from enum import Enum
from functools import partial
from typing import TYPE_CHECKING, Final

from skyloop.clock import NS_PER_S
from skyloop.extend import Known
from skyloop.messages import Failsafe, FlightState, LinkState
from skyloop.metrics.endpoint import FAMILIES, Endpoint, Reading, Source, serve

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.network.session import FabricSession
    from skyloop.proxy import Proxy

#: Counters of the proxy that are also metrics, such as ``skyloop_feedback_missed_total``. Counters that are absent are
#: exported as 0, except those of a network that is not served.
_COUNTERS: Final = (
    "feedback.published",
    "feedback.selected",
    "feedback.missed",
    "commands.received",
    "commands.applied",
    "commands.clamped",
    "commands.superseded",
    "requests.refused",
    "packets.malformed",
    "packets.refused",
    "events.missed",
    "driver.errors",
)
_NETWORK: Final = ("network.dropped", "network.refused", "network.strays", "network.turned_away")
#: Counters whose name contains a label. Each pair contains the parts of the name before and after the label.
_LABELLED: Final = {
    "skyloop_commands_refused_total": ("commands.refused.", ""),
    "skyloop_events_total": ("events.of.", ""),
    "skyloop_frames_received_total": ("frames.", ".received"),
    "skyloop_frames_published_total": ("frames.", ".published"),
    "skyloop_frames_missed_total": ("frames.", ".missed"),
}
_DELAYS: Final = {"median": "commands.delay.median_s", "p99": "commands.delay.p99_s", "max": "commands.delay.max_s"}
__all__ = ["FAMILIES", "Endpoint", "Reading", "Source", "serve"]  # re-exported from the endpoint


def serve_proxies(proxies: Callable[[], Iterable[Proxy]], where: str) -> Endpoint:
    """Serve the metrics of the current proxies. ``proxies`` returns them for each scrape; see :func:`serve`."""
    return serve(lambda: [partial(proxy_readings, proxy) for proxy in proxies()], where)


def serving_beside(
    where: str, announce: Callable[[str], None]
) -> Callable[[Sequence[Proxy]], AbstractContextManager[object]]:
    """Return the ``beside`` of :func:`skyloop.proxy.serve.run` that serves its proxies' metrics and announces where."""

    def enter(proxies: Sequence[Proxy]) -> AbstractContextManager[object]:
        endpoint = serve_proxies(lambda: proxies, where)
        announce(endpoint.announcement)
        return endpoint

    return enter


def proxy_readings(proxy: Proxy) -> Iterator[Reading]:
    """Yield all metrics about one proxy, its vehicle and its applications."""
    name, now_ns, publisher, handler = proxy.name, proxy.clock(), proxy.publisher, proxy.handler
    own = (name,)
    yield Reading("skyloop_vehicle_info", 1.0, (name, proxy.capabilities.vehicle))
    feedback = publisher.feedback_now
    state = FlightState.UNKNOWN if feedback is None else feedback.state
    yield from _states("skyloop_vehicle_state", own, state, FlightState)
    yield from _states("skyloop_vehicle_link_state", own, publisher.link_state, LinkState)
    yield from _states("skyloop_failsafe", own, handler.ladder.step, Failsafe)
    if feedback is not None:
        yield Reading("skyloop_feedback_age_seconds", (now_ns - feedback.captured_ns) / NS_PER_S, own)
        if feedback.battery is not None:
            yield Reading("skyloop_vehicle_battery_ratio", feedback.battery, own)
        if feedback.battery_v is not None:
            yield Reading("skyloop_vehicle_battery_volts", feedback.battery_v, own)
    authority = handler.authority
    holder = authority.holder
    yield Reading("skyloop_authority_held", float(holder is not None), own)
    yield Reading("skyloop_authority_waiting", float(len(authority.waiting)), own)
    yield Reading("skyloop_authority_leases_total", float(authority.granted), own)
    if holder is not None:
        yield Reading("skyloop_authority_priority", float(holder.priority), own)
        yield Reading("skyloop_command_age_seconds", (now_ns - authority.last_command_ns) / NS_PER_S, own)
    counts = proxy.statistics()
    yield Reading("skyloop_applications", counts["applications"], own)
    yield Reading("skyloop_requests_total", counts.get("requests.received", 0.0), own)
    for counter in (*_COUNTERS, *(counter for counter in _NETWORK if counter in counts)):
        yield Reading(f"skyloop_{counter.replace('.', '_')}_total", counts.get(counter, 0.0), own)
    for metric, (prefix, suffix) in _LABELLED.items():
        for counter, count in counts.items():
            label = counter.removeprefix(prefix).removesuffix(suffix)
            if counter == f"{prefix}{label}{suffix}":
                yield Reading(metric, count, (name, label))
    for statistic, counter in _DELAYS.items():
        if counter in counts:
            yield Reading("skyloop_command_delay_seconds", counts[counter], (name, statistic))


def client_readings(name: str, drone: Drone) -> Iterator[Reading]:
    """Yield a client's metrics about its connection to one proxy, without querying the proxy."""
    yield from _states("skyloop_client_link_state", (name,), drone.link.application, LinkState)
    for channel, stats in Known(drone).stats.items():
        if channel != "feedback" and (not channel.startswith("video/") or "?" in channel):
            continue  # pages open any number of video streams, while an observer sends no commands
        labels = (name, channel)
        yield Reading("skyloop_client_received_total", float(stats.count), labels)
        yield Reading("skyloop_client_lost_total", float(stats.lost), labels)
        yield Reading("skyloop_client_dropped_total", float(stats.dropped), labels)
        yield Reading("skyloop_client_malformed_total", float(stats.malformed), labels)
        if stats.age_s is not None:
            yield Reading("skyloop_client_age_seconds", stats.age_s, labels)
        if (delay := stats.delay_s) is not None:
            for statistic, value in (("median", delay.median), ("p99", delay.p99), ("max", delay.maximum)):
                yield Reading("skyloop_client_delay_seconds", value, (*labels, statistic))


def router_readings(session: Callable[[], FabricSession]) -> Source:
    """Return the source of a router's metrics."""

    def read() -> Iterator[Reading]:
        current = session()
        links = dict.fromkeys(("router", "peer", "client"), 0)
        for transport in current.zenoh.info.transports():
            kind = str(transport.whatami).rpartition(".")[2].lower()
            links[kind] = links.get(kind, 0) + 1
        for kind, count in links.items():
            yield Reading("skyloop_router_links", float(count), (kind,))
        yield Reading("skyloop_router_shut_out", float(len(current.shut_out())))

    return read


def _states(metric: str, labels: tuple[str, ...], current: Enum, states: type[Enum]) -> Iterator[Reading]:
    """Yield 1 for the current state and 0 for every other state."""
    for state in states:
        yield Reading(metric, float(state is current), (*labels, str(state.value)))
