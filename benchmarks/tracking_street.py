"""Fit and validate the confidence of the long-term tracker's scores: ``python -m benchmarks.tracking_street``.

A camera circles figures of the simulator's outdoor worlds, whose true boxes are known. On some seeds a monotone
function is fitted from the score to the fraction of boxes that overlap the true one by half or more; the table comes
from other seeds.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any, Final

import cv2
import numpy as np

from benchmarks.tracking_scenes import Sequence, Step, Truth
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim import load_world
from skyloop.sim.camera import CameraModel
from skyloop.sim.labels import Labeller
from skyloop.sim.render import PlanarRenderer, Scene, SceneState
from skyloop.sim.targets import TargetTrack
from skyloop.vision import LongTermTracker
from skyloop.vision.tracking import overlap

WORLDS: Final = ("street", "yard")
FIT_SEEDS: Final = range(8)
HELD_BACK_SEEDS: Final = range(100, 108)
PERIOD_S: Final = 0.1
OVERLAP: Final = 0.5
KNOTS: Final = (0.45, 0.55, 0.65, 0.75, 0.85, 0.95)  #: centres of the score bins
_LEAST_PX: Final = 24  # minimum height of a target at the start
_MODEL: Final = CameraModel("bench", 320, 240, 10.0, 240.0, 240.0, 159.5, 119.5)


def street(world_name: str, seed: int, count: int = 60) -> Sequence:
    """Return one figure of a world, chosen by the seed, seen by a camera that circles it; 10 images a second."""
    return Sequence(f"{world_name} {seed}", lambda: _seen(world_name, seed, count))


def _seen(world_name: str, seed: int, count: int) -> Iterator[Step]:
    rng = np.random.default_rng([seed, *world_name.encode()])
    world = load_world(world_name, seed)
    tracks = [TargetTrack(target, seed, n) for n, target in enumerate(world.targets)]
    scene = Scene(world, 0)
    renderer, labeller = PlanarRenderer(scene), Labeller(scene)
    moving = [n for n, track in enumerate(tracks) if track.at(2.0).walked_m > 0.5]
    number = moving[seed % len(moving)]
    start_s, bearing = float(rng.uniform(0, 30)), float(rng.uniform(-math.pi, math.pi))
    rate, away, height = float(rng.uniform(-0.25, 0.25)), float(rng.uniform(3.0, 6.0)), float(rng.uniform(1.2, 2.4))
    started = 0
    for n in range(count + 200):
        time_s = start_s + n * PERIOD_S
        states = tuple(track.at(time_s) for track in tracks)
        x, y, _ = states[number].position_m
        angle = bearing + rate * n * PERIOD_S
        yaw = angle + math.pi + 0.12 * math.sin(0.9 * n * PERIOD_S)
        place = np.array([x + away * math.cos(angle), y + away * math.sin(angle), height])
        pitch = math.atan2(height - 0.9, away) + 0.05 * math.sin(1.7 * n * PERIOD_S)
        pose = _MODEL.pose(place, rotation_from_euler(0.03 * math.sin(n * PERIOD_S), pitch, yaw))
        light = world.light.at(time_s, seed)
        state = SceneState(np.zeros((0, 3)), np.zeros((0, 3, 3)), states, light)
        label = next((b for b in labeller.boxes(state, pose, _MODEL) if b.name == world.targets[number].name), None)
        if not started and (label is None or label.visible < 0.8 or label.cut or label.box[3] < _LEAST_PX):
            continue
        started += 1
        image: Any = renderer.render(state, pose, _MODEL)
        noise = rng.normal(0, 3, image.shape).round().astype(np.int16)
        seen = 0.0 if label is None else label.visible
        truth: Truth = None
        if label is not None and seen >= 0.1:
            x0, y0, width, across = label.box
            truth = (float(x0), float(y0), float(width), float(across))
        yield np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), np.uint8), truth, not 0.1 <= seen < 0.5
        if started == count:
            return


def scored(sequences: Iterable[Sequence]) -> list[tuple[float, bool]]:
    """Return the score, and whether the overlap is a half or more, of each box that the long-term tracker returns."""
    found = []
    for sequence in sequences:
        tracker, started = LongTermTracker(), False
        for image, truth, counts in sequence.frames():
            if not started:
                assert truth is not None
                tracker.start(image, truth)
                started = True
                continue
            result = tracker.update(image)
            if counts and result.box is not None:
                good = truth is not None and overlap(result.box, truth) >= OVERLAP
                found.append((result.score, bool(good)))
    return found


def fitted(pairs: list[tuple[float, bool]]) -> tuple[float, ...]:
    """Return a monotone fraction for each of KNOTS: that of its bin, pulled towards a half by two boxes, and pooled."""
    blocks: list[list[float]] = []  # fraction, weight, knots
    for knot in KNOTS:
        goods = [good for score, good in pairs if abs(score - knot) <= 0.05]
        blocks.append([(sum(goods) + 1) / (len(goods) + 2), len(goods) + 2, 1])
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            last, before = blocks.pop(), blocks.pop()
            weight = last[1] + before[1]
            blocks.append([(last[0] * last[1] + before[0] * before[1]) / weight, weight, last[2] + before[2]])
    return tuple(round(share, 3) for share, _, knots in blocks for _ in range(int(knots)))


def reliability(pairs: list[tuple[float, bool]], shares: tuple[float, ...]) -> list[tuple[str, int, float, float]]:
    """Return bins of confidence: range, boxes, mean confidence, observed fraction."""
    confidences = np.interp([score for score, _ in pairs], KNOTS, shares)
    goods = np.array([good for _, good in pairs])
    rows = []
    for low, high in pairwise((0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.001)):
        chosen = (confidences >= low) & (confidences < high)
        if chosen.any():
            name = f"{low:.2f} to {min(high, 1.0):.2f}"
            rows.append((name, int(chosen.sum()), float(confidences[chosen].mean()), float(goods[chosen].mean())))
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Fit, and print the table of the validation sequences."""
    parser = argparse.ArgumentParser(prog="benchmarks.tracking_street", description=__doc__)
    parser.add_argument("--images", type=int, default=60, help="images of each sequence")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    fit, held = (
        scored([street(name, seed, options.images) for name in WORLDS for seed in seeds])
        for seeds in (FIT_SEEDS, HELD_BACK_SEEDS)
    )
    shares = fitted(fit)
    print(f"{len(fit)} boxes fitted, {sum(good for _, good in fit)} good: {dict(zip(KNOTS, shares, strict=True))}")
    print("| confidence | boxes | mean confidence | overlap of a half or more |\n|---|---|---|---|")
    for name, boxes, mean, share in reliability(held, shares):
        print(f"| {name} | {boxes} | {mean:.2f} | {share:.1%} |")


if __name__ == "__main__":
    main()
