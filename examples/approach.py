"""Find a marker on a wall, fly up to it, and swing around it.

python examples/approach.py               # in a simulated room
python examples/approach.py alpha 12 0.25 # a running proxy; marker 12, 0.25 m wide
"""

import sys

import skyloop
from skyloop.control import ApproachMarker, OrbitMarker


def main(target: str = "sim://?cameras=front&fps=15", marker: int | str = 12, size_m: float | str = 0.25) -> None:
    with skyloop.connect(target) as drone:
        drone.takeoff()
        with drone.on_event(lambda event: print(event.text)):
            approach = ApproachMarker(drone, int(marker), distance_m=1.2, size_m=float(size_m))
            print(approach.run(seconds=40.0))
            if approach.done:
                orbit = OrbitMarker(drone, int(marker), radius_m=1.2, size_m=float(size_m))
                print(orbit.run(seconds=30.0, until=lambda: orbit.turns == 2))
                print("swung to both sides" if orbit.turns == 2 else "not swung to both sides")


if __name__ == "__main__":
    main(*sys.argv[1:])
