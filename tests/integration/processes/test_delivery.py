"""Consumers that are slow, stopped, numerous, or gone."""

from __future__ import annotations

import signal
import statistics
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from skyloop.messages import FlightState
from skyloop.transport.local import dial
from tests.support.processes import PILOTS, Process, eventually

pytestmark = pytest.mark.process

FPS = 30


def test_a_slow_processor_gets_new_frames_only_and_the_fast_one_gets_all(proxy: Callable[..., Process]) -> None:
    proxy(f"sim://?world=empty&cameras=front&fps={FPS}&latency=0")
    with skyloop.connect("alpha", access="observe") as drone:
        behind: list[int] = []  # frames that had arrived after the one that the slow processor is given
        seen: list[int] = []

        def slow(frame: skyloop.Frame) -> None:
            newest = drone.frame()
            behind.append(newest.seq - frame.seq if newest is not None else 0)
            time.sleep(0.2)

        slow_one = drone.on_frame(slow)
        fast_one = drone.on_frame(lambda frame: seen.append(frame.seq))
        eventually(lambda: len(seen) >= 3 * FPS, "three seconds of video")
        drops = slow_one.dropped
        assert drops > 1.5 * FPS
        assert slow_one.delivered + drops == pytest.approx(fast_one.delivered + fast_one.dropped, abs=2)
        assert fast_one.dropped <= 0.05 * len(seen)  # none, on a machine with enough processor time
        assert sorted(behind)[len(behind) * 9 // 10] <= 2


def test_a_stopped_observer_delays_no_one_and_is_served_again(
    proxy: Callable[..., Process], start: Callable[..., Process]
) -> None:
    proxy("sim://?world=empty&cameras=front&fps=30")
    with skyloop.connect("alpha") as drone:
        observer = start(PILOTS, "observe", "alpha")
        observer.until("observing")
        observer.signal(signal.SIGSTOP)
        drone.takeoff()
        ages: list[float] = []
        listener = drone.on_feedback(lambda f: ages.append((time.monotonic_ns() - f.published_ns) / 1e9), inline=True)
        frames: list[int] = []
        drone.on_frame(lambda frame: frames.append(frame.seq))
        # 4 s of feedback and video are far more than the buffers of the stopped one can take
        eventually(lambda: len(frames) > 4 * FPS, "video flows on")
        assert drone.stats["feedback"].lost == 0
        assert statistics.median(ages) < 0.01
        assert drone.feedback().state is FlightState.HOVERING
        listener.cancel()
        observer.signal(signal.SIGCONT)
        drone.land()


class Nobody:
    def packet(self, packet: bytes) -> None: ...
    def frame(self, header: object, pixels: object, topic: str = "") -> None: ...
    def closed(self, reason: str) -> None: ...


def count(folder: str) -> int:
    return sum(1 for _ in Path(folder).iterdir())


def test_a_thousand_connections_leave_nothing_behind(proxy: Callable[..., Process], sockets: Path) -> None:
    process = proxy("sim://?world=empty&cameras=front&fps=30")

    def resources() -> tuple[int, int, int]:
        maps = Path(f"/proc/{process.pid}/maps").read_text().count("memfd")
        return count(f"/proc/{process.pid}/fd"), count(f"/proc/{process.pid}/task"), maps

    with skyloop.connect("alpha", access="observe") as drone:
        drone.next_frame(timeout_s=30.0)

    before, own_before, threads_before = resources(), count("/proc/self/fd"), threading.active_count()
    dialer = dial("alpha")
    for _ in range(950):
        end = dialer(Nobody())
        end.subscribe("video/front")
        end.close()
    for _ in range(50):
        with skyloop.connect("alpha", access="observe") as drone:
            drone.frame()
    eventually(lambda: resources()[0] <= before[0] and resources()[1] <= before[1], f"{resources()} is {before} again")
    assert resources()[2] <= before[2] + 4
    assert count("/proc/self/fd") <= own_before
    assert threading.active_count() <= threads_before
    assert {path.suffix for path in sockets.iterdir()} <= {".sock", ".port", ".lock", ""}
