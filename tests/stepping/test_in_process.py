"""A simulated drone whose proxy runs in the application's process."""

from __future__ import annotations

import subprocess
import threading

import pytest

import skyloop
from skyloop.client.drone import open_drone
from skyloop.errors import UnknownNameError, UsageError
from skyloop.stepping.in_process import InProcess, connector
from skyloop.transport.testing import wait_until

CALM = "sim://?process=none&world=empty&cameras=none&noise=0&wind=0"


def started() -> InProcess:
    way = connector(CALM)
    assert way is not None
    return way


def leaving(way: InProcess) -> skyloop.Drone:
    """Return a pilot's drone that is left hovering at the end of its block."""
    return open_drone(way.dialer(0.0), app="leaves", scheduler=way.scheduler, timeout_s=10.0, on_exit="hover")


def test_it_flies_without_a_second_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a process was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    with skyloop.connect(CALM) as drone:
        drone.takeoff()
        height = drone.feedback().altitude_m
        assert height is not None
        assert height > 0.5
        drone.land()
    wait_until(lambda: "skyloop-ticker" not in {thread.name for thread in threading.enumerate()}, "the proxy has ended")


def test_a_drone_left_in_the_air_is_landed() -> None:
    way = started()
    with leaving(way) as drone:
        drone.takeoff()
    assert way._proxy.handler.airborne
    way.close()
    wait_until(lambda: way._proxy.ended, "the proxy has ended")
    assert not way._proxy.handler.airborne
    way.close()


def test_a_drone_that_its_pilot_leaves_is_landed_by_the_failsafe() -> None:
    way = started()
    try:
        with open_drone(
            way.dialer(0.0), app="leaves", scheduler=way.scheduler, timeout_s=10.0, on_exit="hover"
        ) as drone:
            drone.config["failsafe.land_after_s"] = 1.0
            drone.takeoff()
        wait_until(lambda: not way._proxy.handler.airborne, "it has landed")
        assert not way._proxy.ended
    finally:
        way.close()


@pytest.mark.parametrize(
    ("address", "error", "text"),
    [
        ("sim://?process=own", UsageError, "process is 'own' and must be none"),
        ("sim://?process=", UsageError, "must be none"),
        ("sim://?process=none&colour=red", UnknownNameError, "no option of sim:// named 'colour'"),
        ("sim://?process=none&world=nowhere", UnknownNameError, "no world named 'nowhere'"),
    ],
)
def test_a_bad_address_is_refused(address: str, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        skyloop.connect(address)


@pytest.mark.parametrize("address", ["sim://", "sim://?seed=3", "sim://?world=process=none.toml&seed=1"])
def test_other_addresses_get_a_process_of_their_own(address: str) -> None:
    assert connector(address) is None
