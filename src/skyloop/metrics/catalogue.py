"""Every metric that there is: names, kinds, labels and meanings, as ``docs/operations.md`` lists them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

Kind = Literal["gauge", "counter", "info"]


@dataclass(frozen=True, slots=True)
class Family:
    """One metric, with all its labels. Names follow OpenMetrics: base units, ``_total`` for counters."""

    name: str
    kind: Kind
    labels: tuple[str, ...]
    meaning: str


class Reading(NamedTuple):
    """One value of a metric now."""

    name: str
    value: float
    labels: tuple[str, ...] = ()  #: in the order of the family's labels


_VEHICLE: Final = ("vehicle",)
_CHANNEL: Final = ("vehicle", "channel")

FAMILIES: Final[dict[str, Family]] = {
    family.name: family
    for family in (
        # Of each proxy; the label `vehicle` is the proxy's name.
        Family("skyloop_vehicle_info", "info", ("vehicle", "family"), "which family each vehicle is of"),
        Family("skyloop_vehicle_state", "gauge", ("vehicle", "state"), "1 for the present flight state, else 0"),
        Family(
            "skyloop_vehicle_link_state",
            "gauge",
            ("vehicle", "state"),
            "1 for the present state of the link between proxy and vehicle, else 0",
        ),
        Family("skyloop_vehicle_battery_ratio", "gauge", _VEHICLE, "charge left, 0 to 1; absent while not known"),
        Family("skyloop_vehicle_battery_volts", "gauge", _VEHICLE, "voltage of the battery; absent while not known"),
        Family("skyloop_failsafe", "gauge", ("vehicle", "step"), "1 for the failsafe's step in force, else 0"),
        Family("skyloop_feedback_age_seconds", "gauge", _VEHICLE, "since the vehicle's newest state was captured"),
        Family("skyloop_feedback_published_total", "counter", _VEHICLE, "samples of feedback published"),
        Family("skyloop_feedback_selected_total", "counter", _VEHICLE, "samples published in forms with less in them"),
        Family("skyloop_feedback_missed_total", "counter", _VEHICLE, "samples that did not fit into a subscriber"),
        Family("skyloop_commands_received_total", "counter", _VEHICLE, "commands that came"),
        Family("skyloop_commands_applied_total", "counter", _VEHICLE, "commands handed to the vehicle"),
        Family("skyloop_commands_clamped_total", "counter", _VEHICLE, "commands lowered to a limit"),
        Family(
            "skyloop_commands_superseded_total",
            "counter",
            _VEHICLE,
            "commands that waited, and made way for newer ones",
        ),
        Family("skyloop_commands_refused_total", "counter", ("vehicle", "reason"), "commands refused, by reason"),
        Family(
            "skyloop_command_delay_seconds",
            "gauge",
            ("vehicle", "statistic"),
            "from sending to applying, of the last 2000 commands: median, p99, max",
        ),
        Family(
            "skyloop_command_age_seconds",
            "gauge",
            _VEHICLE,
            "since the pilot's newest valid command; absent while nobody has the authority",
        ),
        Family("skyloop_authority_held", "gauge", _VEHICLE, "1 while an application has the authority, else 0"),
        Family("skyloop_authority_priority", "gauge", _VEHICLE, "its priority, 0 the highest; absent while none has"),
        Family("skyloop_authority_waiting", "gauge", _VEHICLE, "applications that wait for the authority"),
        Family("skyloop_authority_leases_total", "counter", _VEHICLE, "how often the authority was granted"),
        Family("skyloop_applications", "gauge", _VEHICLE, "applications connected"),
        Family("skyloop_requests_total", "counter", _VEHICLE, "requests that came"),
        Family("skyloop_requests_refused_total", "counter", _VEHICLE, "requests refused"),
        Family("skyloop_packets_malformed_total", "counter", _VEHICLE, "packets that could not be decoded"),
        Family("skyloop_packets_refused_total", "counter", _VEHICLE, "packets that the sender's keys do not allow"),
        Family("skyloop_events_total", "counter", ("vehicle", "kind"), "events published, by kind"),
        Family("skyloop_events_missed_total", "counter", _VEHICLE, "events that did not fit into a subscriber"),
        Family("skyloop_driver_errors_total", "counter", _VEHICLE, "calls of the driver that failed"),
        Family("skyloop_frames_received_total", "counter", ("vehicle", "camera"), "frames that the vehicle gave"),
        Family("skyloop_frames_published_total", "counter", ("vehicle", "camera"), "frames published"),
        Family("skyloop_frames_missed_total", "counter", ("vehicle", "camera"), "frames that passed a subscriber by"),
        Family(
            "skyloop_network_dropped_total",
            "counter",
            _VEHICLE,
            "packets to single applications that were given up",
        ),
        Family("skyloop_network_refused_total", "counter", _VEHICLE, "packets on a key that gives no right to them"),
        Family("skyloop_network_strays_total", "counter", _VEHICLE, "packets and queries of nobody that is connected"),
        Family("skyloop_network_turned_away_total", "counter", _VEHICLE, "connections refused for want of a place"),
        # Of the cockpit, as a client of each proxy.
        Family(
            "skyloop_client_link_state",
            "gauge",
            ("vehicle", "state"),
            "1 for the present state of the link to the proxy, else 0",
        ),
        Family("skyloop_client_received_total", "counter", _CHANNEL, "samples received"),
        Family("skyloop_client_lost_total", "counter", _CHANNEL, "samples missing by the gaps in their numbers"),
        Family("skyloop_client_dropped_total", "counter", _CHANNEL, "samples that newer ones overtook here"),
        Family("skyloop_client_malformed_total", "counter", _CHANNEL, "samples that could not be decoded"),
        Family(
            "skyloop_client_delay_seconds",
            "gauge",
            ("vehicle", "channel", "statistic"),
            "from publishing to receiving, of the last 1024 samples: median, p99, max",
        ),
        Family("skyloop_client_age_seconds", "gauge", _CHANNEL, "since the newest sample was captured"),
        Family("skyloop_cockpit_unreachable", "gauge", (), "proxies that were found and could not be connected to"),
        Family("skyloop_cockpit_pilots", "gauge", _VEHICLE, "pages that have, or wait for, the authority, or may stop"),
        # Of a router.
        Family("skyloop_router_links", "gauge", ("kind",), "links to others: router, peer (a proxy), client"),
        Family("skyloop_router_shut_out", "gauge", (), "linked nodes whose keys were revoked or changed"),
        # Of every endpoint.
        Family("skyloop_scrape_errors_total", "counter", (), "readings that failed and are missing, see the log"),
    )
}
