"""Nothing is left behind."""

from __future__ import annotations

import gc
import threading
import weakref
from pathlib import Path

import pytest

from skyloop.client.drone import open_drone
from skyloop.errors import AuthorityError
from tests.support.scripted_proxy import QUICK, scripted


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_fifty_drones_leave_no_thread_and_no_descriptor() -> None:
    with scripted() as proxy:
        gc.collect()  # leftovers of earlier tests must not go during the test
        before_threads, before_descriptors = set(threading.enumerate()), descriptors()
        for number in range(50):
            drone = open_drone(proxy.server.dial, app=f"app {number}", policy=QUICK)
            drone.on_frame(lambda frame: None)
            drone.on_feedback(lambda feedback: None)
            drone.on_event(lambda event: None)
            drone.frame()
            drone.close()
        gc.collect()
        assert set(threading.enumerate()) - before_threads == set()
        assert descriptors() == before_descriptors
        assert proxy.server.subscribers("feedback") == 0


def test_a_connect_that_fails_leaves_nothing() -> None:
    with scripted() as proxy:
        proxy.grant(99, "ada")
        before = set(threading.enumerate())
        for _ in range(5):
            with pytest.raises(AuthorityError):
                open_drone(proxy.server.dial, app="me", policy=QUICK)
        assert set(threading.enumerate()) - before == set()


def test_a_closed_drone_is_garbage() -> None:
    with scripted() as proxy:
        drone = open_drone(proxy.server.dial, app="me", policy=QUICK)
        drone.on_feedback(lambda feedback: None)
        drone.close()
        gone = weakref.ref(drone)
        del drone
    gc.collect()
    assert gone() is None
