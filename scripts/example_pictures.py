"""Make the pictures of the examples by running them: ``python scripts/example_pictures.py``, all or those named.

Each example flies simulated drones, which are recorded, and the recording becomes a film: ``flight_film``. The films go
to ``docs/pictures/examples`` and are shown on ``docs/examples.md``. Needs the extras sim, vision, record, gym and
``pip install pillow matplotlib nbclient ipykernel``.
"""

from __future__ import annotations

import base64
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import nbformat
import numpy as np
from flight_film import Array, Picture, View, film, save, span_ns
from matplotlib.figure import Figure
from nbclient import NotebookClient

import skyloop
from skyloop.recording.layout import Channel
from skyloop.recording.reader import Recording
from skyloop.recording.review.compare import compare
from skyloop.recording.review.tables import begin_ns

ROOT = Path(__file__).parents[1]
EXAMPLES, PICTURES = ROOT / "examples", ROOT / "docs" / "pictures" / "examples"
MOST_BYTES = 280_000
ROOM = View("room", eye=(-3.6, -2.7, 2.4), at=(0.2, 0.0, 0.75), focal_px=330.0)
HALL = View("empty", eye=(-3.4, -2.6, 2.5), at=(0.0, 0.0, 0.75), focal_px=330.0)
# From outside, without the walls and the ceiling between.
SOUTH_WALL = View("room", eye=(3.6, 4.6, 4.2), at=(0.1, -1.3, 1.0), focal_px=430.0)
FOUR_WALLS = View("room", eye=(-5.2, -6.4, 6.4), at=(1.1, -0.4, 0.9), focal_px=345.0)
COURSE = View("gates", eye=(-8.8, -10.6, 8.4), at=(1.55, -1.4, 1.15), focal_px=330.0)
PLATFORM = View("platform", eye=(-4.9, -6.4, 4.9), at=(0.1, 0.4, 1.0), focal_px=400.0)
PARK = View("park", eye=(2.5, -12.6, 8.8), at=(2.5, -0.4, 0.5), focal_px=285.0)
PILLARS = View("pillars", eye=(4.0, -9.5, 7.0), at=(-0.9, 0.0, 0.9), focal_px=300.0)
FRONT = ("--option", "cameras=front", "--option", "fps=15")
BELOW = ("--option", "cameras=bottom", "--option", "fps=15")
DOTS = ((22, 115, 249), (94, 197, 34), (60, 50, 220), (180, 63, 194), (31, 194, 224))  # BGR, a marker each


def main() -> None:
    wanted = sys.argv[1:] or list(MAKERS)
    for name in wanted:
        if name not in MAKERS:
            sys.exit(f"no example {name!r} has a picture: choose from {', '.join(MAKERS)}")
        with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
            os.environ["SKYLOOP_RUNTIME_DIR"] = f"{folder}/run"
            MAKERS[name](Path(folder))


# With running drones --------------------------------------------------------------------------------------------------


def first_flight(folder: Path) -> None:
    with flight(folder, "alpha"):
        run("first_flight", "alpha")
    keep("first_flight", film(folder / "flight.mcap", ROOM))


def follow_marker(folder: Path) -> None:
    with flight(folder, "alpha", "--seed", "4"):
        run("follow_marker", "alpha", "24")
    keep("follow_marker", film(folder / "flight.mcap", ROOM))


def fly_a_path(folder: Path) -> None:
    with flight(folder, "alpha", "--world", "empty", "--option", "cameras=none"):
        run("fly_a_path", "alpha")
    keep("fly_a_path", film(folder / "flight.mcap", HALL))


def detector_on_another_host(folder: Path) -> None:
    with flight(folder, "alpha", "--seed", "4"):
        detector = f"{EXAMPLES / 'detector_on_another_host.py'}:Detector"
        with started("-m", "skyloop", "process", detector, "--drone", "alpha", until="part 1 of 1"):
            run("detector_on_another_host", "alpha")
    keep("detector_on_another_host", film(folder / "flight.mcap", ROOM))


def shared_drone(folder: Path) -> None:
    with flight(folder, "alpha", "--world", "empty", "--option", "cameras=none"):
        program = str(EXAMPLES / "shared_drone.py")
        with started(program, "alpha", "pilot", "60"):
            time.sleep(8.0)
            run("shared_drone", "alpha", "turn")
            time.sleep(5.0)
    keep("shared_drone", film(folder / "flight.mcap", replace(HALL, focal_px=520.0), owners=True))


def swarm_formation(folder: Path) -> None:
    names = [f"drone{number}" for number in (1, 2, 3)]
    with flight(folder, *names, "--world", "empty", "--option", "cameras=none"):
        run("swarm_formation", "drone*")
    keep("swarm_formation", film(folder / "flight.mcap", replace(HALL, focal_px=240.0)))


def three_routes(folder: Path) -> None:
    names = [f"drone{number}" for number in (1, 2, 3)]
    with flight(folder, *names, "--option", "cameras=none"):
        run("three_routes", "drone*")
    keep("three_routes", film(folder / "flight.mcap", replace(HALL, focal_px=240.0)))


# Behaviours, each in its world ----------------------------------------------------------------------------------------


def approach(folder: Path) -> None:
    with flight(folder, "alpha", *FRONT):
        run("approach", "alpha")
    keep("approach", film(folder / "flight.mcap", SOUTH_WALL, captions=True))


def fly_gates(folder: Path) -> None:
    with flight(folder, "alpha", "--world", "gates", *FRONT):
        run("fly_gates", "alpha")
    keep("fly_gates", film(folder / "flight.mcap", COURSE, captions=True))


def land_on_platform(folder: Path) -> None:
    """Film a few seconds more, of the platform moving on with the drone on it."""
    with flight(folder, "alpha", "--world", "platform", *BELOW):
        run("land_on_platform", "alpha")
        time.sleep(4.0)
    keep("land_on_platform", film(folder / "flight.mcap", PLATFORM, captions=True, after_s=4.0))


def orbit_and_map(folder: Path) -> None:
    """Film the flight, and each place where it located a marker."""
    with flight(folder, "alpha", *FRONT):
        run("orbit_and_map", "alpha")
    flown = Recording.open(folder / "flight.mcap")
    written = [
        (item.value.captured_ns, [shape.text for shape in item.value.shapes if isinstance(shape, skyloop.Text)])
        for item in flown.items("alpha", (Channel.ANNOTATIONS,))
    ]
    pictures = film(folder / "flight.mcap", FOUR_WALLS, captions=True)
    for picture, now_ns in zip(pictures, np.linspace(*span_ns(flown), len(pictures)), strict=True):
        places: dict[str, list[list[float]]] = {}
        for name, place in (text.split(":") for at_ns, texts in written if at_ns <= now_ns for text in texts):
            places.setdefault(name, []).append([float(number) for number in place.split()])
        dots(picture, places)
    keep("orbit_and_map", pictures)


def dots(canvas: Picture, places: dict[str, list[list[float]]]) -> None:
    """Draw the located places of each marker, and its name at their median, as in the map."""
    for number, (name, own) in enumerate(places.items()):
        colour = DOTS[number % len(DOTS)]
        for point in np.round(FOUR_WALLS.pixels(np.array(own)) * 16).astype(np.int32).tolist():
            cv2.circle(canvas, point, 2 << 4, colour, -1, cv2.LINE_AA, 4)
        x, y = np.round(FOUR_WALLS.pixels(np.median(own, axis=0)[None])[0]).astype(int).tolist()
        for ink, thickness in (((40, 40, 40), 4), ((255, 255, 255), 1)):
            at = (x + 7, y - 6)
            cv2.putText(canvas, name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, ink, thickness, cv2.LINE_AA)


def see_and_avoid(folder: Path) -> None:
    with flight(folder, "alpha", "--world", "pillars", *FRONT):
        run("behaviours/see_and_avoid", "alpha")
    keep("see_and_avoid", film(folder / "flight.mcap", PILLARS, captions=True))


def follow_anything(folder: Path) -> None:
    with flight(folder, "alpha", "--world", "park", *FRONT):
        run("follow_anything", "alpha")
    keep("follow_anything", film(folder / "flight.mcap", PARK, captions=True))


# With their own drones -----------------------------------------------------------------------------------------------


def replay_and_compare(folder: Path) -> None:
    """Film the flight, and below it the commands of both controllers in the replay."""
    run("replay_and_compare", str(folder))
    flown = Recording.open(folder / "flight.mcap")
    old, new = (Recording.open(folder / f"{name}.mcap") for name in ("old", "new"))
    both = compare(old, new)
    first_ns, last_ns = span_ns(flown)
    later_s = (begin_ns(old, old.drone().name) - first_ns) / 1e9  # between the starts of both time axes
    pictures = film(folder / "flight.mcap", ROOM)
    times = np.linspace(0.0, (last_ns - first_ns) / 1e9, len(pictures))
    for picture, now in zip(pictures, times, strict=True):
        chart(
            picture, [(one.times_s + later_s, one.numbers["yaw_rate"]) for one in (both.old, both.new)], now, times[-1]
        )
    keep("replay_and_compare", pictures)


def chart(canvas: Picture, series: Sequence[tuple[Array, Array]], now_s: float, last_s: float) -> None:
    """Draw turning rates over time, up to now, on a card at the lower edge."""
    height, width = canvas.shape[:2]
    left, top, right, bottom = 8, height - 72, width - 8, height - 8
    card = canvas[top:bottom, left:right]
    card[:] = (card * 0.2 + 200).astype(np.uint8)
    for (times, rates), colour, name, y in zip(
        series, ((235, 99, 37), (12, 65, 194)), ("gain 1.5", "gain 2.5"), (58, 44), strict=True
    ):
        known = (times >= 0) & (times <= now_s) & np.isfinite(rates)
        across = left + (right - left) * times[known] / last_s
        up = bottom - 16 - rates[known] * 28  # a turn rate of 1 rad/s is 28 pixels high
        line = np.column_stack([across, up])
        cv2.polylines(canvas, [np.round(line * 16).astype(np.int32)], False, colour, 2, cv2.LINE_AA, 4)
        cv2.putText(canvas, name, (left + 6, top + y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)


def learn_to_reach(folder: Path) -> None:  # noqa: ARG001
    """Draw the growth of the mean return."""
    said = run("learn_to_reach", "--rounds", "25")
    means, bests = (
        [float(found) for found in re.findall(rf"{what} +(-?[\d.]+)", said)][:25] for what in ("mean return", "best")
    )
    figure = Figure(figsize=(4.8, 2.7), dpi=100, layout="constrained")
    axes = figure.subplots()
    rounds = range(1, len(means) + 1)
    axes.plot(rounds, bests, color="#9ca3af", label="best of 64")
    axes.plot(rounds, means, color="#2563eb", label="mean of 64")
    axes.set(xlabel="round", ylabel="return", title="Learning progress of 64 simulated drones")
    axes.grid(color="#e5e7eb")
    axes.legend()
    PICTURES.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURES / "learn_to_reach.png")
    print(f"learn_to_reach.png: {(PICTURES / 'learn_to_reach.png').stat().st_size:,} bytes")


def first_flight_notebook(folder: Path) -> None:
    """Save the notebook's own plot."""
    notebook = nbformat.read(EXAMPLES / "first_flight.ipynb", as_version=4)  # type: ignore[no-untyped-call]
    NotebookClient(notebook, kernel_name="python3", resources={"metadata": {"path": str(folder)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    plots = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    PICTURES.mkdir(parents=True, exist_ok=True)
    (PICTURES / "first_flight_notebook.png").write_bytes(base64.b64decode(plots[-1]))


MAKERS: dict[str, Callable[[Path], None]] = {
    maker.__name__: maker
    for maker in (
        first_flight,
        follow_marker,
        fly_a_path,
        replay_and_compare,
        detector_on_another_host,
        shared_drone,
        swarm_formation,
        three_routes,
        approach,
        fly_gates,
        land_on_platform,
        orbit_and_map,
        see_and_avoid,
        follow_anything,
        learn_to_reach,
        first_flight_notebook,
    )
}


# Running them ---------------------------------------------------------------------------------------------------------


@contextmanager
def flight(folder: Path, *words: str) -> Iterator[None]:
    """Record simulated drones of these names (the words before the first option) to ``flight.mcap``."""
    count = next((number for number, word in enumerate(words) if word.startswith("--")), len(words))
    names, options = words[:count], words[count:]
    cameras = next((word.partition("=")[2] for word in options if word.startswith("cameras=")), "front")
    channels = ["feedback", "annotations", *([] if cameras == "none" else [f"video.{cameras}"])]
    base = names[0] if count == 1 else names[0].rstrip("0123456789")
    with ExitStack() as stack:
        stack.enter_context(
            started("-m", "skyloop", "sim", "--name", base, "--drones", str(count), *options, until="ready")
        )
        stack.enter_context(skyloop.record(names, folder / "flight.mcap", channels=channels))
        yield


@contextmanager
def started(*words: str, until: str = "") -> Iterator[None]:
    """Run a Python process during the block, which begins once the process has printed ``until``."""
    with subprocess.Popen([sys.executable, "-u", *words], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            while until and until not in process.stdout.readline():
                assert process.poll() is None, f"{words} ended without saying {until!r}"
            yield
        finally:
            process.terminate()


def run(example: str, *words: str) -> str:
    """Run an example to its end; return its output."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{example}.py"), *words], check=True, stdout=subprocess.PIPE, text=True
    )
    print(*(f"{example}: {line}" for line in done.stdout.splitlines()[-6:]), sep="\n")
    return done.stdout


def keep(name: str, pictures: list[Picture]) -> None:
    save(PICTURES / f"{name}.webp", pictures, MOST_BYTES)


if __name__ == "__main__":
    main()
