"""Flies a Tello with djitellopy, following only its documentation: ``fly_djitellopy.py steady|lossy ADDRESS``.

Prints one line of JSON: what it saw.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from typing import Any

from djitellopy import Tello

Tello.LOGGER.setLevel(logging.WARNING)
Tello.FRAME_GRAB_TIMEOUT = 40  # an emulated drone on a busy machine is slow to show its first picture


def pictures(tello: Any) -> dict[str, Any]:
    """Measure the camera's pictures, once there are any."""
    tello.streamon()
    reader = tello.get_frame_read()
    end = time.monotonic() + 20
    while reader.frame.shape[:2] == (300, 400) and time.monotonic() < end:  # djitellopy's own placeholder
        time.sleep(0.05)
    frame = reader.frame
    return {"size": list(frame.shape), "contrast": float(frame.std())}


def steady(tello: Any) -> dict[str, Any]:
    """Everything is answered: moves, turns, queries, and sticks for a while."""
    seen: dict[str, Any] = {"sdk": tello.query_sdk_version(), "battery": tello.query_battery()}
    seen["on_ground_cm"] = tello.get_distance_tof()
    seen |= pictures(tello)
    tello.takeoff()
    seen["up_cm"] = tello.get_distance_tof()
    tello.move_forward(50)
    tello.rotate_clockwise(90)
    seen["yaw_deg"] = tello.get_yaw()
    tello.go_xyz_speed(20, 20, 20, 30)
    seen["higher_cm"] = tello.get_distance_tof()
    fastest = 0.0
    for _ in range(15):
        tello.send_rc_control(0, 40, 0, 0)
        time.sleep(0.1)
        fastest = max(fastest, abs(tello.get_speed_x()), abs(tello.get_speed_y()))
    tello.send_rc_control(0, 0, 0, 0)
    seen["fastest_dm_s"] = fastest
    tello.land()
    seen["motor_s"] = tello.get_flight_time()
    return seen


def lossy(tello: Any) -> dict[str, Any]:
    """With datagrams lost it can't wait for answers: it checks the state, and repeats commands."""
    highest = 0
    for _ in range(40):
        tello.send_command_without_return("takeoff")
        time.sleep(0.5)
        highest = max(highest, tello.get_distance_tof())
        if highest > 60:
            break
    for _ in range(20):
        tello.send_rc_control(0, 0, 0, 60)
        time.sleep(0.1)
    yaw = tello.get_yaw()
    for _ in range(40):
        tello.send_command_without_return("land")
        time.sleep(0.5)
        if tello.get_distance_tof() <= 10:
            break
    return {"highest_cm": highest, "yaw_deg": yaw, "end_cm": tello.get_distance_tof()}


def main() -> None:
    how, address = sys.argv[1:]
    tello = Tello(address, retry_count=10)
    tello.connect()
    seen = {"steady": steady, "lossy": lossy}[how](tello)
    tello.end()
    print(json.dumps(seen), flush=True)


if __name__ == "__main__":
    main()
