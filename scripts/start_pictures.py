"""Make the pictures of the first pages: the README's program on each vehicle, and a camera without a drone.

``python scripts/start_pictures.py``, or ``… tello`` for one. All but the simulator are emulated firmware.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
import cv2
from pictures import Picture, save

import skyloop
from skyloop.vision import MarkerDetector

ROOT = Path(__file__).parents[1]
FLIGHT_S = 25.0
MARKER_ID = 7  # of the board followed by the program
WIDTH = 640
GREEN = (90, 220, 60)
VEHICLES = {
    "sim": ([], "sim://?cameras=front&width=640"),
    "tello": (["--firmware", "tello", "--seed", "4"], "tello://127.0.0.1"),
    "crazyflie": (
        ["--firmware", "crazyflie", "--seed", "4", "--video-port", "5000"],
        "crazyflie://udp:127.0.0.1?deck=127.0.0.1:5000&fx=185",
    ),
    "px4": (
        ["--firmware", "px4", "--seed", "4", "--video-port", "5600"],
        "mavlink://udpin:127.0.0.1:14540?camera=udp://127.0.0.1:5600&camera_width=320&camera_height=240&fx=244",
    ),
}


def main() -> None:
    for name in sys.argv[1:] or [*VEHICLES, "webcam"]:
        if name == "webcam":
            webcam()
        else:
            flown(name)


def flown(name: str) -> None:
    """Fly the README's controller, and keep the last picture that shows its marker."""
    firmware, address = VEHICLES[name]
    with emulated(firmware), skyloop.connect(address) as drone:
        drone.next_frame(timeout_s=120.0)  # an emulated camera's first picture takes long on a busy machine
        drone.takeoff()
        controller = watched(program())(drone)
        print(f"{name}: {controller.run(seconds=FLIGHT_S)}")
        save(f"start/follow-{name}.jpg", marked(controller.shown))
        drone.land()


def program() -> Any:
    """Return the class of the README's first program."""
    found = re.search(r"```python\n(import skyloop\n.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert found
    names: dict[str, Any] = {"__name__": "program"}
    exec(found[1], names)
    return names["Follow"]


def watched(follow: Any) -> Any:
    """Return the same program, keeping the newest frame that shows its marker."""

    class Watched(follow):  # type: ignore[misc]
        shown: skyloop.Frame

        def on_frame(self, frame: skyloop.Frame) -> None:
            super().on_frame(frame)
            if MARKER_ID in [marker.id for marker in self.detector.detect(frame)]:
                self.shown = frame

    return Watched


@contextmanager
def emulated(arguments: list[str]) -> Iterator[None]:
    """Run a drone's firmware during the block; none without arguments."""
    if not arguments:
        yield
        return
    with subprocess.Popen([sys.executable, "-m", "skyloop", "sim", *arguments], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()  # it is ready
            yield
        finally:
            process.terminate()


def marked(frame: Any) -> Picture:
    """Return a frame with the outlines and distances of its markers."""
    height = round(frame.shape[0] * WIDTH / frame.shape[1])
    picture: Picture = cv2.resize(frame, (WIDTH, height), interpolation=cv2.INTER_AREA)
    for marker in MarkerDetector("4x4_50", size_m=0.3).detect(frame):
        corners = marker.corners * (WIDTH / frame.shape[1])
        cv2.polylines(picture, [corners.round().astype("int32")], True, GREEN, 2, cv2.LINE_AA)
        text = str(marker.id) if marker.position_m is None else f"{marker.id}: {marker.position_m[2]:.2f} m"
        at = (int(corners[:, 0].min()), int(corners[:, 1].min()) - 8)
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, GREEN, 2, cv2.LINE_AA)
    return picture


def webcam() -> None:
    """Photograph a camera without a drone: a video of the simulated room replaces it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        film(path)
        with skyloop.connect(f"video://{path}?fx=488", access="observe") as camera:
            pictures = [marked(camera.next_frame(timeout_s=10.0)) for _ in range(80)]
    best = max(pictures, key=lambda one: int((one == GREEN).all(axis=2).sum()))
    save("start/webcam.jpg", best)


def film(path: Path, frames: int = 90) -> None:
    """Film the view of a simulated drone's camera while it turns on the spot."""
    with skyloop.connect("sim://?cameras=front&width=640&seed=1") as drone, av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=15)
        stream.height, stream.width = drone.next_frame(timeout_s=60.0).shape[:2]
        drone.takeoff()
        for number, frame in enumerate(drone.frames(max_fps=15, timeout_s=60.0)):
            drone.velocity(yaw_rate=0.6)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bgr24")))
            if number == frames:
                break
        container.mux(stream.encode())
        drone.land()


if __name__ == "__main__":
    main()
