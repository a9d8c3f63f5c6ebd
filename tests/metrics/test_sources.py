"""Metrics of proxies, connections and routers, all of them in the catalogue."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest

from skyloop.client.drone import open_drone
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.cockpit.server import fleet_sources
from skyloop.messages import EventKind, LinkState, Role, Velocity
from skyloop.metrics import FAMILIES, Reading, client_readings, proxy_readings, router_readings
from skyloop.network import FabricServer, FabricSettings
from skyloop.network.config import free_port
from skyloop.network.session import FabricSession
from skyloop.transport.composite import CompositeServer
from skyloop.transport.testing import header, picture
from tests.support.proxy_bench import Bench
from tests.support.scripted_proxy import WAIT_S, scripted

Values = dict[tuple[str, ...], float]


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as bench:
        yield bench


def values(readings: Iterator[Reading]) -> Values:
    """Return values by name and labels, after checking each against the catalogue."""
    found: Values = {}
    for reading in readings:
        family = FAMILIES[reading.name]
        assert len(reading.labels) == len(family.labels), reading
        key = (reading.name, *reading.labels)
        assert key not in found, "two values of one series"
        found[key] = reading.value
    return found


def of(bench: Bench) -> Values:
    return values(proxy_readings(bench.proxy))


def test_a_vehicle_on_the_ground_without_applications(bench: Bench) -> None:
    bench.clock.advance(0.5)
    found = of(bench)
    assert found["skyloop_vehicle_info", "bench", "fake"] == 1
    assert found["skyloop_vehicle_state", "bench", "landed"] == 1
    assert found["skyloop_vehicle_state", "bench", "flying"] == 0
    assert found["skyloop_vehicle_link_state", "bench", "up"] == 1
    assert found["skyloop_failsafe", "bench", "none"] == 1
    assert found["skyloop_vehicle_battery_ratio", "bench"] == 0.9
    assert ("skyloop_vehicle_battery_volts", "bench") not in found, "unknown voltage"
    assert found["skyloop_feedback_age_seconds", "bench"] == pytest.approx(0.5)
    assert found["skyloop_applications", "bench"] == 0
    assert found["skyloop_authority_held", "bench"] == 0
    assert ("skyloop_command_age_seconds", "bench") not in found
    assert ("skyloop_network_dropped_total", "bench") not in found, "no network is served"


def test_a_flight(bench: Bench) -> None:
    pilot, eye = bench.airborne("ann", priority=7), bench.join("eye", Role.OBSERVER)
    pilot.command(Velocity(1.0))
    eye.command(Velocity(1.0))
    eye.end.send(b"garbage")
    eye.end.subscribe("video/front")
    eye.sync()
    bench.driver.report(battery=0.4, battery_v=11.1)
    bench.proxy.publisher.frame("front", picture(header(1, 4, 3)), bench.clock(), width=4, height=3)
    bench.clock.advance(0.25)
    found = of(bench)
    assert found["skyloop_authority_held", "bench"] == 1
    assert found["skyloop_authority_priority", "bench"] == 7
    assert found["skyloop_authority_leases_total", "bench"] == 1
    assert found["skyloop_command_age_seconds", "bench"] == pytest.approx(0.25)
    assert found["skyloop_applications", "bench"] == 2
    assert found["skyloop_commands_refused_total", "bench", "observer"] == 1
    assert found["skyloop_commands_applied_total", "bench"] >= 2
    assert found["skyloop_command_delay_seconds", "bench", "p99"] >= 0
    assert found["skyloop_packets_malformed_total", "bench"] == 1
    assert found["skyloop_events_total", "bench", EventKind.PACKET_MALFORMED.value] == 1
    assert found["skyloop_vehicle_battery_volts", "bench"] == 11.1
    assert found["skyloop_frames_published_total", "bench", "front"] == 1


def test_a_silent_pilot(bench: Bench) -> None:
    bench.airborne()
    bench.run(2.5)
    found = of(bench)
    assert found["skyloop_failsafe", "bench", "none"] == 0
    assert found["skyloop_failsafe", "bench", "hover"] + found["skyloop_failsafe", "bench", "land"] == 1


def test_a_proxy_that_has_not_started() -> None:
    found = of(Bench())
    assert found["skyloop_vehicle_state", "bench", "unknown"] == 1
    assert ("skyloop_feedback_age_seconds", "bench") not in found


def test_a_proxy_on_the_network_counts_what_happens_there() -> None:
    settings = FabricSettings(listen=(f"127.0.0.1:{free_port('127.0.0.1')}",), multicast=False)
    bench = Bench()
    fabric = FabricServer("bench", settings)
    bench.proxy.server = CompositeServer([bench.server, fabric])
    assert of(bench)["skyloop_network_turned_away_total", "bench"] == 0


def test_a_connection_of_a_client() -> None:
    with scripted() as proxy, open_drone(proxy.server.dial, app="eye", access="observe") as drone:
        drone.next_feedback(WAIT_S)
        drone.frame()
        proxy.frame(1)
        drone.next_frame(timeout_s=WAIT_S)
        drone.on_frame(print, max_fps=1.0)
        found = values(client_readings("scripted", drone))
    assert found["skyloop_client_link_state", "scripted", LinkState.UP.value] == 1
    assert found["skyloop_client_received_total", "scripted", "feedback"] >= 1
    assert found["skyloop_client_received_total", "scripted", "video/front"] == 1
    assert found["skyloop_client_lost_total", "scripted", "feedback"] == 0
    assert found["skyloop_client_delay_seconds", "scripted", "feedback", "median"] >= 0
    assert {key[2] for key in found if key[0] == "skyloop_client_received_total"} == {
        "feedback",
        "video/front",
        "video/bottom",
    }


def test_a_fleet_of_the_cockpit() -> None:
    with scripted() as proxy, open_drone(proxy.server.dial, app="eye", access="observe") as drone:
        station = SimpleNamespace(drone=drone, pilots={1, 2})
        fleet = SimpleNamespace(stations={"scripted": station}, problems={"bravo": "it is stopped"})
        found = values(reading for source in fleet_sources(cast(CockpitFleet, fleet)) for reading in source())
    assert found[("skyloop_cockpit_unreachable",)] == 1
    assert found["skyloop_cockpit_pilots", "scripted"] == 2
    assert found["skyloop_client_link_state", "scripted", "up"] == 1


def test_a_router() -> None:
    kinds: list[Any] = ["WhatAmI.PEER", "WhatAmI.PEER", "WhatAmI.ROUTER"]
    transports = [SimpleNamespace(whatami=kind) for kind in kinds]
    info = SimpleNamespace(transports=lambda: transports)
    session = SimpleNamespace(zenoh=SimpleNamespace(info=info), shut_out=lambda: frozenset({"bad"}))
    found = values(iter(list(router_readings(lambda: cast(FabricSession, session))())))
    assert found == {
        ("skyloop_router_links", "router"): 1,
        ("skyloop_router_links", "peer"): 2,
        ("skyloop_router_links", "client"): 0,
        ("skyloop_router_shut_out",): 1,
    }


@pytest.mark.parametrize("family", FAMILIES.values(), ids=lambda family: family.name)
def test_names_follow_openmetrics(family: Any) -> None:
    assert family.name.startswith("skyloop_")
    assert family.name.endswith("_total") == (family.kind == "counter")
    assert family.name.endswith("_info") == (family.kind == "info")
    assert len(set(family.labels)) == len(family.labels)
    for unit in ("_ms", "_percent", "_milliseconds", "_hz"):
        assert not family.name.endswith(unit), "base units only"
