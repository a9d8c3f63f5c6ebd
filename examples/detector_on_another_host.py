"""Run a detector on any host, and a controller that turns towards its detections.

skyloop proxy sim:// --name alpha                                             # on the host of the drone
skyloop process examples/detector_on_another_host.py:Detector --drone alpha   # on another, as often as you like
python examples/detector_on_another_host.py alpha                             # on a third
"""

import sys
from dataclasses import dataclass

import skyloop
from skyloop.processing import Output
from skyloop.vision import MarkerDetector


@dataclass
class Sighting:
    right: float  # metres, from the camera
    ahead: float


class Detector:
    """Looks for markers in each frame. Imagine a detector that needs the GPU of another machine."""

    def __init__(self) -> None:
        self.markers = MarkerDetector("4x4_50", size_m=0.3)

    def process(self, frame: skyloop.Frame) -> Output:  # BGR, shape (h, w, 3), uint8
        seen = self.markers.detect(frame)
        outlines = [skyloop.Polyline(tuple(map(tuple, one.corners.tolist())), closed=True) for one in seen]
        return Output([Sighting(right=one.position_m[0], ahead=one.position_m[2]) for one in seen], outlines)


class Face(skyloop.Controller):
    """Turns on the spot until a marker is in the centre of the image."""

    processors = ("detector",)
    result_max_age_s = 0.5  # older results are skipped and counted

    def on_result(self, result: skyloop.Result) -> None:
        sightings = result.to(list[Sighting])
        yaw_rate = -1.5 * sightings[0].right / sightings[0].ahead if sightings else 0.7
        self.drone.velocity(yaw_rate=yaw_rate)  # rad/s, counter-clockwise


def main(name: str, seconds: float = 20.0) -> None:
    with skyloop.connect(name) as drone:
        drone.takeoff()
        print(Face(drone).run(seconds=seconds))
        drone.land()


if __name__ == "__main__":
    try:
        main(sys.argv[1] if sys.argv[1:] else "alpha")
    except skyloop.UnknownNameError:
        sys.exit("start the drone and the detector first, as the first lines of this file say: skyloop proxy sim:// …")
