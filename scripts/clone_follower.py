"""Clone a controller: the marker follower teaches a network, which sees pictures and state, and then flies.

    skyloop install all && pip install torch onnx
    python -m scripts.clone_follower clone                                   # into this folder
    python -m scripts.clone_follower clone --rounds 1 --flights 1 --epochs 1 # does it work here?

The lessons are flights in simulated time. In the first round the teacher flies, in later ones mostly the present
network; the network always learns the teacher's answer to each picture, and so from its own mistakes (DAgger: Ross,
Gordon and Bagnell, "A reduction of imitation learning and structured prediction to no-regret online learning", AISTATS
2011). The recordings are ordinary ones: a real drone's work in the same way.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

if missing := [name for name in ("av", "cv2", "pyarrow", "torch", "onnx") if find_spec(name) is None]:
    sys.exit(f"this needs {', '.join(missing)}: skyloop install all, and pip install torch onnx")

import av
import cv2
import pyarrow.parquet as pq

import skyloop
from skyloop.clock import nanoseconds
from skyloop.control import FollowMarker, OnnxPolicy, PolicyNetwork
from skyloop.control.rehearsal import Radio, rehearse
from skyloop.messages import Attitude, Velocity
from skyloop.messages.relayed import Shape
from skyloop.messages.rows import ACTIONS, state_row
from skyloop.recording.reader import Recording
from skyloop.recording.review.lerobot import export_lerobot
from skyloop.vision import MarkerDetector
from skyloop.vision.lens import pixels_of

TASK = "follow the marker"
MARKER = 7  # carried around in the simulated room
FPS = 15
WIDTH, HEIGHT = 64, 48  # of the network's input pictures
MEMORY = 64  # numbers kept from picture to picture
STREAMS, STEPS = 12, 8  # batch: parts of flights, and pictures of each
KNOWN = ["roll_rad", "pitch_rad", "altitude_m", "velocity_forward_m_s", "velocity_left_m_s", "velocity_up_m_s"]
ACTION = ACTIONS["velocity"]
DIRECT = Radio(command_delay_s=0, feedback_delay_s=0, picture_delay_s=0, drop=0, position_noise_m=0)


class Lesson(FollowMarker):
    """The teacher answers each picture; by turns its answer, the pupil's, or a random push is flown."""

    def __init__(self, drone: skyloop.Drone, seed: int, pupil: PolicyNetwork | None) -> None:
        super().__init__(drone, MARKER)
        self.random = np.random.default_rng(seed)
        self.pupil = pupil
        self.answer: Velocity | Attitude | None = None  # the pupil's
        self.pilot, self.until_ns = "teacher", 0
        self.push = Velocity()
        self.captured_ns = 0

    def look(self, frame: skyloop.Frame) -> list[Shape]:
        row = None if frame.feedback is None else state_row(frame.feedback, KNOWN)
        # The pupil always watches, so that it remembers.
        self.answer = None if self.pupil is None or row is None else self.pupil(pixels_of(frame), row)
        self.captured_ns = frame.captured_ns
        return super().look(frame)

    def fly(self, now_ns: int) -> None:
        if now_ns >= self.until_ns:
            pushed = self.pilot != "push" and self.random.random() < 0.4
            flies = "teacher" if self.pupil is None or self.random.random() < 0.25 else "pupil"
            self.pilot = "push" if pushed else flies
            self.until_ns = now_ns + nanoseconds(
                self.random.uniform(0.3, 1.0) if pushed else self.random.uniform(1.5, 4.0)
            )
            self.push = Velocity(*(self.random.uniform(-1, 1, 4) * (0.5, 0.5, 0.3, 1.2)).tolist())
        super().fly(now_ns)

    def steer(self, wanted: Velocity | Attitude) -> None:
        self.drone.log.array("action", [getattr(wanted, name) for name in ACTION], at_ns=self.captured_ns)
        super().steer({"teacher": wanted, "push": self.push, "pupil": self.answer or wanted}[self.pilot])


def fly_lesson(path: Path, seed: int, seconds: float, policy: Path | None) -> float:
    """Record a lesson, with its own noise and gusts; return the share of frames that show the marker."""
    with rehearse(f"sim://?cameras=front&fps={FPS}&wind=2&seed={seed}", radio=DIRECT) as drone:
        drone.takeoff()
        with skyloop.record(drone, path, channels=["feedback", "commands", "logs", "video"], overwrite=True):
            lesson = Lesson(drone, seed, None if policy is None else PolicyNetwork(policy))
            lesson.run(seconds=seconds)
        drone.land()
    return lesson.score.share_in_view or 0.0


def record(folder: Path, seeds: range, seconds: float, policy: Path | None) -> Path:
    """Fly lessons, one per core at a time, and export them; return the data set."""
    paths = [folder / f"flight-{seed}.mcap" for seed in seeds]
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        each = repeat(seconds), repeat(policy)
        for path, share in zip(paths, pool.map(fly_lesson, paths, seeds, *each), strict=True):
            print(f"{path}: the marker was in view in {share:.0%} of the frames", flush=True)
    dataset = folder / f"dataset-{seeds[0]}"
    found = export_lerobot([Recording.open(path) for path in paths], dataset, cameras=["front"], fps=FPS, task=TASK)
    print(f"{dataset}: {found.episodes} episodes, {found.rows} rows", flush=True)
    return dataset


Rows = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]


def rows_of(dataset: Path) -> Rows:
    """Return pictures (n, 3, HEIGHT, WIDTH) in red, green, blue; states (n, 6); actions (n, 4); episode starts (n,)."""
    table = pq.read_table(dataset / "data" / "chunk-000" / "file-000.parquet")
    names = json.loads((dataset / "meta" / "info.json").read_text())["features"]["observation.state"]["names"]
    state = np.array(table["observation.state"].to_pylist(), np.float32)[:, [names.index(name) for name in KNOWN]]
    with av.open(str(dataset / "videos" / "observation.images.front" / "chunk-000" / "file-000.mp4")) as film:
        whole = (frame.to_ndarray(format="rgb24") for frame in film.decode(video=0))
        pictures = [cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for image in whole]
    seen = np.stack(pictures).transpose(0, 3, 1, 2).astype(np.uint8)
    return seen, state, np.array(table["action"].to_pylist(), np.float32), table["frame_index"].to_numpy() == 0


def new_network(state: NDArray[np.float32], action: NDArray[np.float32]) -> Any:
    """Return an untrained network, scaled for numbers like these."""
    import torch
    from torch import nn

    class Network(nn.Module):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            layers = [(3, 16, 5), (16, 32, 3), (32, 48, 3), (48, 64, 3)]
            self.eyes = nn.Sequential(
                *(each for a, b, k in layers for each in (nn.Conv2d(a, b, k, 2, k // 2), nn.BatchNorm2d(b), nn.ReLU())),
                nn.Flatten(),
                nn.Dropout(0.1),
                nn.Linear(64 * (HEIGHT // 16) * (WIDTH // 16), 64),
                nn.ReLU(),
            )
            self.remember = nn.GRUCell(64 + len(KNOWN), MEMORY)
            self.act = nn.Sequential(nn.Linear(64 + len(KNOWN) + MEMORY, 64), nn.ReLU(), nn.Linear(64, len(ACTION)))
            self.mean, self.spread = (
                nn.Buffer(torch.tensor(state.mean(0))),
                nn.Buffer(torch.tensor(state.std(0) + 1e-3)),
            )
            self.scale = nn.Buffer(torch.tensor(action.std(0) + 1e-2))

        def see(self, pictures: torch.Tensor, states: torch.Tensor) -> torch.Tensor:
            return torch.cat([self.eyes(pictures), (states - self.mean) / self.spread], 1)

        def decide(self, seen: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            memory = self.remember(seen, memory)
            return self.act(torch.cat([seen, memory], 1)) * self.scale, memory

        def forward(self, picture: torch.Tensor, state: torch.Tensor, memory: torch.Tensor) -> Any:
            return self.decide(self.see(picture, state), memory)

    return Network()


def train(network: Any, rows: Rows, epochs: int) -> None:
    """Learn the teacher's actions from flights in sequence, part by part."""
    import torch

    pictures, state, action, first = (torch.from_numpy(each) for each in rows)
    length = len(state) // STREAMS // STEPS * STEPS
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, epochs * (length // STEPS))
    mirrored = torch.tensor([-1.0 if name in ("roll_rad", "velocity_left_m_s") else 1.0 for name in KNOWN])
    mirrored_action = torch.tensor([-1.0 if name in ("left", "yaw_rate") else 1.0 for name in ACTION])
    network.train()
    for epoch in range(epochs):
        streams = (torch.arange(STREAMS * length) + torch.randint(len(state), (1,))) % len(state)
        memory, total = torch.zeros(STREAMS, MEMORY), 0.0
        flip = (torch.rand(STREAMS) < 0.5)[:, None]  # in a mirror, left is right
        for part in streams.view(STREAMS, length).split(STEPS, 1):
            many = part.flatten()
            wide = flip.expand(-1, STEPS).reshape(-1, 1)
            light = (0.7 + 0.6 * torch.rand(STREAMS, 1)).expand(-1, STEPS).reshape(-1, 1, 1, 1)
            picture = (pictures[many].float() / 255 * light).clamp(0, 1)
            picture = torch.where(wide[:, None, None], picture.flip(3), picture)
            seen = network.see(picture, torch.where(wide, state[many] * mirrored, state[many]))
            wanted = torch.where(wide, action[many] * mirrored_action, action[many]).view(STREAMS, STEPS, -1)
            error = torch.zeros(())
            for step, now in enumerate(seen.view(STREAMS, STEPS, -1).unbind(1)):
                memory = torch.where(first[part[:, step], None], 0.0, memory)
                found, memory = network.decide(now, memory)
                error = error + ((found - wanted[:, step]) / network.scale).square().mean() / STEPS
            memory = memory.detach()
            optimiser.zero_grad()
            error.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            schedule.step()
            total += error.item() * STEPS / length
        print(f"epoch {epoch + 1}: mean squared error {total:.3f}", flush=True)
    network.eval()


def write(network: Any, policy: Path) -> None:
    """Write the network with the names of its inputs and outputs."""
    import onnx
    import torch

    example = torch.zeros(1, 3, HEIGHT, WIDTH), torch.zeros(1, len(KNOWN)), torch.zeros(1, MEMORY)
    given, found = ["observation.images.front", "observation.state", "memory"], ["action", "next_memory"]
    torch.onnx.export(network, example, policy, input_names=given, output_names=found, dynamo=False)
    model = onnx.load(policy)
    onnx.helper.set_model_props(model, {"skyloop.state": json.dumps(KNOWN), "skyloop.action": json.dumps(ACTION)})
    onnx.save(model, policy)


def learn(folder: Path, rounds: int, flights: int, seconds: float, epochs: int) -> None:
    """Record and learn, round by round, from all recordings so far; write the network after each round."""
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)  # more are slower for such a small network
    policy, network = folder / "policy.onnx", None
    folder.mkdir(parents=True, exist_ok=True)
    known: list[Rows] = []
    for number in range(rounds):
        seeds = range(number * flights + 1, (number + 1) * flights + 1)
        known.append(rows_of(record(folder, seeds, seconds, policy if number else None)))
        pictures, states, actions, first = (np.concatenate(each) for each in zip(*known, strict=True))
        network = network or new_network(states, actions)
        train(network, (pictures, states, actions, first), epochs)
        write(network, policy)


class Judged(OnnxPolicy):
    """The policy, with a judge that knows the marker's position."""

    def __init__(self, drone: skyloop.Drone, policy: Path) -> None:
        super().__init__(drone, policy)
        self.detector = MarkerDetector("4x4_50", size_m=0.3)
        self.frames = self.in_view = 0

    def look(self, frame: skyloop.Frame) -> list[Shape]:
        self.frames += 1
        self.in_view += any(marker.id == MARKER for marker in self.detector.detect(frame))
        return super().look(frame)


def fly(policy: Path, seconds: float, seed: int, rehearsed: bool) -> float:
    """Fly the learnt policy, starting before the marker; return the share of frames that show the marker."""
    uri = f"sim://?cameras=front&fps={FPS}&seed={seed}"
    with rehearse(uri, radio=DIRECT) if rehearsed else skyloop.connect(uri) as drone:
        drone.takeoff()
        FollowMarker(drone, MARKER).run(seconds=8.0)  # finds it
        learnt = Judged(drone, policy)
        learnt.run(seconds=seconds)
        drone.land()
    return learnt.in_view / max(learnt.frames, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for recordings, data sets and policy")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--flights", type=int, default=12, help="flights of each round")
    parser.add_argument("--seconds", type=float, default=45.0, help="duration of each flight")
    parser.add_argument("--epochs", type=int, default=12, help="epochs of each round")
    parser.add_argument(
        "--seeds", type=int, nargs="*", default=range(1000, 1006), help="seeds of the flights with the learnt policy"
    )
    parser.add_argument("--rehearsed", action="store_true", help="fly these in simulated time, reproducibly")
    parser.add_argument("--part", choices=["learn", "fly"], help="only this part [default: both]")
    given = parser.parse_args()
    if given.part != "fly":
        learn(given.folder, given.rounds, given.flights, given.seconds, given.epochs)
    if given.part != "learn":
        shares = [fly(given.folder / "policy.onnx", 30.0, seed, given.rehearsed) for seed in given.seeds]
        print("flown by the learnt policy, the marker in view:", ", ".join(f"{share:.0%}" for share in shares))
        print(f"mean of {len(shares)} flights: {np.mean(shares):.0%}")


if __name__ == "__main__":
    main()
