"""The endpoint over HTTP: its answers, its access rules, and its independence from stalled readers."""

from __future__ import annotations

import http.client
import logging
import socket
import sys
import time
import urllib.request
from collections.abc import Iterable, Iterator

import pytest
from prometheus_client.metrics_core import Metric
from prometheus_client.openmetrics import parser as openmetrics
from prometheus_client.parser import text_string_to_metric_families as parse_plain

from skyloop.errors import MissingExtraError, UsageError
from skyloop.metrics import FAMILIES, Endpoint, Reading, proxy_readings, serve, serve_proxies, serving_beside
from skyloop.metrics.endpoint import MAX_SCRAPES, parse_where
from tests.support.proxy_bench import Bench

OPEN = {"Accept": "application/openmetrics-text; version=1.0.0"}


def parsed(text: str) -> list[Metric]:
    return list(openmetrics.text_string_to_metric_families(text))  # type: ignore[no-untyped-call]


def readings() -> Iterable[Reading]:
    yield Reading("skyloop_applications", 3.0, ("alpha",))
    yield Reading("skyloop_vehicle_info", 1.0, ("alpha", "sim"))
    yield Reading("skyloop_commands_refused_total", 2.0, ("alpha", "stale"))


@pytest.fixture
def endpoint() -> Iterator[Endpoint]:
    with serve(lambda: [readings], "0", deadline_s=0.5) as endpoint:
        yield endpoint


def get(endpoint: Endpoint, path: str = "/metrics", **headers: str) -> tuple[int, str, str]:
    connection = http.client.HTTPConnection("127.0.0.1", endpoint.port, timeout=10)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers["Content-Type"], answer.read().decode()
    finally:
        connection.close()


def test_openmetrics_and_prometheus_can_read_it(endpoint: Endpoint) -> None:
    assert endpoint.url == f"http://127.0.0.1:{endpoint.port}/metrics"
    status, kind, text = get(endpoint, **OPEN)
    assert status == 200
    assert kind.startswith("application/openmetrics-text")
    found = {family.name: family for family in parsed(text)}
    (sample,) = found["skyloop_commands_refused"].samples
    assert (sample.name, sample.labels, sample.value) == (
        "skyloop_commands_refused_total",
        {"vehicle": "alpha", "reason": "stale"},
        2.0,
    )
    (info,) = found["skyloop_vehicle"].samples
    assert info.labels == {"vehicle": "alpha", "family": "sim"}
    assert found["skyloop_applications"].documentation == FAMILIES["skyloop_applications"].meaning
    assert "process_resident_memory_bytes" in found
    status, kind, text = get(endpoint)
    assert kind.startswith("text/plain")
    assert {family.name for family in parse_plain(text)} >= {"skyloop_applications", "skyloop_vehicle_info"}


def test_other_paths_and_other_hosts(endpoint: Endpoint) -> None:
    assert get(endpoint, "/")[::2] == (404, "the metrics are at /metrics\n")
    assert get(endpoint, "/metrics?x=1")[0] == 200
    assert get(endpoint, Host="evil.example")[0] == 403
    assert get(endpoint, Host="evil.example:80")[0] == 403
    for host in ("localhost", "localhost:9000", "127.0.0.1:1", "127.0.0.1", "[::1]:80", "[::1]"):
        assert get(endpoint, Host=host)[0] == 200, host


def test_stalled_readers_neither_stay_nor_keep_others_out(endpoint: Endpoint) -> None:
    stalled = []
    for number in range(MAX_SCRAPES):
        one = socket.create_connection(("127.0.0.1", endpoint.port), timeout=10)
        if number % 2:
            one.sendall(b"GET /metr")  # an incomplete request
        stalled.append(one)
    for _ in range(20):
        assert get(endpoint)[0] == 200, "a request takes the place of the oldest silent connection"
    for one in stalled:
        while one.recv(100):
            pass  # closed at its deadline
        one.close()
    deadline = time.monotonic() + 10
    while True:
        try:
            assert get(endpoint)[0] == 200
            break
        except OSError:  # the last place is freed in a moment
            assert time.monotonic() < deadline


def test_an_occasional_byte_does_not_hold_a_place(endpoint: Endpoint) -> None:
    def drip() -> None:
        with socket.create_connection(("127.0.0.1", endpoint.port), timeout=10) as one:
            deadline = time.monotonic() + 10
            while time.monotonic() < deadline:
                one.sendall(b"x")
                time.sleep(0.02)

    with pytest.raises(OSError, match=r"(?i)reset|pipe"):
        drip()


def test_a_source_that_fails_is_missing_counted_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    def broken() -> Iterable[Reading]:
        yield Reading("skyloop_applications", 1.0, ("half",))
        raise RuntimeError("it is broken")

    with serve(lambda: [broken, readings], "0") as endpoint, caplog.at_level(logging.ERROR):
        for count in (1, 2):
            text = get(endpoint)[2]
            assert 'skyloop_applications{vehicle="alpha"} 3.0' in text
            assert "half" not in text
            assert f"skyloop_scrape_errors_total {count}.0" in text
    assert "it is broken" in caplog.text


def test_proxies_come_and_go() -> None:
    benches = [Bench()]
    with serve_proxies(lambda: [bench.proxy for bench in benches], "127.0.0.1:0") as endpoint:
        assert 'skyloop_applications{vehicle="bench"} 0.0' in get(endpoint)[2]
        benches.clear()
        assert "skyloop_applications" not in get(endpoint)[2]
    with pytest.raises(OSError, match=r"(?i)refused"):
        urllib.request.urlopen(endpoint.url, timeout=5)


def test_all_readings_of_a_proxy_can_be_parsed() -> None:
    with Bench() as bench:
        bench.airborne()
        with serve(lambda: [lambda: proxy_readings(bench.proxy)], "0") as endpoint:
            text = get(endpoint, **OPEN)[2]
    names = {sample.name for family in parsed(text) for sample in family.samples}
    assert {name for name in names if name.startswith("skyloop_")} <= set(FAMILIES)


@pytest.mark.parametrize(
    ("where", "found"),
    [
        ("9464", ("127.0.0.1", 9464)),
        ("0.0.0.0:0", ("0.0.0.0", 0)),
        ("[::1]:80", ("::1", 80)),
        ("lab.example:1", ("lab.example", 1)),
    ],
)
def test_addresses(where: str, found: tuple[str, int]) -> None:
    assert parse_where(where) == found


@pytest.mark.parametrize("where", ["", "x", ":", ":80", "127.0.0.1", "127.0.0.1:", "1:65536", "-1", "٣"])
def test_invalid_addresses(where: str) -> None:
    with pytest.raises(UsageError, match="is not an address for metrics"):
        serve(list, where)


def test_a_taken_port_and_a_foreign_host(endpoint: Endpoint) -> None:
    with pytest.raises(UsageError, match=f"metrics can't be served at 127.0.0.1, port {endpoint.port}"):
        serve(list, str(endpoint.port))
    with pytest.raises(UsageError, match=r"metrics can't be served at 192\.0\.2\.1"):
        serve(list, "192.0.2.1:0")


def test_beyond_loopback_there_is_a_warning() -> None:
    said: list[str] = []
    with serving_beside("0.0.0.0:0", said.append)([]):
        pass
    with serving_beside("0", said.append)([]):
        pass
    assert "WARNING: anyone who reaches this address can read them" in said[0]
    assert "WARNING" not in said[1]


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(MissingExtraError, match=r"skyloop install metrics"):
        serve(list, "0")
