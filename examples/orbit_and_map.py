"""Fly a circle facing outwards, and map the markers on the walls. Extra [control].

python examples/orbit_and_map.py                     # in a simulated room
python examples/orbit_and_map.py alpha 0.25          # a running proxy that knows its position; markers of 0.25 m
"""

import sys

import numpy as np
from numpy.typing import NDArray

import skyloop
from skyloop.control import OrbitPlace
from skyloop.poses import target_in_world
from skyloop.vision import MarkerDetector


class Map(OrbitPlace):
    def __init__(self, drone: skyloop.Drone, size_m: float, laps: float) -> None:
        super().__init__(drone, (0.0, 0.0, 1.5), 1.0, look="out", laps=laps)
        self.detector = MarkerDetector(size_m=size_m)
        self.mounting = drone.capabilities.cameras[0]
        self.places: dict[int, list[NDArray[np.float64]]] = {}

    def on_frame(self, frame: skyloop.Frame) -> None:  # on_feedback flies, this one maps
        state = frame.feedback
        if state is None or state.position_m is None:
            return
        shapes: list[skyloop.Polyline | skyloop.Text] = []
        for marker in self.detector.detect(frame):
            place = target_in_world(marker.pose, self.mounting, state).translation
            self.places.setdefault(marker.id, []).append(place)
            x, y, z = place
            shapes.append(skyloop.Polyline(marker.outline, closed=True))
            shapes.append(skyloop.Text(f"{marker.id}: {x:.2f} {y:.2f} {z:.2f}", marker.outline[0]))
        self.drone.annotate(frame, shapes)


def main(target: str = "sim://?cameras=front&fps=15", size_m: float | str = 0.25) -> None:
    with skyloop.connect(target) as drone:
        drone.takeoff()
        survey = Map(drone, float(size_m), laps=1.2)
        print(survey.run(seconds=60.0))
        for number, places in sorted(survey.places.items()):
            x, y, z = np.median(places, axis=0)
            print(f"marker {number}: {x:.2f} {y:.2f} {z:.2f}, seen {len(places)} times")


if __name__ == "__main__":
    main(*sys.argv[1:])
