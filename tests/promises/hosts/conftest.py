"""Hosts for a test, and processes on them; skipped with the reason where none can be made."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest

from benchmarks.hosts.namespaces import Host, Lab, Segment, problem
from benchmarks.measuring.workers import Workers
from tests.promises.hosts.remote import Remote
from tests.support.processes import Process

#: A vehicle without cameras, in a world running three times as fast: it flies no better, but takes off sooner.
FAST = "sim://?world=empty&cameras=none&speed=3"


@pytest.fixture(scope="session")
def _possible() -> None:
    if why := problem():
        pytest.skip(f"no hosts can be made here: {why}")


@pytest.fixture
def lab(_possible: None) -> Iterator[Lab]:
    with Lab() as made:
        yield made


@dataclass(frozen=True)
class Lan:
    """Hosts of one segment, whose programs discover each other."""

    lab: Lab
    segment: Segment

    def host(self, name: str, *, clock_ahead_s: float = 0.0) -> Host:
        host = self.lab.host(name, clock_ahead_s=clock_ahead_s, environment={"SKYLOOP_NETWORK": "multicast"})
        self.segment.join(host)
        return host


@pytest.fixture
def lan(lab: Lab) -> Lan:
    pytest.importorskip("zenoh")
    return Lan(lab, lab.segment("10.77.1.0/24"))


@pytest.fixture
def remote(lab: Lab) -> Iterator[Callable[[Host], Remote]]:
    """Starts applications that obey the test. They end with the test, before the hosts."""
    with Workers() as workers:
        yield lambda host: Remote(workers, host)


@pytest.fixture
def proxy(start: Callable[..., Process]) -> Callable[..., Process]:
    """Starts a proxy on a host and waits until it serves."""

    def begin(host: Host, name: str = "alpha", *options: str, uri: str = FAST) -> Process:
        process = start(host, "-m", "skyloop", "proxy", uri, "--name", name, "--network", *options)
        process.until("ready")
        return process

    return begin


@pytest.fixture
def start(lab: Lab) -> Iterator[Callable[..., Process]]:
    """Starts Python processes on hosts: ``start(host, *arguments)``. They end with the test, before the hosts."""
    running: list[Process] = []

    def begin(host: Host, *arguments: str) -> Process:
        process = Process(*arguments, prefix=host.prefix)
        running.append(process)
        return process

    yield begin
    for process in reversed(running):
        process.end()
