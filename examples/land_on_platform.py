"""Land on a moving platform: search for its marker with the bottom camera, follow it, descend with it.

python examples/land_on_platform.py            # a simulated platform that moves at 0.3 m/s
python examples/land_on_platform.py alpha 90   # a running proxy, for at most a minute and a half
"""

import sys

import skyloop
from skyloop.control import LandOnMarker


def main(target: str = "sim://?world=platform&cameras=bottom&fps=15", seconds: float | str = 90.0) -> None:
    with skyloop.connect(target) as drone:
        drone.takeoff()
        landing = LandOnMarker(drone, marker_id=30, size_m=0.2)
        with drone.on_event(lambda event: print(event.text)):
            print(landing.run(seconds=float(seconds)))
        print("landed on the platform" if landing.landed else f"not landed: {landing.phase}")
        truth = drone.feedback().native or {}
        if "truth.target.x" in truth:  # the simulator's true positions of both
            x, y, marker_x, marker_y = (
                float(str(truth[f"truth.{name}"])) for name in ("x", "y", "target.x", "target.y")
            )
            east, north = x - marker_x, y - marker_y
            print(f"{(east**2 + north**2) ** 0.5:.2f} m from the marker's centre")


if __name__ == "__main__":
    main(*sys.argv[1:])
