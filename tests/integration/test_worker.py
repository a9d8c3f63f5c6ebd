"""Workers: joining, staying a member, and their shares, over a real proxy in this process."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from skyloop.client import Drone, Result
from skyloop.client.drone import open_drone
from skyloop.client.publishing import Membership
from skyloop.errors import NameTakenError, UnknownNameError, UsageError
from skyloop.extend import join_processor
from tests.support.fake_vehicle import WAIT_S, Node, node
from tests.support.scripted_proxy import QUICK

__all__ = ["node"]  # a fixture


@contextmanager
def observer(node: Node, app: str = "one") -> Iterator[Drone]:
    with open_drone(node.server.dial, app=app, access="observe", policy=QUICK) as drone:
        yield drone


@pytest.fixture
def drone(node: Node) -> Iterator[Drone]:
    with observer(node) as drone:
        yield drone


def part(membership: Membership) -> tuple[int, int] | None:
    share = membership.share
    return None if share is None else (share.part, share.parts)


def test_shares_follow_the_workers(node: Node, drone: Drone) -> None:
    one = join_processor(drone, "detector", code="Detector 1")
    assert part(one) == (0, 1)
    with observer(node, "two") as other:
        two = join_processor(other, "detector", code="Detector 1")
        assert part(two) == (1, 2)
        drone.wait(lambda _: part(one) == (0, 2), WAIT_S)
    drone.wait(lambda _: part(one) == (0, 1), WAIT_S)


def test_a_worker_that_is_not_ready_has_no_share(node: Node, drone: Drone) -> None:
    one = join_processor(drone, "detector", code="Detector 1")
    able = threading.Event()
    one.ready = able.is_set
    one.renew()
    drone.wait(lambda _: part(one) == (0, 0), WAIT_S)
    able.set()
    drone.wait(lambda _: part(one) == (0, 1), WAIT_S)  # automatically, at the next renewal


def test_results_are_published(node: Node, drone: Drone) -> None:
    got: list[Result] = []
    with observer(node, "eye") as eye:
        eye.on_result(got.append, "detector")
        eye.wait(lambda _: node.server.subscribers("results/detector") == 1, WAIT_S)
        one = join_processor(drone, "detector", code="Detector 1")
        frame = drone.next_frame(timeout_s=WAIT_S)
        assert one.publish(frame, {"x": 2}, took_s=0.01)
        eye.wait(lambda _: bool(got), WAIT_S)
        [result] = got
        assert (result.seq, result.captured_ns, result.value) == (frame.seq, frame.captured_ns, {"x": 2})
        assert (result.worker, result.took_s) == (drone.app_id, 0.01)
        assert result.made_ns >= frame.published_ns
        with pytest.raises(UsageError, match="can't be sent"):
            one.publish(frame, object())


def test_other_code_under_the_same_name_is_refused(node: Node, drone: Drone) -> None:
    join_processor(drone, "detector", code="Detector 1")
    with observer(node, "two") as other:
        with pytest.raises(NameTakenError, match=r"one \(application 1\) runs other code under the name detector"):
            join_processor(other, "detector", code="Detector 2")
        assert part(join_processor(other, "detector2", code="Detector 2")) == (0, 1)


def test_bad_arguments(drone: Drone) -> None:
    with pytest.raises(UsageError, match="name of a processor"):
        join_processor(drone, "a b", code="")
    with pytest.raises(UnknownNameError, match="no camera named 'frnt'"):
        join_processor(drone, "detector", code="", camera="frnt")
    with pytest.raises(UsageError, match="code"):
        join_processor(drone, "detector", code="x" * 129)


def test_a_restarted_proxy_is_joined_again(node: Node, drone: Drone) -> None:
    one = join_processor(drone, "detector", code="Detector 1")
    node.restart()
    drone.wait(lambda _: part(one) == (0, 1), WAIT_S)
    assert one.refused is None


def test_a_worker_may_end_before_its_drone(drone: Drone) -> None:
    one = join_processor(drone, "detector", code="Detector 1")
    one.close()
    one.close()
    assert part(one) is None


def test_a_name_taken_while_the_proxy_was_away_is_reported(node: Node, drone: Drone) -> None:
    one = join_processor(drone, "detector", code="Detector 1")
    with observer(node, "two") as other:
        join_processor(other, "detector", code="Detector 1")
        one.code = "Detector 2"  # as when this worker comes back after the other one
        one.renew()
        drone.wait(lambda _: one.refused is not None, WAIT_S)
        assert part(one) is None
        assert "two (application" in str(one.refused)


def test_membership_ends_with_the_drone(node: Node) -> None:
    before = set(threading.enumerate())
    with observer(node) as drone:
        join_processor(drone, "detector", code="Detector 1")
    assert set(threading.enumerate()) - before == set()
