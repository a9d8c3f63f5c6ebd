"""Fly a course of five gates, each found by its colour.

python examples/fly_gates.py             # in a simulated hall
python examples/fly_gates.py alpha 120   # a running proxy, for at most two minutes
"""

import sys

import skyloop
from skyloop.control import FIVE_GATES, FlyThroughGates


def main(target: str = "sim://?world=gates&cameras=front&fps=15", seconds: float | str = 120.0) -> None:
    with skyloop.connect(target) as drone:
        drone.takeoff()
        course = FlyThroughGates(drone, FIVE_GATES)
        with drone.on_event(lambda event: print(event.text)):
            print(course.run(seconds=float(seconds)))
        print("passed", course.passed, "of", len(FIVE_GATES), "gates")


if __name__ == "__main__":
    main(*sys.argv[1:])
