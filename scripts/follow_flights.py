"""Flights that follow people and cars: worlds and judgement. Run by ``scripts/behaviours.py follow-target``."""

from __future__ import annotations

import math
import random
import re
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Final

from follow_judge import Judge, Truth

from skyloop.client import Drone, Frame
from skyloop.control import ChaseSettings, FollowTarget
from skyloop.control.target_estimate import Traits
from skyloop.messages import Feedback
from skyloop.sim.world_file import load_world
from skyloop.stepping.rehearsal import Radio, rehearse
from skyloop.vision.object_tracks import ObjectDetector
from skyloop.vision.tracking import Box

FLIGHT_S: Final = 40.0
SETTLED_S: Final = 5.0  # the distance counts from then on
AGAIN_S: Final = 3.0  # and this long after it came out of hiding
JUDGED: Final = 2  # every second frame
SWAPPED: Final = 8  # consecutive judged frames (one second) with something else in the target's box
TILT_RAD: Final = 0.5  # in gusts, drag leaves too little of the simulated drone's usual 0.21 rad
_WAIT_S: Final = 60.0
_POINTED_S: Final = 0.5  # how long the target is in view before it is pointed at


@dataclass(frozen=True, slots=True)
class Case:
    """A target and its world."""

    world: Callable[[random.Random], str]  #: the world file for a seed
    target: str = "walker"
    distance_m: float = 4.0
    bearing_rad: float | None = None
    traits: Traits | None = None  #: None: those of its class
    speed_m_s: float = 3.0  #: maximum speed


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one flight."""

    found: bool
    in_view: float  #: share of the frames without occlusion that show the target
    swapped: bool
    rms_m: float  #: of the distance's error without occlusion
    hidden_s: float  #: the longest occlusion
    hits: int
    seconds: float
    note: str

    @property
    def good(self) -> bool:
        """Whether all goals are met."""
        return self.found and self.in_view >= 0.9 and not self.swapped and self.rms_m <= 0.5 and not self.hits


def fly(
    case: Case,
    seed: int,
    gust_m_s: float,
    detector: ObjectDetector | None,
    *,
    class_name: str | None = None,
    options: str = "",
    radio: Radio | None = None,
) -> Outcome:
    """Wait until the target is in view, point at it, follow it."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.toml"
        file.write_text(case.world(random.Random(seed)))
        world = load_world(str(file), seed)
        uri = f"sim://?world={file}&cameras=front&fps=15&seed={seed}{options}"
        radio = radio or Radio(command_delay_s=0.1, seed=seed)
        with rehearse(uri, radio=radio) as drone:
            drone.config["sim.wind"] = (0.0, 0.0, 0.0)
            drone.config["sim.gust"] = gust_m_s
            drone.config["limits.speed"], drone.config["limits.tilt"] = 2.0 * case.speed_m_s, TILT_RAD
            drone.takeoff()
            flight = JudgedFlight(drone, Judge(world, case.target), case, detector)
            return flight.outcome(class_name)


def reported(frame: Frame) -> Feedback | None:
    """Return the state at the frame's capture, with the truth reported by the simulator's driver."""
    return frame.feedback


class JudgedFlight:
    """A flight judged by the truth.

    Args:
        drone: In the air.
        judge: Knows the truth of the target.
        case: The target and its world.
        detector: The behaviour's detector.
        state_of: Returns a state with the truth at or near a frame's capture.
        later: Judge after the flight, because a flight in real time leaves no time for it.
    """

    def __init__(
        self,
        drone: Drone,
        judge: Judge,
        case: Case,
        detector: ObjectDetector | None,
        *,
        state_of: Callable[[Frame], Feedback | None] = reported,
        later: bool = False,
    ) -> None:
        self._drone, self._judge, self._case, self._detector = drone, judge, case, detector
        self._state_of, self._later = state_of, later
        self._unjudged: list[tuple[int, Feedback, Box | None]] = []
        self._truths: list[tuple[int, Truth]] = []
        self._strangers: dict[str, int] = {}
        self._in_a_row = 0
        self._worst_row = 0
        self._hits = 0
        self._frames = 0

    def outcome(self, class_name: str | None, seconds: float = FLIGHT_S) -> Outcome:
        """Fly and judge. The target is the largest of a class, or the content of its true box."""
        drone = self._drone
        drone.on_event(self._count_hits)
        start = self._first_box()
        if start is None:
            return Outcome(False, 0.0, False, math.nan, 0.0, 0, 0.0, "the target never came into view")
        self._hits = 0
        pilot = _Judged(self, drone, start if class_name is None else None, class_name, self._detector, self._case)
        run = pilot.run(seconds=seconds)
        if self._later:
            drone.hover()
            for captured_ns, state, box in self._unjudged:
                self._judged(captured_ns, state, box)
        clear = [truth for _, truth in self._truths if not truth.hidden]
        begin = self._truths[0][0] if self._truths else 0
        errors, out_ns = [], begin  # the time since which it is visible
        for at, truth in self._truths:
            out_ns = at if truth.hidden else out_ns
            if at - begin > SETTLED_S * 1e9 and (out_ns == begin or at - out_ns > AGAIN_S * 1e9):
                errors.append(truth.distance_m - self._case.distance_m)
        rms = math.sqrt(statistics.fmean(error**2 for error in errors)) if errors else math.nan
        share = sum(truth.in_view for truth in clear) / max(1, len(clear))
        swapped = self._worst_row >= SWAPPED
        note = f"{share:.0%} in view, {pilot.phase.value}"
        if self._strangers:
            note += f", took {', '.join(f'{k} ({v})' for k, v in self._strangers.items())} for it"
        if self._hits:
            note += f", touched {self._hits}"
        return Outcome(True, share, swapped, rms, self._longest_hidden(), self._hits, run.seconds, note)

    def _count_hits(self, event: object) -> None:
        self._hits += getattr(event, "kind", "") == "collision"

    def _first_box(self) -> tuple[float, float, float, float] | None:
        """Point at the target after it was in view for a second."""
        begin, since = None, None
        for frame in self._drone.frames():
            begin = begin or frame.captured_ns
            if frame.captured_ns - begin > _WAIT_S * 1e9:
                return None
            state = self._state_of(frame)
            if state is None:
                continue
            truth = self._judge.at(state, frame.captured_ns)
            mine = truth.box
            clear = mine is not None and not mine.cut and mine.visible > 0.9 and mine.box[3] >= 24
            since = (since or frame.captured_ns) if clear and truth.distance_m < 8 else None
            if mine is not None and since is not None and frame.captured_ns - since > _POINTED_S * 1e9:
                x, y, width, height = mine.box
                return float(x), float(y), float(width), float(height)
        return None

    def judge(self, frame: Frame, pilot: FollowTarget) -> None:
        """Judge the result of every second frame."""
        self._frames += 1
        state = self._state_of(frame)
        if state is None or self._frames % JUDGED:
            return
        box = pilot.follower.sighting.box
        if self._later:
            self._unjudged.append((frame.captured_ns, state, box))
            return
        self._judged(frame.captured_ns, state, box)

    def _judged(self, captured_ns: int, state: Feedback, box: Box | None) -> None:
        truth = self._judge.at(state, captured_ns)
        self._truths.append((captured_ns, truth))
        shown = None if box is None else truth.image.shown_in(box)
        if shown is not None and shown != self._case.target:
            self._strangers[shown] = self._strangers.get(shown, 0) + 1
            self._in_a_row += 1
            self._worst_row = max(self._worst_row, self._in_a_row)
        elif box is not None:
            self._in_a_row = 0

    def _longest_hidden(self) -> float:
        longest, since = 0.0, None
        for at, truth in self._truths:
            since = (since or at) if truth.hidden else None
            longest = max(longest, 0.0 if since is None else (at - since) / 1e9)
        return longest


class _Judged(FollowTarget):
    def __init__(
        self,
        flight: JudgedFlight,
        drone: Drone,
        box: tuple[float, float, float, float] | None,
        class_name: str | None,
        detector: ObjectDetector | None,
        case: Case,
    ) -> None:
        settings = ChaseSettings(case.distance_m, bearing_rad=case.bearing_rad, speed_m_s=case.speed_m_s)
        super().__init__(drone, box, class_name=class_name, detector=detector, traits=case.traits, settings=settings)
        self._flight = flight

    def on_frame(self, frame: Frame) -> None:
        super().on_frame(frame)
        self._flight.judge(frame, self)


# Worlds ----------------------------------------------------------------------------------------------------------


def _scenery(name: str) -> str:
    """Return a shipped world without its targets and its start."""
    text = resources.files("skyloop.sim").joinpath(f"worlds/{name}.toml").read_text()
    tables = re.split(r"(?m)^(?=\[)", text)
    return "".join(one for one in tables if not one.startswith(("[[target]]", "[[spawn]]")))


def spawn(x: float, y: float, yaw_deg: float) -> str:
    return f"[[spawn]]\nposition = [{x}, {y}, 0]\nyaw_deg = {yaw_deg}\n"


def person(name: str, look: int, points: list[tuple[float, float]], speed: float, radius: float = 1.5) -> str:
    points = _rounded(points, radius)
    path = ", ".join(f"[{x:g}, {y:g}, 0]" for x, y in points)
    return (
        f'[[target]]\nname = "{name}"\nkind = "figure"\nshape = "person"\nlook = {look}\n'
        f'path = {{ kind = "waypoints", points = [{path}], speed = {speed:g} }}\n'
    )


def _rounded(points: list[tuple[float, float]], radius: float = 0.8) -> list[tuple[float, float]]:
    """Return the same round trip with rounded corners: no one turns on the spot at full speed."""
    rounded = []
    for before, corner, after in zip([points[-1], *points], points, [*points[1:], points[0]], strict=False):
        ends = []
        for other in (before, after):
            length = math.dist(corner, other)
            share = min(radius, 0.45 * length) / length
            ends.append((corner[0] + share * (other[0] - corner[0]), corner[1] + share * (other[1] - corner[1])))
        (ax, ay), (bx, by) = ends
        for step in range(5):  # a quadratic Bézier curve
            t = step / 4
            a, b, c = (1 - t) ** 2, 2 * t * (1 - t), t * t
            rounded.append((round(a * ax + b * corner[0] + c * bx, 3), round(a * ay + b * corner[1] + c * by, 3)))
    return [one for n, one in enumerate(rounded) if one != rounded[n - 1]]


def _turned(points: list[tuple[float, float]], rng: random.Random) -> list[tuple[float, float]]:
    """Return the same round trip starting at another point."""
    first = rng.randrange(len(points))
    return points[first:] + points[:first]


def rotated(points: list[tuple[float, float]], rng: random.Random) -> list[tuple[float, float]]:
    """Return the same round trip starting at another point, perhaps reversed."""
    turned = _turned(points, rng)
    return turned[::-1] if rng.random() < 0.5 else turned


def walker(rng: random.Random, speed_m_s: float = 1.5) -> str:
    """Return a world in which a person walks up and down the street, at 1.5 m/s, while others use the pavements."""
    points = rotated([(-13, 2), (13, 2), (13, -2), (-13, -2)], rng)
    others = [
        person(f"passer {n}", rng.randrange(1000), [(x, y), (-x, y), (-x, y + 0.4), (x, y + 0.4)], speed)
        for n, (x, y, speed) in enumerate(((13, 6.1, 1.3), (12, -6.4, 1.0)), 1)
    ]
    start = spawn(-17.0, rng.uniform(-0.5, 0.5), 0.0)
    return _scenery("street") + start + person("walker", rng.randrange(1000), points, speed_m_s) + "".join(others)


def car(rng: random.Random) -> str:
    """Return a world in which a car drives around a square at 3 m/s, through bends of 3 m, past parked ones."""
    room = '[room]\nsize = [46, 34, 10]\nfloor = "asphalt"\nenclosed = false\n[light]\namplitude = 0.25\nperiod = 40\n'
    corners = [(-10.0, -5.0), (10.0, -5.0), (10.0, 5.0), (-10.0, 5.0)]
    if rng.random() < 0.5:
        corners.reverse()
    points = _rounded(corners, 4.5)
    first = rng.randrange(len(points))
    path = ", ".join(f"[{x:g}, {y:g}, 0]" for x, y in points[first:] + points[:first])
    parked = "".join(
        f'[[target]]\nname = "parked {n}"\nkind = "figure"\nshape = "car"\nlook = {rng.randrange(1000)}\n'
        f'path = {{ kind = "still", position = [{x}, {y}, 0] }}\nyaw = {{ mode = "fixed", yaw_deg = {turn} }}\n'
        for n, (x, y, turn) in enumerate(((-6, 11, 0), (4, 11, 180), (-4, -11, 0), (15, 2, 90)))
    )
    trees = "".join(
        f'[[box]]\nname = "trunk {n}"\nstands_at = [{x}, {y}]\nsize = [0.3, 0.3, 2.2]\ntexture = "wood"\n'
        for n, (x, y) in enumerate(((-16, 9), (-16, -9), (16, -10), (0, 13)))
    )
    mine = f'[[target]]\nname = "car"\nkind = "figure"\nshape = "car"\nlook = {rng.randrange(1000)}\n'
    mine += f'path = {{ kind = "waypoints", points = [{path}], speed = 3 }}\n'
    return room + spawn(rng.uniform(-2, 2), rng.uniform(-0.5, 0.5), rng.choice((90, -90))) + trees + mine + parked


def hidden(rng: random.Random) -> str:
    """Return a world in which a person walks around a lawn, past two walls that each hide him for about 3 s."""
    room = '[room]\nsize = [34, 26, 10]\nfloor = "grass"\nenclosed = false\n[light]\namplitude = 0.25\nperiod = 40\n'
    ends = [math.radians(15 * n) for n in range(-6, 7)]
    oval = [(5 + 5.5 * math.cos(a), 5.5 * math.sin(a)) for a in ends]  # counter-clockwise: the inside is on his left
    points = _turned([*oval, *((-x, -y) for x, y in oval)], rng)
    walls = "".join(
        f'[[box]]\nname = "wall {side}"\nstands_at = [{rng.uniform(-2, 2):.2f}, {y}]\nsize = [4.8, 0.3, 2.6]\n'
        'texture = "brick"\n'
        for side, y in (("south", -4.7), ("north", 4.7))
    )
    house = '[[box]]\nname = "house"\nstands_at = [0, 10.5]\nsize = [20, 2, 4]\ntexture = "concrete"\n'
    passer = person("passer", rng.randrange(1000), [(-9, 8), (9, 8), (9, 8.5), (-9, 8.5)], 1.2)
    side = rng.choice((1, -1))  # it faces the side where nothing hides him
    start = spawn(side * rng.uniform(2, 4), rng.uniform(-1, 1), 0 if side > 0 else 180)
    return room + start + walls + house + person("walker", rng.randrange(1000), points, 1.5) + passer


def twin(rng: random.Random) -> str:
    """Return a world in which a person's exact twin repeatedly walks past him and back, on either side."""
    look = rng.randrange(1000)
    room = '[room]\nsize = [30, 24, 10]\nfloor = "concrete"\nenclosed = false\n[light]\namplitude = 0.25\nperiod = 40\n'
    points = rotated([(-8.0, -3.0), (8.0, -3.0), (8.0, 3.0), (-8.0, 3.0)], rng)
    aside = rng.choice((-0.7, 0.7))
    half = [(-8.0, -3 + aside), (8.0, -3 + aside), (8.0, 3 + aside), (-8.0, 3 + aside)]
    first = rng.randrange(4)
    others = half[first:] + half[:first]
    clockwise = points.index((8, -3)) == (points.index((-8, -3)) + 1) % 4
    if clockwise:
        others = others[::-1]
    start = spawn(rng.uniform(-2, 2), rng.uniform(-0.5, 0.5), rng.choice((90, -90)))
    return room + start + person("walker", look, points, 1.5) + person("double", look, others, 1.2)


SMALL_CAR: Final = Traits(height_m=1.15, height_share=0.05, radius_m=1.0, intensity_m2_s3=3.0)
CASES: Final = {
    "walker": Case(walker),
    "car": Case(car, target="car", distance_m=5.0, speed_m_s=5.0, traits=SMALL_CAR),
    "hidden": Case(hidden, bearing_rad=math.pi / 2),
    "twin": Case(twin),
}
