"""A first flight: up, once around, and down. Run it: python examples/first_flight.py"""

import sys
from itertools import islice

import skyloop


def main(target: str = "sim://") -> None:
    with skyloop.connect(target) as drone:
        drone.takeoff()
        for frame in islice(drone.frames(max_fps=10), 63):  # the newest image: BGR, (h, w, 3), uint8
            drone.velocity(forward=0.4, yaw_rate=1.0)  # m/s, rad/s: a circle of 0.4 m, counter-clockwise
            if frame.feedback is not None:  # the drone's state when the image was captured
                height = frame.feedback.altitude_m
                print(f"{frame.age_s * 1000:.0f} ms ago, {height:.2f} m up: {frame.mean():.0f} bright")
        drone.land()


if __name__ == "__main__":
    main(*sys.argv[1:])
