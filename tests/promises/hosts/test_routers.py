"""Programs that reach a proxy only through a router: from separate segments, and from behind NAT."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import pytest

from benchmarks.hosts.namespaces import Lab
from tests.promises.hosts import flying
from tests.promises.hosts.conftest import FAST
from tests.promises.hosts.remote import Remote
from tests.support.processes import Process

Start = Callable[..., Process]
OnHost = Callable[..., Remote]


def flies(app: Remote, network: str) -> None:
    """It finds the proxy, flies it, and gets pictures."""
    app.do(flying.connect, "alpha", network=network)
    app.do(flying.watch_frames, "alpha", encoding="jpeg")
    app.do(flying.call, "alpha", "takeoff")
    app.do(flying.wait, "alpha", "hovering")
    app.do(flying.wait_frames, "alpha", 2)


def test_a_router_joins_separate_segments(lab: Lab, start: Start, proxy: Start, remote: OnHost) -> None:
    pytest.importorskip("zenoh")
    inside, outside = lab.segment("10.77.1.0/24"), lab.segment("10.77.2.0/24")
    hangar, desk, middle = (lab.host(name) for name in ("hangar", "desk", "middle"))
    inside.join(hangar)
    outside.join(desk)
    addresses = inside.join(middle), outside.join(middle)
    start(middle, "-m", "skyloop", "router", "--no-multicast").until("ready")
    proxy(hangar, "alpha", "--no-multicast", "--connect", addresses[0], uri=FAST.replace("none", "front"))
    app = remote(desk)
    flies(app, addresses[1])
    app.do(flying.watch_numbers, "alpha")
    numbers = app.do(flying.numbers, "alpha", 40)
    assert len(set(numbers)) == len(numbers), "a sample arrived twice"


def test_proxies_and_programs_behind_nat_meet_at_a_router(lab: Lab, start: Start, proxy: Start, remote: OnHost) -> None:
    """Two sites, each behind a router with NAT, and a third place that both can reach."""
    pytest.importorskip("zenoh")
    if shutil.which("nft") is None:
        pytest.skip("there is no program 'nft': install nftables")
    internet = lab.segment("10.99.0.0/24")
    public = lab.host("public")
    meeting = internet.join(public)
    site_hosts = []
    for number, name in ((1, "hangar"), (2, "desk")):
        site = lab.segment(f"10.77.{number}.0/24")
        host, gate = lab.host(name), lab.host(f"gate{number}")
        site.join(host)
        host.ip(f"route add default via {site.join(gate)}")
        internet.join(gate)
        gate.forward()
        gate.masquerade("eth1")
        site_hosts.append(host)
    hangar, desk = site_hosts
    start(public, "-m", "skyloop", "router", "--no-multicast").until("ready")
    proxy(hangar, "alpha", "--no-multicast", "--connect", meeting, uri=FAST.replace("none", "front"))
    flies(remote(desk), meeting)


def test_several_sites_are_joined_by_one_router_each(lab: Lab, start: Start, proxy: Start, remote: OnHost) -> None:
    pytest.importorskip("zenoh")
    between = lab.segment("10.99.0.0/24")
    near, far = [], []
    for number, name in ((1, "hangar"), (2, "desk")):
        site = lab.segment(f"10.77.{number}.0/24")
        host, router = lab.host(name), lab.host(f"router{number}")
        site.join(host)
        near.append((host, site.join(router), router))
        far.append(between.join(router))
    (hangar, first, router1), (desk, second, router2) = near
    start(router1, "-m", "skyloop", "router", "--no-multicast").until("ready")
    start(router2, "-m", "skyloop", "router", "--no-multicast", "--connect", far[0]).until("ready")
    proxy(hangar, "alpha", "--no-multicast", "--connect", first, uri=FAST.replace("none", "front"))
    flies(remote(desk), second)


def test_with_a_direct_path_and_a_router_each_sample_arrives_once(
    lab: Lab, start: Start, proxy: Start, remote: OnHost
) -> None:
    pytest.importorskip("zenoh")
    segment = lab.segment("10.77.1.0/24")
    hangar, desk, middle = (lab.host(name) for name in ("hangar", "desk", "middle"))
    for host in (hangar, desk):
        segment.join(host)
    address = segment.join(middle)
    start(middle, "-m", "skyloop", "router").until("ready")
    proxy(hangar)
    app = remote(desk)
    app.do(flying.connect, "alpha", network=f"multicast,{address}")
    app.do(flying.watch_numbers, "alpha")
    numbers = app.do(flying.numbers, "alpha", 60)
    assert len(set(numbers)) == len(numbers)
    app.do(flying.call, "alpha", "takeoff")
    app.do(flying.wait, "alpha", "hovering")
    refused = [event.text for event in app.do(flying.events, "alpha") if event.kind == "command_refused"]
    assert not refused
