"""A swarm over the network whose users stop and die: each of its flying drones fails safe."""

from __future__ import annotations

import pytest

from benchmarks import swarm

pytest.importorskip("zenoh")
pytest.importorskip("cv2")

pytestmark = pytest.mark.process


@pytest.mark.usefixtures("_possible")
def test_ten_drones_of_three_users_with_observers_fail_safe_with_their_users() -> None:
    found = swarm.measure(6.0, drones=10, users=3, observers=3)
    assert (found.drones, found.users, found.observers, found.hosts) == (10, 3, 3, True)
    verdict = found.failsafe
    # On a busy machine a user may not be scheduled for half a second: its drones fail safe before it is stopped.
    assert verdict.missed <= verdict.needless
    assert verdict.expected >= 10, (
        "each user's drones once, and the first one's twice, except for some that take off late"
    )
    assert verdict.delay is not None
    assert verdict.delay.median_us < 1e6
    assert found.command.samples > 100
    assert found.commands_per_s > 5.0
    assert found.feedback_at_observers is not None
    assert found.feedback_at_observers.samples > found.feedback.samples
    assert found.frames_per_s > 0.5
    assert set(found.cpu) == {"simulation", "users", "observers"}
