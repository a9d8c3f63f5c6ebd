"""Client, fabric transport and proxy: flying over a network, video in each requested form, clocks that differ."""

from __future__ import annotations

import time

import numpy as np
import pytest

from skyloop.client.connection import Scheduler
from skyloop.errors import UsageError
from skyloop.messages import Applied, FlightState, Velocity
from skyloop.transport.memory import MemoryServer
from tests.support.nodes import WAIT_S, Node, far, near_node, node, take
from tests.support.systems import STEP_NS

__all__ = ["far", "node"]  # fixtures

pytest.importorskip("cv2", reason="encoded video needs the extra 'network'")


def test_a_flight_over_the_network(far: Node) -> None:
    with far.connected() as drone:
        drone.takeoff()
        drone.velocity(forward=0.5)
        drone.wait(FlightState.FLYING, WAIT_S)
        drone.config["limits.speed"] = 0.3
        drone.velocity(forward=0.5)
        drone.wait(lambda _: Velocity(0.3) in list(far.vehicle.applied), WAIT_S)
        echoes: list[Applied] = []
        drone.on_command(echoes.append, inline=True)
        drone.wait(lambda _: bool(echoes), WAIT_S)
        drone.land()
        drone.wait(FlightState.LANDED, WAIT_S)
        assert drone.link.application == "up"


def test_frames_arrive_as_jpeg_from_afar_and_raw_from_near(node: Node) -> None:
    with node.connected() as drone:
        frame = drone.next_frame(timeout_s=WAIT_S)
        assert frame.shape == (24, 32, 3)
        far = not isinstance(node.proxy.server, MemoryServer)
        assert frame.header.encoding == ("jpeg" if far else "bgr8")
        assert np.allclose(frame, frame[0, 0], atol=4)
        assert "video/front" in drone.stats


def test_raw_frames_are_bit_identical(node: Node) -> None:
    with node.connected() as drone:
        for frame in take(drone.frames(encoding="raw"), 5):
            assert frame.header.encoding == "bgr8"
            assert (frame == frame[0, 0, 0]).all()


def test_smaller_frames(node: Node) -> None:
    with node.connected() as drone:
        for encoding in ("raw", "jpeg"):
            (frame,) = take(drone.frames(encoding=encoding, scale=0.5), 1)
            assert frame.shape == (12, 16, 3)
            assert (frame.header.width, frame.header.height) == (16, 12)
            assert np.allclose(frame, frame[0, 0], atol=4)


def test_fewer_frames(node: Node) -> None:
    with node.connected() as drone:
        seen = [frame.captured_ns for frame in take(drone.frames(max_fps=10.0), 6)]
        assert seen[-1] - seen[0] >= 490_000_000


def test_workers_share_the_frames(node: Node) -> None:
    with node.connected() as drone:
        numbers: list[list[int]] = [[], [], []]
        workers = [
            drone.on_frame(lambda frame, k=k: numbers[k].append(frame.seq), part=(k, 3), depth=8)  # type: ignore[misc]
            for k in range(3)
        ]
        drone.wait(lambda _: all(len(mine) >= 5 for mine in numbers), WAIT_S)
        for worker in workers:
            worker.cancel()
        for k, mine in enumerate(numbers):
            assert {number % 3 for number in mine} == {k}


def test_two_forms_of_one_camera_at_the_same_time(node: Node) -> None:
    with node.connected() as drone:
        small = drone.frames(scale=0.25)
        large = drone.frames(encoding="raw")
        for _ in range(3):
            assert next(small).shape == (6, 8, 3)
            assert next(large).shape == (24, 32, 3)
        small.close()  # type: ignore[attr-defined]
        assert next(large).shape == (24, 32, 3)


def test_invalid_forms_are_refused(node: Node) -> None:
    with node.connected() as drone:
        for wrong in (
            {"scale": 0.0},
            {"scale": 2.0},
            {"max_fps": -1.0},
            {"quality": 101},
            {"encoding": "png"},
            {"encoding": "raw", "quality": 5},
            {"part": (3, 3)},
        ):
            with pytest.raises(UsageError, match=r"must be|the encoding is"):
                next(drone.frames(**wrong))


def test_nothing_is_encoded_without_a_subscriber(far: Node) -> None:
    server = far.proxy.server
    with far.connected() as drone:
        frames = drone.frames(max_fps=20)
        next(frames)
        assert server.subscribers("video/front") == 1
        frames.close()  # type: ignore[attr-defined]
        drone.wait(lambda _: server.subscribers("video/front") == 0, WAIT_S)


class Wrong:
    """A clock that has an offset and runs fast."""

    def __init__(self, ahead_s: float, drift: float) -> None:
        self._ahead_ns = round(ahead_s * 1e9)
        self._drift = drift
        self._start_ns = time.monotonic_ns()

    def __call__(self) -> int:
        now_ns = time.monotonic_ns()
        return now_ns + self._ahead_ns + round(self._drift * (now_ns - self._start_ns))

    @property
    def truth_ns(self) -> int:
        """The proxy's clock minus this one."""
        return time.monotonic_ns() - self()


@pytest.mark.parametrize("ahead_s", [-300.0, 86_400.0])
def test_ages_are_within_their_uncertainty_whatever_the_clocks(far: Node, ahead_s: float) -> None:
    clock = Wrong(ahead_s, drift=150e-6)
    with far.connected(scheduler=Scheduler(clock)) as drone:
        drone.takeoff()
        for _ in range(20):
            before_ns = clock.truth_ns
            uncertainty_ns = drone.clock_uncertainty_ns
            assert 0 < uncertainty_ns < 50_000_000
            assert abs(drone.clock_offset_ns - before_ns) <= uncertainty_ns + 100_000 + STEP_NS
            sample = drone.next_feedback(WAIT_S)
            earliest_s = (time.monotonic_ns() - sample.captured_ns) / 1e9
            age_s = drone.age_s(sample)
            latest_s = (time.monotonic_ns() - sample.captured_ns) / 1e9
            wrong_s = (drone.clock_uncertainty_ns + 100_000 + STEP_NS) / 1e9
            assert earliest_s - wrong_s <= age_s <= latest_s + wrong_s
        frame = drone.next_frame(timeout_s=WAIT_S)
        assert frame.age_s == pytest.approx((time.monotonic_ns() - frame.captured_ns) / 1e9, abs=0.06)
        stats = drone.stats
        assert stats["feedback"].uncertainty_s > 0.0
        delay = stats["feedback"].delay_s
        assert delay is not None
        assert delay.median > -stats["feedback"].uncertainty_s - 0.01
        assert far.proxy.handler.airborne, "the commands counted as stale"


def test_one_host_needs_no_estimate() -> None:
    near = near_node()
    with near.proxy, near.connected() as drone:
        assert drone.clock_uncertainty_ns == 0
        assert drone.stats["feedback"].uncertainty_s == 0.0
