"""Applications that the tests start as separate processes: ``python pilots.py WHAT NAME …``."""

from __future__ import annotations

import sys
import time

import skyloop


def fly(name: str, priority: str = "16") -> None:
    """Take off and fly forward, sending a new command ten times a second, until killed."""
    with skyloop.connect(name, name="doomed", authority=skyloop.Authority(priority=int(priority))) as drone:
        drone.takeoff()
        print("flying", flush=True)
        while True:
            drone.velocity(forward=0.5)
            time.sleep(0.1)


def observe(name: str) -> None:
    """Read everything an observer can read, and print that it works."""
    with skyloop.connect(name, name="watcher", access="observe") as drone:
        if drone.capabilities.cameras:
            drone.next_frame(timeout_s=30.0)
        print("observing", flush=True)
        while True:
            drone.next_feedback(timeout_s=60.0)


if __name__ == "__main__":
    {"fly": fly, "observe": observe}[sys.argv[1]](*sys.argv[2:])
