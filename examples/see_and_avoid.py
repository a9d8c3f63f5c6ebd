"""Fly ahead past orange pillars, by fuzzy rules over where the nearest one is and how wide it looks.

python examples/see_and_avoid.py             # in a simulated hall
python examples/see_and_avoid.py alpha 6     # a running proxy, 6 m ahead
"""

import sys

import skyloop
from skyloop.control import SeeAndAvoid
from skyloop.control.avoid import avoidance


def main(target: str = "sim://?world=pillars&cameras=front&fps=15", distance_m: float | str = 12.5) -> None:
    rules = avoidance()
    print("aside, 1 left to -1 right, by bearing (across, left positive) and width (down):")
    bearings = (0.4, 0.2, 0.0, -0.2, -0.4)
    print("      ", *(f"{bearing:6.1f}" for bearing in bearings))
    for width in (0.1, 0.25, 0.5):
        print(f"{width:6.2f}", *(f"{rules.step(bearing=bearing, width=width):6.2f}" for bearing in bearings))
    with skyloop.connect(target) as drone:
        drone.takeoff()
        flight = SeeAndAvoid(drone, float(distance_m))
        with drone.on_event(lambda event: print(event.text)):
            print(flight.run(seconds=90.0))
        print(f"{flight.ahead_m:.1f} m ahead", "and arrived" if flight.done else "")


if __name__ == "__main__":
    main(*sys.argv[1:])
