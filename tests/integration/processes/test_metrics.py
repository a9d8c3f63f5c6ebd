"""``--metrics``: a process prints the address of its metrics, and serves them until it ends."""

from __future__ import annotations

import re
import signal
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.processes import Process, skyloop_command


def scraped(process: Process) -> str:
    place = re.search(r"metrics: (http://127\.0\.0\.1:\d+/metrics)\n", process.text)
    assert place is not None
    with urllib.request.urlopen(place[1], timeout=10) as answer:
        return str(answer.read().decode())


@pytest.mark.daily
def test_a_proxy(start: Callable[..., Process]) -> None:
    process = start("-m", "skyloop", "proxy", "sim://?world=empty&cameras=none", "--name", "alpha", "--metrics", "0")
    process.until("ready")
    text = scraped(process)
    assert 'skyloop_vehicle_info{family="sim",vehicle="alpha"} 1.0' in text
    assert "process_cpu_seconds_total" in text
    process.signal(signal.SIGTERM)
    assert process.wait() == 0
    with pytest.raises(OSError, match="refused"):
        scraped(process)


def test_a_host(start: Callable[..., Process], tmp_path: Path) -> None:
    fleet = tmp_path / "fleet.toml"
    address = "sim://?world=empty&cameras=none"
    fleet.write_text("\n".join(f'[[vehicle]]\nname = "{name}"\naddress = "{address}"' for name in ("one", "two")))
    process = start("-m", "skyloop", "host", str(fleet), "--metrics", "0")
    process.until("hosting 2 of 2")
    text = scraped(process)
    for name in ("one", "two"):
        assert f'skyloop_vehicle_state{{state="landed",vehicle="{name}"}}' in text


def test_a_router(start: Callable[..., Process]) -> None:
    where = ("--network", "127.0.0.1:1", "--listen", "127.0.0.1:0", "--no-multicast")
    process = start("-m", "skyloop", "router", *where, "--metrics", "0")
    process.until("ready")
    assert 'skyloop_router_links{kind="peer"} 0.0' in scraped(process)
    process.signal(signal.SIGTERM)
    assert process.wait() == 0


def test_an_invalid_address_is_refused_before_anything_starts() -> None:
    said = skyloop_command("proxy", "sim://", "--metrics", "nowhere", code=2)
    assert "'nowhere' is not an address for metrics" in said
    assert "ready" not in said
    said = skyloop_command("sim", "--firmware", "tello", "--metrics", "0", code=2)
    assert "--metrics is for proxies" in said
