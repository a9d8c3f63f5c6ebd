"""Make the pictures of the README from real runs: ``make pictures``, or ``python scripts/pictures.py flight`` for one.

=====================  ==============================================================================================
``flight-strip.jpg``   the camera of one simulated flight, with what the tracker drew: searching, found, following
``flight-plot.svg``    the same flight in figures: true distance to the marker, and both paths from above
``three-drones.jpg``   three drones of one simulated world, from a camera at the wall
=====================  ==============================================================================================

``scripts/cockpit_pictures.py`` makes those of the cockpit.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from flight_plot import FlightLog, plot
from numpy.typing import NDArray

import skyloop
from skyloop.control.follow import FollowMarker, FollowPhase
from skyloop.messages import Annotation, Takeoff
from skyloop.sim import STEP_S, Simulation, load_world
from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render import PlanarRenderer, Quality, Scene, SceneState

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
FLIGHT = "sim://?seed=2&cameras=front&width=640"  # this seed's marker starts behind the drone
MARKER_ID = 7  # of the board carried around the room
FLIGHT_S = 45.0
KEEP_EVERY = 6  # of the frames: five a second are enough to choose from
MOST_BYTES = 300_000
Picture = NDArray[np.uint8]


def main() -> None:
    makers = {"flight": flight, "world": world}
    wanted = sys.argv[1:] or list(makers)
    for name in wanted:
        if name not in makers:
            sys.exit(f"no picture {name!r}: choose from {', '.join(makers)}")
        makers[name]()


# One flight: strip and plot -------------------------------------------------------------------------------------------


class Filmed(FollowMarker):
    """The demo's controller, keeping some of its frames and their modes."""

    def __init__(self, drone: skyloop.Drone) -> None:
        super().__init__(drone, MARKER_ID)
        self.film: list[tuple[int, FollowPhase, Picture]] = []  # capture [ns], mode, pixels
        self._number = 0

    def on_frame(self, frame: skyloop.Frame) -> None:
        unseen = self.score.first_seen_ns is None
        super().on_frame(frame)
        found = unseen and self.score.first_seen_ns is not None
        if found or self._number % KEEP_EVERY == 0:
            self.film.append((frame.captured_ns, self.mode, frame.copy()))
        self._number += 1


def flight() -> None:
    """Fly once; keep pictures, drawings and true places."""
    log = FlightLog(wanted_m=1.5)
    drawings: dict[int, Annotation] = {}
    with skyloop.connect(FLIGHT, name="pictures") as drone:
        drone.takeoff()
        follower = Filmed(drone)
        log.wanted_m = follower.distance_m
        with drone.on_annotation(lambda one: drawings.update({one.captured_ns: one})), drone.on_feedback(log.add):
            summary = follower.run(seconds=FLIGHT_S)
        score = follower.score
        print(f"flight: {summary}")
        print(f"flight: the marker was in view in {score.share_in_view or 0:.1%} of the frames after it was found")
        drone.land()
    assert score.first_seen_ns is not None, "the marker was never seen: look at the flight before making its pictures"
    log.found_ns = score.first_seen_ns
    shown = _choose(follower.film, score.first_seen_ns)
    save("flight-strip.jpg", side_by_side([draw(picture, drawings.get(at_ns)) for at_ns, picture in shown]))
    (PICTURES / "flight-plot.svg").write_text(plot(log))
    print(f"flight-plot.svg: {(PICTURES / 'flight-plot.svg').stat().st_size:,} bytes")


def _choose(film: list[tuple[int, FollowPhase, Picture]], found_ns: int) -> list[tuple[int, Picture]]:
    """Return one while searching, the first sighting, and one after 15 s of following."""
    searching = [(at, picture) for at, mode, picture in film if mode is FollowPhase.SEARCHING and at < found_ns]
    found = next((at, picture) for at, _, picture in film if at == found_ns)
    following = next(
        (at, picture) for at, mode, picture in film if mode is FollowPhase.FOLLOWING and at - found_ns > 15 * 10**9
    )
    return [searching[len(searching) // 2], found, following]


def draw(picture: Picture, annotation: Annotation | None) -> Picture:
    """Return the picture with the tracker's drawings, as on the page."""
    canvas = picture.copy()
    for shape in annotation.shapes if annotation is not None else ():
        red, green, blue = shape.colour
        colour = (blue, green, red)
        if isinstance(shape, skyloop.Text):
            _label(canvas, shape.text, shape.at, colour)
        elif isinstance(shape, skyloop.Points):
            for point in shape.points:
                cv2.circle(canvas, _pixel(point), 4 << 4, colour, -1, cv2.LINE_AA, 4)
        else:
            line = np.array([_pixel(point) for point in shape.points], np.int32)
            cv2.polylines(canvas, [line], shape.closed, colour, 2, cv2.LINE_AA, 4)
    return canvas


def _label(canvas: Picture, text: str, at: tuple[float, float], colour: tuple[int, int, int]) -> None:
    """Draw text on a dark card, readable in a reduced picture."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.8, 2)
    x, y = round(at[0]) + 8, round(at[1]) + height
    card = canvas[max(0, y - height - 8) : y + below + 4, max(0, x - 8) : x + width + 8]
    card[:] = (card * 0.25).astype(np.uint8)
    cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.8, colour, 2, cv2.LINE_AA)


def _pixel(point: tuple[float, float]) -> tuple[int, int]:
    """Return a point in sixteenths of a pixel, for OpenCV's ``shift`` of 4 bits."""
    return round(point[0] * 16), round(point[1] * 16)


def side_by_side(pictures: list[Picture], gap: int = 8, width: int = 480) -> Picture:
    """Join pictures, scaled to equal width, with white between."""
    height = round(pictures[0].shape[0] * width / pictures[0].shape[1])
    white = np.full((height, gap, 3), 255, np.uint8)
    row: list[Any] = []
    for picture in pictures:
        row += [cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), white]
    joined: Picture = np.hstack(row[:-1])
    return joined


# A world --------------------------------------------------------------------------------------------------------------


def world() -> None:
    """Three drones on their way through the gates, seen by an external camera."""
    gates = load_world("gates", 0)
    simulation = Simulation(gates, 3, seed=0)
    for drone in range(3):
        simulation.command(drone, Takeoff())
    simulation.step(round(4.0 / STEP_S))
    for drone, (forward, left, up) in enumerate(((1.35, -0.1, 0.05), (0.75, 0.1, 0.2), (0.75, 0.1, 0.0))):
        simulation.command(drone, skyloop.Velocity(forward=forward, left=left, up=up))
    simulation.step(round(2.6 / STEP_S))
    state = SceneState(*simulation.poses(), simulation.target_states())
    lens = CameraModel("wall", width=960, height=540, fps=30.0, fx=700.0, fy=700.0, cx=479.5, cy=269.5)
    view = looking((-7.4, -4.9, 2.0), (-2.0, -3.1, 1.25))
    picture = PlanarRenderer(Scene(gates, 3), Quality.BEST).render(state, view, lens)
    save("three-drones.jpg", picture)


def looking(place: tuple[float, float, float], at: tuple[float, float, float]) -> CameraPose:
    """Return a level camera at a place that points at another, world axes [m]."""
    forward = np.subtract(at, place) / np.linalg.norm(np.subtract(at, place))
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return CameraPose(np.array(place), np.column_stack([right, np.cross(forward, right), forward]))


def save(name: str, picture: Picture) -> None:
    """Write a picture; one too large for a README is an error."""
    options = [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    good, data = cv2.imencode(".jpg", picture, options)
    if not good or len(data) > MOST_BYTES:
        sys.exit(f"{name} has {len(data):,} bytes, more than {MOST_BYTES:,}")
    PICTURES.mkdir(parents=True, exist_ok=True)
    (PICTURES / name).write_bytes(data.tobytes())
    print(f"{name}: {picture.shape[1]}×{picture.shape[0]}, {len(data):,} bytes")


if __name__ == "__main__":
    main()
