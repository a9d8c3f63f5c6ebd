"""Flies a MAVLink vehicle with MAVSDK alone, without Skyloop: ``python fly_mavsdk.py URL``.

Writes its observations as one line of JSON. Runs with the Python of an environment that has mavsdk 4.1.0.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.offboard import Offboard
from mavsdk.plugins.offboard.offboard import VelocityBodyYawspeed
from mavsdk.plugins.telemetry import Telemetry

PATIENCE_S = 60.0
HEIGHT_M = 2.5


def until(done: Callable[[], Any], what: str, say: Callable[[], object] = lambda: None) -> Any:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        say()
        try:
            found = done()
        except Exception as error:  # noqa: BLE001  MAVSDK refuses until it may
            found, what = None, f"{what} ({error})"
        if found:
            return found
        if time.monotonic() > deadline:
            raise SystemExit(f"waited {PATIENCE_S} s without success: {what[:500]}")
        time.sleep(0.1)


def main(url: str) -> None:
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    mavsdk.add_any_connection(url)
    system = until(lambda: mavsdk.first_autopilot(3.0), "an autopilot")
    action, telemetry, offboard = Action(system), Telemetry(system), Offboard(system)
    for rate in (telemetry.set_rate_health, telemetry.set_rate_position, telemetry.set_rate_position_velocity_ned):
        rate(10.0)
    telemetry.set_rate_in_air(5.0)
    until(telemetry.health_all_ok, "a healthy vehicle")
    until(lambda: action.set_takeoff_altitude(HEIGHT_M) is not None, "its take-off altitude")
    until(lambda: action.arm() is not None, "arming")
    action.takeoff()
    until(lambda: telemetry.position().relative_altitude_m > HEIGHT_M - 0.5, "its altitude")
    high = telemetry.position().relative_altitude_m
    time.sleep(2.0)  # the end of the take-off, which MAVSDK does not report

    def forward() -> None:
        offboard.set_velocity_body(VelocityBodyYawspeed(1.0, 0.0, 0.0, 0.0))

    forward()
    until(lambda: offboard.start() is not None, "offboard", forward)
    begun = time.monotonic()
    speeds: list[float] = []

    def fast() -> bool:
        speeds.append(abs(telemetry.position_velocity_ned().velocity.north_m_s))
        speeds.append(abs(telemetry.position_velocity_ned().velocity.east_m_s))
        return time.monotonic() - begun > 3.0

    until(fast, "three seconds of flight", forward)
    offboard.stop()
    action.land()
    until(lambda: not telemetry.armed(), "landed and disarmed")
    print(json.dumps({"high_m": high, "fastest_m_s": max(speeds)}), flush=True)
    mavsdk.destroy()


if __name__ == "__main__":
    main(sys.argv[1])
