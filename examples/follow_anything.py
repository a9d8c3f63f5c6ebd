"""Follow a person without a marker, by detector and appearance; then circle the person, then only turn to them.

python examples/follow_anything.py                       # a simulated park
python examples/follow_anything.py alpha my.onnx         # a running proxy, with your own network
"""

import sys

import skyloop
from skyloop.control import ChaseSettings, FollowMode, FollowTarget
from skyloop.vision import OnnxDetector, simulated_detector

SETTINGS = ChaseSettings(distance_m=4.0, nearest_m=2.0, leash_m=25.0)
EACH_S = {FollowMode.FOLLOW: 12.0, FollowMode.ORBIT: 12.0, FollowMode.LOOK: 4.0}


def main(target: str = "sim://?world=park&cameras=front&fps=15", weights: str | None = None) -> None:
    detector = simulated_detector() if weights is None else OnnxDetector(weights)  # for rendered figures only
    with skyloop.connect(target) as drone:
        drone.takeoff()
        pilot = FollowTarget(drone, class_name="person", detector=detector, settings=SETTINGS)
        with drone.on_event(lambda event: print(event.text, flush=True)):
            for mode, seconds in EACH_S.items():
                pilot.follower.mode = mode
                pilot.run(seconds=seconds)
                if pilot.done:  # lost for too long
                    break
                seen, away = pilot.status.box is not None, pilot.status.range_m
                print(f"{mode}: {'in view' if seen else 'not in view'}, {away or 0.0:.1f} m away", flush=True)
        drone.land()


if __name__ == "__main__":
    main(*sys.argv[1:])
