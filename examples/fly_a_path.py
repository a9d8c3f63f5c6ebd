"""Fly a square, a figure of eight and a helix by position, and print the errors. Extra [sim].

python examples/fly_a_path.py          # in simulated time, with noise, delay, loss and gusts of 1 m/s: a few seconds
python examples/fly_a_path.py alpha    # a running proxy: skyloop sim --name alpha --world empty
"""

import sys

import numpy as np
from numpy.typing import NDArray

import skyloop
from skyloop.control import AlongPath, FollowPath, FunctionPath, Lemniscate, LookAt, Waypoint, Waypoints
from skyloop.control.rehearsal import Radio, rehearse


def helix(t: float) -> NDArray[np.float64]:
    """Climb 0.6 m in two turns of 0.8 m radius. Any function of time [s] is a path. World axes [m]."""
    angle = 2 * np.pi * t / 12
    return np.array([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.8 + 0.6 * t / 24])


def main(*target: str) -> None:
    corners: list[Waypoint | tuple[float, float, float]] = [
        (1, -1, 1),
        (1, 1, 1),
        (-1, 1, 1),
        Waypoint(-1, -1, 1, yaw=0.0),
    ]
    simulated = "sim://?world=empty&cameras=none"
    with skyloop.connect(*target) if target else rehearse(simulated, radio=Radio()) as drone:
        if not target:
            drone.config["sim.gust"] = 1.0  # the standard deviation of the wind along each horizontal axis [m/s]
        drone.takeoff()
        flights = {
            "square": Waypoints(drone, corners, speed_m_s=0.5, hold_s=0.5),
            "eight": FollowPath(drone, Lemniscate((0, 0, 1), 1.5, speed_m_s=0.8), yaw=LookAt(0.0, 0.0)),
            "helix": FollowPath(drone, FunctionPath(helix, 24.0), yaw=AlongPath()),
        }
        for name, flight in flights.items():
            summary = flight.run(seconds=90)
            error = flight.error
            print(f"{name}: {summary.seconds:.0f} s, off by {error.rms_m:.3f} m RMS, at most {error.largest_m:.2f} m")
        drone.land()


if __name__ == "__main__":
    main(*sys.argv[1:2])
