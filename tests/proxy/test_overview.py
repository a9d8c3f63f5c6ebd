"""The overview: one row for each vehicle of a process, once a second, built once for all its proxies."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import (
    EventKind,
    FlightState,
    Hello,
    LinkState,
    Overview,
    Role,
    Severity,
    VehicleOverview,
    decode,
)
from skyloop.messages.feedback import OverviewPages
from skyloop.proxy.topics import OverviewRegistry
from skyloop.transport.base import OVERVIEW
from skyloop.transport.composite import CompositeServer
from skyloop.transport.memory import MemoryServer
from tests.support.proxy_bench import App, Bench


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as bench:
        yield bench


def watcher(bench: Bench) -> App:
    app = bench.join("watcher", Role.OBSERVER)
    app.end.subscribe(OVERVIEW)
    app.sync()
    return app


def overviews(app: App) -> list[Overview]:
    app.sync()
    return [sample for sample in app.others if isinstance(sample, Overview)]


def test_a_lone_proxy_has_one_row_a_second_and_one_at_once(bench: Bench) -> None:
    app = watcher(bench)
    bench.tick()
    (first,) = overviews(app)
    (row,) = first.vehicles
    assert (first.seq, first.first, first.total) == (1, 0, 1)
    assert (row.name, row.uri, row.vehicle, row.can_fly) == ("bench", "fake://", "fake", True)
    assert (row.state, row.battery, row.altitude_m) == (FlightState.LANDED, 0.9, 1.0)
    assert (row.vehicle_link, row.owner, row.applications) == (LinkState.UP, None, 1)
    bench.run(5.0)
    assert len(overviews(app)) == 6
    assert [one.seq for one in overviews(app)] == [1, 2, 3, 4, 5, 6]
    watcher(bench)
    bench.tick()
    assert len(overviews(app)) == 7, "a new subscriber does not wait"


def test_nothing_is_built_without_a_subscriber(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    real = OverviewRegistry.packets
    monkeypatch.setattr(OverviewRegistry, "packets", lambda self, now_ns: (made.append(now_ns), real(self, now_ns))[1])  # type: ignore[func-returns-value]
    bench.run(3.0)
    assert made == []
    app = watcher(bench)
    bench.run(1.0)
    assert len(made) == 1
    app.end.close()
    bench.apps.remove(app)
    bench.join("another").sync()
    bench.run(3.0)
    assert len(made) == 1


def test_a_row_has_the_pilot_the_failsafe_and_the_last_event(bench: Bench) -> None:
    app = watcher(bench)
    bench.airborne("ann")
    bench.proxy.publisher.event(EventKind.COLLISION, "it hit the wall " + "x" * 400, Severity.ERROR, wall=3)
    bench.join("somebody who comes")
    bench.tick()
    (row,) = overviews(app)[-1].vehicles
    assert (row.owner, row.owner_priority, row.state) == ("ann", 16, FlightState.HOVERING)
    assert row.event is not None
    assert (row.event.kind, row.event.severity, row.event.data) == (EventKind.COLLISION, Severity.ERROR, {})
    assert len(row.event.text) == 200
    assert row.applications == 3


def test_a_vehicle_without_any_report_yet() -> None:
    bench = Bench()
    row = bench.proxy.overview._row()
    assert (row.captured_ns, row.state, row.event) == (0, FlightState.UNKNOWN, None)
    assert row.vehicle_link is LinkState.CONNECTING


def test_proxies_that_share_a_registry_have_one_overview() -> None:
    one, other = Bench(), Bench()
    other.proxy.name, other.clock = "other", one.clock
    registry = OverviewRegistry()
    for bench in (one, other):
        bench.proxy.overview.share(registry)
    with one:
        with other:
            apps = [watcher(one), watcher(other)]
            one.tick()
            other.tick()
            shown = [overviews(app)[0] for app in apps]
            assert [row.name for row in shown[0].vehicles] == ["bench", "other"]
            assert shown[0] == shown[1], "built once"
        one.clock.advance(2.0)
        one.tick()
        assert [row.name for row in overviews(apps[0])[-1].vehicles] == ["bench"], "a stopped one is gone"


def test_with_keys_for_single_drones_a_proxy_shows_only_its_own() -> None:
    class Keyed(MemoryServer):
        @property
        def restricted(self) -> bool:
            return True

    memory, keyed = MemoryServer("open"), Keyed("keyed")
    registry = OverviewRegistry()
    bench = Bench(transport=(CompositeServer([memory, keyed]), keyed.dial))
    bench.proxy.overview.share(registry)
    registry.add(lambda: VehicleOverview(name="secret"))
    with bench:
        app = watcher(bench)
        bench.tick()
        assert [row.name for row in overviews(app)[0].vehicles] == ["bench"]
    assert not memory.restricted


@pytest.mark.parametrize("count", [1, 200, 1000])
def test_rows_beyond_one_packet_are_split(count: int) -> None:
    registry = OverviewRegistry()
    rows = [
        VehicleOverview(name=f"drone-{number:04}", uri="u" * 200, link_reason="why " * 60, owner="p" * 64)
        for number in range(count)
    ]
    for row in rows:
        registry.add(lambda row=row: row)  # type: ignore[misc]
    packets = registry.packets(0)
    assert len(packets) == 1 if count == 1 else len(packets) > 1
    pages, whole = OverviewPages(), []
    for packet in packets:
        page = decode(packet)
        assert isinstance(page, Overview)
        found = pages.add(page)
        whole += [] if found is None else [found]
    (overview,) = whole
    assert list(overview.vehicles) == rows
    assert registry.packets(1) is packets, "fresh enough"


@given(st.lists(st.integers(0, 11), max_size=60))
def test_lost_repeated_or_reordered_pages_make_no_wrong_overview(order: list[int]) -> None:
    names = [f"d{number}" for number in range(4)]
    sent = [
        Overview(at_ns=0, seq=seq, first=first, total=4, vehicles=(VehicleOverview(name=names[first]),))
        for seq in range(3)
        for first in range(4)
    ]
    pages = OverviewPages()
    for index in order:
        found = pages.add(sent[index])
        if found is not None:
            assert [row.name for row in found.vehicles] == names
            assert found.first == 0
    (last,) = [found for page in sent[8:] if (found := pages.add(page)) is not None]
    assert last.seq == 2


def test_applications_may_not_send_an_overview(bench: Bench) -> None:
    app = bench.stranger()
    app.ask(Hello("app", Role.OBSERVER))
    app.end.send(OverviewRegistry().packets(0)[0])
    app.sync()
    (told,) = app.told(EventKind.PACKET_MALFORMED)
    assert "Overview may only be sent by the proxy" in told.text
