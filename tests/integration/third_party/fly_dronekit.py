"""Flies an ArduCopter with dronekit2 alone, without Skyloop: ``python fly_dronekit.py ADDRESS``.

Follows DroneKit's first example: waits until it is armable, takes off, flies somewhere, returns. Writes its
observations as one line of JSON. Runs with the Python of an environment that has dronekit2 3.0.0.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable

from dronekit import LocationGlobalRelative, VehicleMode, connect

PATIENCE_S = 60.0
HEIGHT_M = 2.5
NORTH_M = 4.0
METRES_PER_DEG = 111_320.0


def until(done: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not done():
        if time.monotonic() > deadline:
            raise SystemExit(f"waited {PATIENCE_S} s without success: {what}")
        time.sleep(0.1)


def main(address: str) -> None:
    vehicle = connect(address, wait_ready=True, rate=10, timeout=PATIENCE_S)
    until(lambda: vehicle.is_armable, "to be armable")
    vehicle.parameters["RTL_ALT"] = 500
    vehicle.parameters["RTL_LOIT_TIME"] = 1000
    until(lambda: vehicle.parameters["RTL_ALT"] == 500, "a parameter")
    vehicle.mode = VehicleMode("GUIDED")
    until(lambda: vehicle.mode.name == "GUIDED", "GUIDED")
    vehicle.arm(timeout=PATIENCE_S)
    vehicle.simple_takeoff(HEIGHT_M)
    start = vehicle.location.global_relative_frame
    until(lambda: vehicle.location.global_relative_frame.alt >= HEIGHT_M * 0.95, "its height")
    high = vehicle.location.global_relative_frame.alt

    there = LocationGlobalRelative(start.lat + NORTH_M / METRES_PER_DEG, start.lon, HEIGHT_M)
    fastest = 0.0

    def off(place: LocationGlobalRelative) -> float:
        nonlocal fastest
        fastest = max(fastest, math.hypot(vehicle.velocity[0], vehicle.velocity[1]))
        here = vehicle.location.global_relative_frame
        east = (here.lon - place.lon) * METRES_PER_DEG * math.cos(math.radians(place.lat))
        return math.hypot((here.lat - place.lat) * METRES_PER_DEG, east)

    vehicle.simple_goto(there, groundspeed=1.5)
    until(lambda: off(there) < 0.5, "the place")
    far, fast, highest = off(there), fastest, 0.0

    vehicle.mode = VehicleMode("RTL")

    def home() -> bool:
        nonlocal highest
        highest = max(highest, vehicle.location.global_relative_frame.alt)
        return not vehicle.armed

    until(home, "its return, landing and disarming")
    alt = vehicle.location.global_relative_frame.alt
    seen = {"high_m": high, "there_m": far, "fastest_m_s": fast, "highest_m": highest, "home_m": abs(alt)}
    print(json.dumps(seen), flush=True)
    vehicle.close()


if __name__ == "__main__":
    main(sys.argv[1])
