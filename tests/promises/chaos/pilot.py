"""A pilot that calls 32 times a second, forever: ``python -m tests.promises.chaos.pilot NAME FOLDER``; see ``--help``.

It journals each take-off that it requests, and the start and end of each other call, with its number. On SIGUSR1 it
forks, and the child ends by ``sys.exit``.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import time
from itertools import count
from pathlib import Path

import skyloop
from skyloop.client import Drone
from skyloop.errors import SkyloopError
from tests.promises.chaos.journal import Journal, read
from tests.promises.chaos.vehicle import NUMBER_RAD_S, NUMBERS

PERIOD_S = 1.0 / 32.0
#: A take-off that has not begun within this is requested again.
BEGINS_WITHIN_S = 8.0


class Pilot:
    """Takes off, and flies whenever it may.

    Args:
        drone: The drone it flies.
        journal: The journal of its calls.
        first: The number of its first call.
        rest_s: How long to wait on the ground before the next take-off, with the sticks held [s].
    """

    def __init__(self, drone: Drone, journal: Journal, first: int, rest_s: float) -> None:
        self._drone = drone
        self._journal = journal
        self._numbers = count(first)
        self._rest_s = rest_s
        self._landed_s: float | None = -math.inf  # time of the landing
        self._asked_s: float | None = None  # when the present take-off was requested
        self.forks = False

    def step(self, now_s: float) -> None:
        """Make the calls that are due."""
        if self.forks:
            self.forks = False
            if os.fork() == 0:
                sys.exit()
        if self._drone.authority.state != "held":
            return
        state = self._drone.feedback().state
        if state != "landed":
            self._landed_s = None
            if state in ("hovering", "flying"):
                self._asked_s = None
            if self._asked_s is None or self._rest_s == 0.0:  # a velocity would replace the take-off
                self._steer()
            return
        self._landed_s = now_s if self._landed_s is None else self._landed_s
        if self._asked_s is not None and (self._landed_s > self._asked_s or now_s > self._asked_s + BEGINS_WITHIN_S):
            self._asked_s = None  # it was landed or disarmed, or did not begin
        if self._rest_s == 0.0 or (self._asked_s is None and now_s - self._landed_s >= self._rest_s):
            self._take_off(now_s)
        elif self._asked_s is None:
            self._steer()

    def _take_off(self, now_s: float) -> None:
        self._asked_s = now_s
        self._journal.write("ask_takeoff")
        try:
            self._drone.takeoff(wait=False)
        except SkyloopError as error:
            print(error, flush=True)

    def _steer(self) -> None:
        number = next(self._numbers)
        self._journal.write("call", number)
        self._drone.velocity(yaw_rate=(number % NUMBERS) * NUMBER_RAD_S)
        self._journal.write("called", number)


def main() -> None:
    """Fly until killed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--network", help="where it meets the proxy [on this host]")
    parser.add_argument("--rest", type=float, default=0.0, help="from a landing to the next take-off [s]")
    given = parser.parse_args()
    path = given.folder / f"{given.name}.pilot"
    first = max((entry.number for entry in read(path)), default=0) + 1
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the system reaps children
    with skyloop.connect(
        given.name,
        name="chaos",
        network=given.network or False,
        timeout_s=60.0,
        authority=skyloop.Authority(wait_s=60.0),
    ) as drone:
        pilot = Pilot(drone, Journal(path), first, given.rest)
        signal.signal(signal.SIGUSR1, lambda *_: setattr(pilot, "forks", True))
        print("flying", flush=True)
        due_s = time.monotonic()
        while True:
            pilot.step(time.monotonic())
            due_s += PERIOD_S
            behind_s = time.monotonic() - due_s
            if behind_s < 0.0:
                time.sleep(-behind_s)
            elif behind_s > PERIOD_S:
                due_s = time.monotonic()  # it was stopped, or starved


if __name__ == "__main__":
    main()
