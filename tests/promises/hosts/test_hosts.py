"""The hosts, segments and paths that the other tests rely on, tested by plain UDP and TCP."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path as File

import pytest

from benchmarks.hosts.impairments import Impairments
from benchmarks.hosts.namespaces import Host, Lab
from benchmarks.hosts.path import Path
from skyloop.errors import UnsupportedError, UsageError
from skyloop.transport.testing import wait_until
from tests.support.processes import Process

PROBES = str(File(__file__).parent / "probes.py")
PERIOD_S = 0.005
Start = Callable[..., Process]


def rounds(host: Host, protocol: str, address: str, count: int) -> list[tuple[int, int]]:
    """Return the numbers and round-trip times [ns] of the probes that came back."""
    said = host.run(sys.executable, PROBES, "send", protocol, address, str(count), str(PERIOD_S))
    return [(number, heard - sent) for number, sent, heard in json.loads(said)]


def reaches(host: Host, address: str) -> bool:
    return bool(rounds(host, "udp", address, 1))


def test_hosts_of_one_segment_reach_only_one_another(lab: Lab, start: Start) -> None:
    segment = lab.segment("10.77.1.0/24")
    alpha, bravo, outsider = (lab.host(name) for name in ("alpha", "bravo", "outsider"))
    address = segment.join(alpha)
    assert (address, segment.join(bravo)) == ("10.77.1.1", "10.77.1.2")
    start(alpha, PROBES, "echo", "udp", address).until("ready")
    assert len(rounds(bravo, "udp", address, 20)) == 20
    with pytest.raises(UnsupportedError, match="unreachable"):
        rounds(outsider, "udp", address, 1)
    assert bravo.run("hostname").strip() == "bravo"
    with pytest.raises(UsageError, match="plugged in already"):
        segment.join(bravo)


@pytest.mark.parametrize("how", [("cut", "restore"), ("unplug", "plug")])
def test_a_link_is_cut_and_restored(lab: Lab, start: Start, how: tuple[str, str]) -> None:
    segment = lab.segment("10.77.1.0/24")
    alpha, bravo = lab.host("alpha"), lab.host("bravo")
    address = segment.join(alpha)
    segment.join(bravo)
    start(alpha, PROBES, "echo", "udp", address).until("ready")
    assert rounds(bravo, "udp", address, 10)
    down, up = how
    getattr(segment, down)(bravo)
    state = bravo.run("ip", "-br", "link", "show", "eth0").split()[1]
    assert state == {"cut": "UP", "unplug": "DOWN"}[down]  # a cut is silent
    assert not rounds(bravo, "udp", address, 10)
    getattr(segment, up)(bravo)
    wait_until(lambda: reaches(bravo, address), "the link is back")


def test_a_router_between_two_segments(lab: Lab, start: Start) -> None:
    inside, outside = lab.segment("10.77.1.0/24"), lab.segment("10.77.2.0/24")
    alpha, bravo, router = (lab.host(name) for name in ("alpha", "bravo", "router"))
    inside.join(alpha)
    gateway = inside.join(router), outside.join(router)
    address = outside.join(bravo)
    start(bravo, PROBES, "echo", "udp", address).until("ready")
    alpha.ip(f"route add default via {gateway[0]}")
    bravo.ip(f"route add 10.77.1.0/24 via {gateway[1]}")
    assert not rounds(alpha, "udp", address, 5)
    router.forward()
    assert len(rounds(alpha, "udp", address, 10)) == 10


def test_hosts_behind_nat_reach_out_but_are_not_reached(lab: Lab, start: Start) -> None:
    if not any((File(folder) / "nft").exists() for folder in os.environ["PATH"].split(":")):
        pytest.skip("there is no program 'nft': install nftables")
    inside, outside = lab.segment("10.77.1.0/24"), lab.segment("10.77.2.0/24")
    alpha, bravo, router = (lab.host(name) for name in ("alpha", "bravo", "router"))
    hidden = inside.join(alpha)
    alpha.ip(f"route add default via {inside.join(router)}")
    outside.join(router)
    address = outside.join(bravo)
    router.forward()
    router.masquerade("eth1")
    for host, own in ((alpha, hidden), (bravo, address)):
        start(host, PROBES, "echo", "udp", own).until("ready")
    assert len(rounds(alpha, "udp", address, 10)) == 10
    with pytest.raises(UnsupportedError, match="unreachable"):
        rounds(bravo, "udp", hidden, 1)


def test_a_clock_with_an_offset(lab: Lab) -> None:
    ahead = lab.host("ahead", clock_ahead_s=1000)
    before_ns = time.monotonic_ns()
    there_ns = int(ahead.run(sys.executable, PROBES, "clock"))
    after_ns = time.monotonic_ns()
    assert before_ns <= there_ns - 1000 * 10**9 <= after_ns


@pytest.mark.usefixtures("_possible")
def test_nothing_outlives_its_creator() -> None:
    """Killed without a chance to clean up, the creator leaves no process that holds a namespace."""
    script = (
        "from benchmarks.hosts.namespaces import Lab\n"
        "lab = Lab(); a = lab.host('alpha'); lab.segment('10.77.1.0/24').join(a); print(a.pid, flush=True); input()"
    )
    maker = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert maker.stdin is not None
    assert maker.stdout is not None
    holder = int(maker.stdout.readline())
    assert File(f"/proc/{holder}/comm").read_text().strip() == "cat"
    maker.kill()
    maker.wait(10)
    wait_until(lambda: not File(f"/proc/{holder}").exists(), "the holder has ended")
    maker.stdin.close()
    maker.stdout.close()


@pytest.fixture
def ends(lab: Lab) -> tuple[Host, Host]:
    return lab.host("alpha"), lab.host("bravo")


def test_a_perfect_path_loses_nothing_and_keeps_the_order(lab: Lab, ends: tuple[Host, Host], start: Start) -> None:
    path = Path(lab, *ends, seed=1)
    start(ends[0], PROBES, "echo", "udp", path.first).until("ready")
    found = rounds(ends[1], "udp", path.first, 100)
    assert [number for number, _ in found] == list(range(100))
    there, back = path.tell()
    assert (there.packets, back.packets, there.lost, back.lost) == (100, 100, 0, 0)
    assert back.size == 100 * (20 + 8 + 16)


def test_a_path_delays_reorders_and_loses(lab: Lab, ends: tuple[Host, Host], start: Start) -> None:
    wrong = Impairments(loss=0.2, delay_s=0.02, jitter_s=0.004, reorder=0.1, reorder_s=0.03)
    path = Path(lab, *ends, seed=1, impairments=wrong)
    start(ends[0], PROBES, "echo", "udp", path.first).until("ready")
    found = rounds(ends[1], "udp", path.first, 300)
    there, back = path.tell()
    assert len(found) == there.packets
    assert there.packets + there.lost == back.packets == 300 - back.lost
    assert 20 <= back.lost <= 110  # of 300, at 20 %: more than five standard deviations off is not chance
    assert min(taken for _, taken in found) >= 2 * 0.02e9
    numbers = [number for number, _ in found]
    assert numbers != sorted(numbers)
    path.set(Impairments())
    assert len(rounds(ends[1], "udp", path.first, 50)) == 50
    path.set(Impairments(), Impairments(loss=1.0))
    assert not rounds(ends[1], "udp", path.first, 10)
    there, back = path.tell()
    assert (there.packets, back.lost) == (50, 10)
    path.set(Impairments())
    path.cut()
    assert not rounds(ends[1], "udp", path.first, 10)
    path.restore()
    assert len(rounds(ends[1], "udp", path.first, 10)) == 10


def test_tcp_loses_nothing_but_waits(lab: Lab, ends: tuple[Host, Host], start: Start) -> None:
    """The premise of the comparison of datagrams with TCP: here a retransmission delays everything behind it."""
    path = Path(lab, *ends, seed=1, impairments=Impairments(loss=0.1, delay_s=0.005))
    start(ends[0], PROBES, "echo", "tcp", path.first).until("ready")
    found = rounds(ends[1], "tcp", path.first, 200)
    assert [number for number, _ in found] == list(range(200))
    taken = [ns for _, ns in found]
    assert statistics.median(taken) >= 0.01e9
    assert max(taken) >= 0.02e9, "there was no retransmission, which takes at least another round trip"


def test_the_seed_decides_the_fate_of_each_packet(lab: Lab, ends: tuple[Host, Host], start: Start) -> None:
    lost = []
    for _ in range(2):
        path = Path(lab, *ends, seed=7, impairments=Impairments(loss=0.3))
        process = start(ends[0], PROBES, "echo", "udp", path.first)
        process.until("ready")
        lost.append([number for number, _ in rounds(ends[1], "udp", path.first, 100)])
        process.end()
    assert lost[0] == lost[1]
