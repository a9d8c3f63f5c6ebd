"""Run by ``test_ray.py`` in a Python that has Ray: two actors share the frames of alpha, and one of them is killed."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from typing import Any

import skyloop
import skyloop.ray


def seen(drone: skyloop.Drone, seconds: float) -> list[int]:
    """Return the workers whose results arrived within this time."""
    workers = set()
    end = time.monotonic() + seconds
    for result in drone.results("marks", timeout_s=20.0):
        workers.add(result.worker)
        if time.monotonic() > end:
            return sorted(workers)
    raise AssertionError("the drone was closed")


def main(target: str) -> dict[str, Any]:
    import ray

    found: dict[str, Any] = {"ray": ray.__version__}
    with skyloop.connect("alpha", access="observe") as drone:
        began = time.monotonic()
        with skyloop.ray.process(target, drone="alpha", workers=2, num_cpus=0.5) as workers:
            found["started_s"] = time.monotonic() - began
            found["before"] = seen(drone, 1.0)
            found["parts"] = [status.parts for status in workers.statuses() if status is not None]
            pid = next(result.value["pid"] for result in drone.results("marks", timeout_s=20.0))
            os.kill(pid, signal.SIGKILL)
            deadline = time.monotonic() + 40.0
            while len(after := set(seen(drone, 1.0)) - {0}) < 2 or after == set(found["before"]):
                assert time.monotonic() < deadline, after
            found["after"] = sorted(after)
            try:
                skyloop.ray.process(target.replace("Marks", "Others"), drone="alpha", name="marks", num_cpus=0.1)
            except skyloop.LinkError as error:
                found["other"] = str(error)
    ray.shutdown()
    return found


if __name__ == "__main__":
    print("FOUND " + json.dumps(main(sys.argv[1])), flush=True)
