"""Clones a controller: records how FollowMarker flies, learns it from pictures and state, and flies what it learnt.

    pip install 'skyloop[all]' torch onnx
    python -m scripts.clone_follower clone                         # into this folder; half an hour on two cores
    python -m scripts.clone_follower clone --flights 2 --epochs 1  # does it work here?

The flights are recordings like any others: those of a real drone are learnt from in the same way.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

import skyloop
from skyloop.clock import nanoseconds
from skyloop.control import FollowMarker, OnnxPolicy
from skyloop.control.follow_law import Mode
from skyloop.logfile.reader import Recording
from skyloop.messages import Attitude, Velocity
from skyloop.messages.annotation import Shape
from skyloop.recording.review.lerobot import export_lerobot
from skyloop.vision import MarkerDetector

TASK = "follow the marker"
MARKER = 7  # that somebody carries about in the simulated room
WIDTH, HEIGHT = 96, 72  # of the pictures that the network takes
KNOWN = ["roll_rad", "pitch_rad", "altitude_m", "velocity_forward_m_s", "velocity_left_m_s", "velocity_up_m_s"]


class Disturbed(FollowMarker):
    """The teacher, pushed aside now and then: what is learnt must know the way back, which a good teacher never shows.

    Marks part the flight: a push is an episode of less than a second, which the export leaves out.
    """

    def __init__(self, drone: skyloop.Drone, seed: int) -> None:
        super().__init__(drone, MARKER)
        self.random = np.random.default_rng(seed)
        self.until_ns = 0
        self.pushed = False
        self.push = Velocity()

    def fly(self, now_ns: int) -> None:
        if self.mode is Mode.FOLLOWING and now_ns >= self.until_ns:
            self.pushed = not self.pushed
            self.until_ns = now_ns + nanoseconds(0.7 if self.pushed else self.random.uniform(1.5, 3.0))
            self.push = Velocity(*(self.random.uniform(-1, 1, 4) * (0.5, 0.5, 0.3, 1.2)).tolist())
            self.drone.log.text("pushed" if self.pushed else TASK, name="mark")
        super().fly(now_ns)

    def steer(self, wanted: Velocity | Attitude) -> None:
        super().steer(self.push if self.pushed and self.mode is Mode.FOLLOWING else wanted)


def record(folder: Path, flights: int, seconds: float) -> list[Path]:
    """Fly the teacher, every second time disturbed; each flight has noise and gusts of its own."""
    paths = [folder / f"flight-{number}.mcap" for number in range(flights)]
    for number, path in enumerate(paths):
        with skyloop.connect(f"sim://?cameras=front&fps=15&wind=2&seed={number + 1}") as drone:
            drone.takeoff()
            with skyloop.record(drone, path, overwrite=True):
                follower = Disturbed(drone, number) if number % 2 else FollowMarker(drone, MARKER)
                follower.run(seconds=seconds)
            drone.land()
        print(f"{path}: the marker was in view in {follower.score.share_in_view or 0.0:.0%} of the frames", flush=True)
    return paths


def rows_of(dataset: Path) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
    """Pictures (n, 3, HEIGHT, WIDTH) uint8 in red, green, blue; states (n, 6); actions (n, 4)."""
    table = pq.read_table(dataset / "data" / "chunk-000" / "file-000.parquet")
    names = json.loads((dataset / "meta" / "info.json").read_text())["features"]["observation.state"]["names"]
    state = np.array(table["observation.state"].to_pylist(), np.float32)[:, [names.index(name) for name in KNOWN]]
    with av.open(str(dataset / "videos" / "observation.images.front" / "chunk-000" / "file-000.mp4")) as film:
        whole = (frame.to_ndarray(format="rgb24") for frame in film.decode(video=0))
        pictures = [cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for image in whole]
    seen = np.stack(pictures).transpose(0, 3, 1, 2).astype(np.uint8, copy=False)
    return seen, state, np.array(table["action"].to_pylist(), np.float32)


def train(dataset: Path, policy: Path, epochs: int) -> float:
    """Learn the action of each row, and write the network; return its RMS error on rows that it has not learnt from."""
    import torch
    from torch import nn

    pictures, state, action = rows_of(dataset)
    torch.manual_seed(0)
    mean, spread, scale = state.mean(0), state.std(0) + 1e-3, action.std(0) + 1e-2

    class Policy(nn.Module):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            steps = [(3, 24), (24, 32), (32, 48), (48, 64)]
            self.see = nn.Sequential(
                *(layer for a, b in steps for layer in (nn.Conv2d(a, b, 5, 2, 2), nn.BatchNorm2d(b), nn.ReLU())),
                nn.Flatten(),
                nn.Dropout(0.1),
                nn.Linear(64 * (HEIGHT // 16 + (HEIGHT % 16 > 0)) * (WIDTH // 16), 64),
                nn.ReLU(),
            )
            self.act = nn.Sequential(nn.Linear(64 + len(KNOWN), 64), nn.ReLU(), nn.Linear(64, action.shape[1]))
            self.mean, self.spread, self.scale = (nn.Buffer(torch.tensor(each)) for each in (mean, spread, scale))

        def forward(self, picture: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
            known = (state - self.mean) / self.spread
            return self.act(torch.cat([self.see(picture), known], 1)) * self.scale

    # The last tenth of the rows is kept apart: rows beside each other are too much alike to judge by.
    count = len(pictures) * 9 // 10
    seen, known, wanted = torch.from_numpy(pictures), torch.from_numpy(state), torch.from_numpy(action)
    network = Policy()
    optimiser = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, epochs * (count // 64 + 1))
    mirrored_state = torch.tensor([name in ("roll_rad", "velocity_left_m_s") for name in KNOWN])
    mirrored_action = torch.tensor([False, True, False, True])
    weights = 1 / torch.from_numpy(scale)
    for epoch in range(epochs):
        network.train()
        total = 0.0
        for batch in torch.randperm(count).split(64):
            picture = seen[batch].float() / 255
            flip = torch.rand(len(batch)) < 0.5  # in a mirror, left is right
            picture = torch.where(flip[:, None, None, None], picture.flip(3), picture)
            side = torch.where(flip[:, None], -1.0, 1.0)
            state_sign = torch.where(mirrored_state, side, torch.ones_like(side))
            action_sign = torch.where(mirrored_action, side, torch.ones_like(side))
            picture = (picture * (0.7 + 0.6 * torch.rand(len(batch), 1, 1, 1))).clamp(0, 1)  # in other light
            error = (
                ((network(picture, known[batch] * state_sign) - wanted[batch] * action_sign) * weights).square().mean()
            )
            optimiser.zero_grad()
            error.backward()
            optimiser.step()
            schedule.step()
            total += error.item() * len(batch)
        print(f"epoch {epoch + 1}: mean squared error {total / count:.3f}", flush=True)
    network.eval()
    with torch.no_grad():
        rest = [network(seen[part].float() / 255, known[part]) for part in torch.arange(count, len(seen)).split(64)]
    write(network, policy)
    return float((torch.cat(rest) - wanted[count:]).square().mean().sqrt())


def write(network: Any, policy: Path) -> None:
    """Write the network with the names of what it takes and gives."""
    import onnx
    import torch

    example = torch.zeros(1, 3, HEIGHT, WIDTH), torch.zeros(1, len(KNOWN))
    names = ["observation.images.front", "observation.state"]
    torch.onnx.export(network, example, policy, input_names=names, output_names=["action"], dynamo=False)
    model = onnx.load(policy)
    about = {"skyloop.state": KNOWN, "skyloop.action": ["forward", "left", "up", "yaw_rate"]}
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in about.items()})
    onnx.save(model, policy)


class Judged(OnnxPolicy):
    """The policy, with a judge that knows where the marker is."""

    def __init__(self, drone: skyloop.Drone, policy: Path) -> None:
        super().__init__(drone, policy)
        self.detector = MarkerDetector("4x4_50", size_m=0.3)
        self.frames = self.in_view = 0

    def look(self, frame: skyloop.Frame) -> list[Shape]:
        self.frames += 1
        self.in_view += any(marker.id == MARKER for marker in self.detector.detect(frame))
        return super().look(frame)


def fly(policy: Path, seconds: float, seed: int) -> float:
    """Fly what was learnt, from before the marker on; return the share of frames with the marker in view."""
    with skyloop.connect(f"sim://?cameras=front&fps=15&seed={seed}") as drone:
        drone.takeoff()
        follower = FollowMarker(drone, MARKER)
        follower.run(seconds=8.0)  # finds it: the policy has no memory, so it can't search
        learnt = Judged(drone, policy)
        learnt.run(seconds=seconds)
        drone.land()
    return learnt.in_view / max(learnt.frames, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of recordings, data set and policy")
    parser.add_argument("--flights", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=45.0, help="of each flight")
    parser.add_argument("--epochs", type=int, default=26)
    parser.add_argument("--judged", type=int, default=6, help="flights of what was learnt")
    parser.add_argument("--part", choices=["record", "train", "fly"], help="only this; else all, one after the other")
    given = parser.parse_args()
    dataset, policy = given.folder / "dataset", given.folder / "policy.onnx"
    if given.part in (None, "record"):
        given.folder.mkdir(parents=True, exist_ok=True)
        flights = [Recording.open(path) for path in record(given.folder, given.flights, given.seconds)]
        found = export_lerobot(flights, dataset, cameras=["front"], fps=15.0, task=TASK)
        print(f"{dataset}: {found.episodes} episodes, {found.rows} rows", flush=True)
    if given.part in (None, "train"):
        print(f"{policy}: RMS error {train(dataset, policy, given.epochs):.3f} on what it has not learnt from")
    if given.part in (None, "fly"):
        shares = [fly(policy, 30.0, seed) for seed in range(1000, 1000 + given.judged)]
        print("flown by what was learnt, the marker in view:", ", ".join(f"{share:.0%}" for share in shares))
        print(f"mean of {len(shares)} flights: {np.mean(shares):.0%}")


if __name__ == "__main__":
    main()
