"""A pilot that calls 32 times a second, for ever: ``python -m tests.chaos.pilot NAME FOLDER [NETWORK]``.

It journals the beginning and the end of each call, with its number.
"""

from __future__ import annotations

import sys
import time
from itertools import count
from pathlib import Path

import skyloop
from skyloop.errors import SkyloopError
from tests.chaos.journal import Journal, read
from tests.chaos.vehicle import NUMBER_RAD_S, NUMBERS

PERIOD_S = 1.0 / 32.0


def fly(name: str, folder: Path, network: str | None) -> None:
    """Take off, and fly on whenever it may."""
    path = folder / f"{name}.pilot"
    first = max((entry.number for entry in read(path)), default=0) + 1
    journal = Journal(path)
    with skyloop.connect(
        name, name="chaos", network=network or False, timeout_s=60.0, authority=skyloop.Authority(wait_s=60.0)
    ) as drone:
        print("flying", flush=True)
        due = time.monotonic()
        for number in count(first):
            held, landed = drone.authority.state == "held", drone.feedback().state == "landed"
            if held and landed:
                try:
                    drone.takeoff(wait=False)
                except SkyloopError as error:
                    print(error, flush=True)
            elif held:
                journal.write("call", number)
                drone.velocity(yaw_rate=(number % NUMBERS) * NUMBER_RAD_S)
                journal.write("called", number)
            due += PERIOD_S
            behind_s = time.monotonic() - due
            if behind_s < 0.0:
                time.sleep(-behind_s)
            elif behind_s > PERIOD_S:
                due = time.monotonic()  # it was stopped, or starved


if __name__ == "__main__":
    fly(sys.argv[1], Path(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else None)
