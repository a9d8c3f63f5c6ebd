"""Ages of samples on a host whose clock differs."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.hosts.impairments import Impairments
from benchmarks.hosts.namespaces import Lab
from benchmarks.hosts.path import Path
from skyloop.transport.testing import wait_until
from tests.promises.hosts import flying
from tests.promises.hosts.remote import Remote

AHEAD_S = 1000
AHEAD_NS = AHEAD_S * 1_000_000_000
PORT = 7447


def test_the_offset_of_a_different_clock_is_within_its_stated_uncertainty(
    lab: Lab, proxy: Callable[..., object], remote: Callable[..., Remote]
) -> None:
    """The directions have different delays, which no round trip reveals: half the difference is the stated error."""
    hangar, desk = lab.host("hangar"), lab.host("desk", clock_ahead_s=AHEAD_S)
    path = Path(lab, hangar, desk, seed=3)
    path.set(Impairments(delay_s=0.025, jitter_s=0.005), back=Impairments(delay_s=0.001))
    address = f"{path.first}:{PORT}"
    proxy(hangar, "alpha", "--listen", address, "--no-multicast", uri="sim://?world=empty&cameras=front")
    app = remote(desk)
    app.do(flying.connect, "alpha", network=address)
    app.do(flying.watch_frames, "alpha")

    def error_and_uncertainty_ns() -> tuple[int, int]:
        offset_ns, uncertainty_ns = app.do(flying.clock, "alpha")
        return abs(offset_ns + AHEAD_NS), uncertainty_ns  # the proxy's clock minus ours, which is ahead

    error_ns, uncertainty_ns = error_and_uncertainty_ns()
    assert 0.010e9 < error_ns <= uncertainty_ns, "(25 ms - 1 ms) / 2 cannot be seen from there"
    app.do(flying.wait_frames, "alpha", 5)
    ages_s = [age_s for _, (_, age_s, _) in app.do(flying.frames, "alpha")]
    assert min(ages_s) >= 0.025 - 0.05, "a frame travelled for 25 ms, and the clock may be wrong by 13 ms"
    assert min(ages_s) < AHEAD_S / 100, "even on a busy machine a frame is not as old as the clocks are apart"
    path.set(Impairments(delay_s=0.001))
    wait_until(lambda: error_and_uncertainty_ns()[1] < uncertainty_ns // 2, "a ping has made the estimate a better one")
    better_ns, uncertainty_ns = error_and_uncertainty_ns()
    assert better_ns <= uncertainty_ns
    app.do(flying.call, "alpha", "takeoff")  # the commands are recent by the proxy's clock
    app.do(flying.wait, "alpha", "hovering")
