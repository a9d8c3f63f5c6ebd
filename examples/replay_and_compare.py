"""Record a flight, replay it to an old and a changed controller, and print how their commands differ.

python examples/replay_and_compare.py            # into a new temporary folder
python examples/replay_and_compare.py flights    # into your own folder; needs the extra [record]
"""

import sys
import tempfile
from pathlib import Path

import skyloop
from skyloop.recording.reader import Recording
from skyloop.recording.review.compare import compare
from skyloop.vision import MarkerDetector


class Face(skyloop.Controller):
    """Turns towards marker 7 and keeps 1.5 m away; looks around while it is out of view."""

    def __init__(self, drone: skyloop.Drone, gain: float) -> None:
        super().__init__(drone)
        self.gain = gain
        self.detector = MarkerDetector("4x4_50", size_m=0.3)

    def on_frame(self, frame: skyloop.Frame) -> None:
        seen = [marker for marker in self.detector.detect(frame) if marker.id == 7]
        if not seen:
            self.drone.velocity(yaw_rate=0.7)  # rad/s, counter-clockwise
            return
        right, down, ahead = seen[0].position_m  # metres, from the camera
        self.drone.velocity(forward=0.8 * (ahead - 1.5), up=-0.8 * down, yaw_rate=-self.gain * right / ahead)


def main(into: str = "", seconds: float | str = 10.0) -> None:
    folder = Path(into or tempfile.mkdtemp(prefix="flights-"))
    folder.mkdir(parents=True, exist_ok=True)
    flight, old, new = (folder / f"{name}.mcap" for name in ("flight", "old", "new"))
    with skyloop.connect("sim://?cameras=front&seed=4") as drone, skyloop.record(drone, flight, overwrite=True):
        drone.takeoff()
        print("flown:", Face(drone, gain=1.5).run(seconds=float(seconds)))
        drone.land()

    # Both controllers get the same images, as fast as they process them. Their commands are recorded; nothing flies.
    for path, gain in ((old, 1.5), (new, 2.5)):
        with (
            skyloop.connect(f"replay://{flight}?speed=max") as drone,
            skyloop.record(drone, path, channels=["commands", "feedback"], overwrite=True),
        ):
            print("replayed:", Face(drone, gain).run())

    for field in compare(Recording.open(old), Recording.open(new)).fields:
        print(f"{field.name}: {field.rms:.3f} {field.unit} RMS apart, at most {field.largest:.2f}")
    print(f"To see it: skyloop log compare {old} {new} -o both.html")


if __name__ == "__main__":
    main(*sys.argv[1:])
