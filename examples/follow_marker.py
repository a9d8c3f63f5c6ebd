"""Find a moving marker, follow it 1.5 m in front of its face, and print how well that worked.

python examples/follow_marker.py             # starts a simulated drone
python examples/follow_marker.py alpha 60    # a running proxy, for a minute
"""

import math
import sys

import skyloop
from skyloop.control.follow import FollowMarker


class Follow(FollowMarker):
    """The controller of ``skyloop demo`` with printed phases. The README has a simpler one, from scratch."""

    def on_frame(self, frame: skyloop.Frame) -> None:
        before = self.mode
        super().on_frame(frame)
        if self.mode is not before:
            print(f"{frame.header.seq}: {before} → {self.mode}", flush=True)


def main(target: str = "sim://", seconds: float | str = 30.0) -> None:
    with skyloop.connect(target) as drone:
        drone.takeoff()
        controller = Follow(drone, 7, size_m=0.3)  # marker 7 of ArUco's 4x4_50, with 0.3 m from edge to edge
        print(controller.run(seconds=float(seconds)))
        drone.land()
    score = controller.score
    print(f"in view in {score.share_in_view or 0.0:.0%} of {score.frames} frames since it was found")
    if errors := score.range_errors_m(after_s=3.0):
        rms = math.sqrt(sum(error**2 for error in errors) / len(errors))
        print(f"distance off by {rms:.2f} m RMS, starting three seconds later")


if __name__ == "__main__":
    main(*sys.argv[1:])
