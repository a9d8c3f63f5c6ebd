"""``skyloop list`` queries a process with several vehicles only once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from skyloop.cli import listing
from skyloop.clock import monotonic_ns
from skyloop.errors import NoAnswerError
from skyloop.messages import FlightState
from skyloop.proxy import Proxy
from skyloop.proxy.topics import OverviewRegistry
from skyloop.transport.local import LocalServer
from tests.support.proxy_bench import FakeDriver

NAMES = ["alpha", "bravo", "carol"]


@pytest.fixture
def proxies(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Proxy]]:
    """Three proxies of this process."""
    with TemporaryDirectory(prefix="skyloop-") as directory:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(directory) / "run"))
        registry = OverviewRegistry()
        made = [Proxy(FakeDriver(monotonic_ns), LocalServer(name), name=name) for name in NAMES]
        for proxy in made:
            proxy.overview.share(registry)
            proxy.start()
        yield made
        for proxy in made:
            proxy.end()


def test_one_connection_for_all_of_a_process(proxies: list[Proxy], monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    real = listing.observed

    def observed(row: listing.Row, *rest: object) -> object:
        asked.append(row.name)
        return real(row, None)

    monkeypatch.setattr(listing, "observed", observed)
    rows = listing.running()
    assert [(row.name, row.state, row.battery, row.uri) for row in rows] == [
        (name, FlightState.LANDED.value, 0.9, "fake://") for name in NAMES
    ]
    assert len(asked) == 1
    assert len({row.pid for row in rows}) == 1


def test_vehicles_missing_from_the_overview_are_queried(proxies: list[Proxy]) -> None:
    proxies[1].overview.end()  # like one that keys exclude from the others' overview
    assert [row.state for row in listing.running()] == ["landed"] * 3


def test_a_process_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(row: listing.Row, *rest: object) -> object:
        raise NoAnswerError(f"{row.name} is silent")

    monkeypatch.setattr(listing, "observed", silent)
    rows = [listing.Row("a", pid=1, host="here"), listing.Row("b", pid=1, host="here")]
    assert [row.problem for row in listing.reported(rows, None)] == ["a is silent", "b is silent"]
    assert listing.of_one_process([*rows, listing.Row("c"), listing.Row("d")]) == [
        rows,
        [listing.Row("c")],
        [listing.Row("d")],
    ]
