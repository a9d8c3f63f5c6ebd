"""Measure how well paths are flown: ``python scripts/control_errors.py [--seeds 10] [--gust 1.0]``.

Each flight is the whole of Skyloop in simulated time: a simulated AR.Drone 2 with its sensors' noise, commands delayed
by 40 ms and feedback by 20 ms, 5 % of both lost, positions with 1 cm of noise. The error is that of the true position.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Final, NamedTuple

from skyloop.client import Drone
from skyloop.control import AlongPath, Circle, FollowPath, Lemniscate, LookAt, TrackingError, Waypoints
from skyloop.messages import Feedback
from skyloop.stepping.rehearsal import Radio, rehearse

Flyer = Waypoints | FollowPath

SQUARE: Final = [(-1.0, -1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, 1.0), (-1.0, 1.0, 1.0), (-1.0, -1.0, 1.0)]
TARGET_M: Final = 0.15
LONGEST_S: Final = 90.0

FLIGHTS: Final[dict[str, Callable[[Drone], Flyer]]] = {
    "waypoint square of 2 m at 0.5 m/s": lambda drone: Waypoints(drone, SQUARE, speed_m_s=0.5),
    "circle of 1 m at 0.7 m/s, looking ahead": lambda drone: FollowPath(
        drone, Circle((0, 0, 1.2), 1.0, laps=2, speed_m_s=0.7), yaw=AlongPath()
    ),
    "eight of 3 m at 0.8 m/s, looking at a point": lambda drone: FollowPath(
        drone, Lemniscate((0, 0, 1.2), 1.5, laps=2, speed_m_s=0.8), yaw=LookAt(0.0, 3.0)
    ),
}


class Result(NamedTuple):
    """One flight."""

    to_path: TrackingError  #: from the true position to the planned one at that time
    across: TrackingError  #: from the true position to the nearest point of the square's outline; empty for other paths
    done: bool


def fly(make: Callable[[Drone], Flyer], seed: int, gust_m_s: float = 0.0, radio: Radio | None = None) -> Result:
    """Fly once in simulated time; a square from its first corner on."""
    to_path, across = TrackingError(), TrackingError()
    with rehearse(f"sim://?world=empty&cameras=none&seed={seed}", radio=radio or Radio(seed=seed)) as drone:
        drone.config["sim.wind"] = (0.0, 0.0, 0.0)
        drone.config["sim.gust"] = gust_m_s
        drone.takeoff()
        flyer = make(drone)

        def look(feedback: Feedback) -> None:
            begun = flyer.reached > 0 if isinstance(flyer, Waypoints) else flyer.on_path
            if flyer.target is None or not begun or flyer.done or feedback.native is None:
                return
            x, y, z = (feedback.native[f"truth.{axis}"] for axis in "xyz")
            assert isinstance(x, float)
            assert isinstance(y, float)
            assert isinstance(z, float)
            to_path.add(math.dist(flyer.target[0], (x, y, z)))
            if isinstance(flyer, Waypoints):
                across.add(math.hypot(_to_outline(x, y, 1.0), z - 1.0))

        drone.on_feedback(look)
        flyer.run(seconds=LONGEST_S)
        drone.land()
    return Result(to_path, across, flyer.done)


def _to_outline(x: float, y: float, half: float) -> float:
    """Return the distance to the outline of a square around the origin."""
    east, north = abs(x) - half, abs(y) - half
    return math.hypot(max(0.0, east), max(0.0, north)) if max(east, north) > 0.0 else -max(east, north)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--gust", type=float, default=1.0, help="standard deviation of gusts in the second half [m/s]")
    options = parser.parse_args()
    worst = 0.0
    for gust in (0.0, options.gust):
        for name, make in FLIGHTS.items():
            results = [fly(make, seed, gust) for seed in range(options.seeds)]
            rms = [result.to_path.rms_m for result in results]
            line = f"{name}, gusts {gust:g} m/s: RMS {sum(rms) / len(rms):.3f} m (worst {max(rms):.3f}), "
            line += f"at most {max(result.to_path.largest_m for result in results):.2f} m"
            if results[0].across.samples:
                line += f", across the line RMS {max(result.across.rms_m for result in results):.3f} m at worst"
                worst = max(worst, *rms)
            print(f"{line}; {sum(result.done for result in results)} of {len(results)} flown to the end")
    print(f"waypoint square: worst RMS {worst:.3f} m, target {TARGET_M} m: {'met' if worst <= TARGET_M else 'missed'}")


if __name__ == "__main__":
    main()
