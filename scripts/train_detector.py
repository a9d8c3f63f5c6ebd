"""Train the detector of the simulator's figures, ``src/skyloop/vision/weights/figures.onnx``: 20 minutes on one core.

    pip install torch onnx
    python -m scripts.train_detector figures.onnx
    python -m scripts.train_detector figures.onnx --pictures 300 --steps 100    # a minute: does it work here?
    python -m benchmarks.detector figures.onnx                                  # its results, without PyTorch

It renders pictures of people, cars and crates, trains a small convolutional network with them, writes it as an ONNX
file for ``OnnxDetector``, and prints its results on pictures not used for training.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.detector import SCORE, matches, print_scores
from benchmarks.detector_pictures import Image, Picture, Rng, spoil, training_pictures
from benchmarks.detector_scores import balanced_score
from benchmarks.detector_targets import IGNORED, STRIDES, assign, places
from skyloop.errors import SkyloopError, UsageError
from skyloop.sim.labels import CLASS_NAMES
from skyloop.sim.render import use_one_core
from skyloop.vision import OnnxDetector

WIDTH, HEIGHT = 320, 256  #: of the input [px]: whole strides, and a picture of 320×240 is not scaled
GREY: Final = 114  # around it, as in OnnxDetector
OUTPUTS: Final = 4 + len(CLASS_NAMES)
_BATCH: Final = 16
_RATE: Final = 8e-3  # maximum learning rate
_SETTLING: Final = 300  # pictures for calibrating the scores
_SEEN: Final = 0.3  # minimum visible share of a thing that the network must find
_LEAST_PX: Final = 8  # minimum of its longer side; half as much of its shorter one


@dataclass(frozen=True, slots=True)
class Layer:
    """A step of the network: a convolution with ReLU, the sum of two layers, or an upsampling to another's size."""

    name: str
    kind: str  #: "conv", "last" (without ReLU), "sum", "sum and relu" or "grow"
    sources: tuple[str, ...]
    channels: int = 0
    kernel: int = 3
    stride: int = 1


def network() -> tuple[Layer, ...]:
    """Return the steps: a backbone down to stride 32, coarse features added to finer ones, and a head for each stride.

    Residual blocks as in He et al., CVPR 2016; the way up as in Lin et al., "Feature Pyramid Networks", CVPR 2017.
    """
    layers: list[Layer] = []

    def add(name: str, kind: str, *sources: str, channels: int = 0, kernel: int = 3, stride: int = 1) -> str:
        layers.append(Layer(name, kind, sources, channels, kernel, stride))
        return name

    def block(name: str, source: str, channels: int) -> str:
        first = add(f"{name}.1", "conv", source, channels=channels)
        second = add(f"{name}.2", "last", first, channels=channels)
        return add(name, "sum and relu", second, source)

    x = add("stem", "conv", "image", channels=16, stride=2)
    x = add("down4", "conv", x, channels=24, stride=2)
    x = add("down8", "conv", x, channels=40, stride=2)
    fine = block("block8", x, 40)
    x = add("down16", "conv", fine, channels=64, stride=2)
    middle = block("block16", x, 64)
    x = add("down32", "conv", middle, channels=96, stride=2)
    coarse = block("block32b", block("block32", x, 96), 96)
    top = add("top", "conv", coarse, channels=48, kernel=1)
    side = add("side16", "last", middle, channels=48, kernel=1)
    x = add("sum16", "sum and relu", side, add("grown16", "grow", top))
    level16 = add("level16", "conv", x, channels=48)
    side = add("side8", "last", fine, channels=40, kernel=1)
    narrow = add("narrow", "last", level16, channels=40, kernel=1)
    x = add("sum8", "sum and relu", side, add("grown8", "grow", narrow))
    for stride, level, channels in ((8, x, 40), (16, level16, 48), (32, top, 48)):
        x = add(f"head{stride}", "conv", level, channels=channels)
        add(f"out{stride}", "last", x, channels=OUTPUTS, kernel=1)
    return tuple(layers)


@dataclass(frozen=True, slots=True, eq=False)
class Album:
    """Pictures for training, in memory.

    Attributes:
        images: BGR, (n, 240, 320, 3), those with fewer rows at the top.
        rows: Of each picture, (n,).
        boxes: Number of the picture, class, x, y, width, height [px] and visible share, (m, 7).
        first: Start of each picture's boxes, and end of the last one's, (n + 1,).
    """

    images: Image
    rows: NDArray[np.int64]
    boxes: NDArray[np.float32]
    first: NDArray[np.int64]

    @staticmethod
    def of(pictures: Iterable[Picture], count: int) -> Album:
        """Collect pictures, showing their number."""
        images, rows = np.zeros((count, 240, WIDTH, 3), np.uint8), np.zeros(count, np.int64)
        boxes, begun = [], time.monotonic()
        for number, picture in enumerate(pictures):
            rows[number] = len(picture.image)
            images[number, : len(picture.image)] = picture.image
            for box in picture.boxes:
                if box.class_name in CLASS_NAMES:
                    boxes.append((number, CLASS_NAMES.index(box.class_name), *box.box, box.visible))
            show(f"{number + 1} of {count} pictures, {time.monotonic() - begun:.0f} s", last=number + 1 == count)
        table = np.array(boxes, np.float32).reshape(-1, 7)
        return Album(images, rows, table, np.searchsorted(table[:, 0], np.arange(count + 1)))

    def sample(self, number: int, rng: Rng) -> tuple[Image, NDArray[np.float32], NDArray[np.int64]]:
        """Return a picture as the network sees it, randomly changed, with the centres, sizes and classes in it."""
        image = self.images[number, : self.rows[number]]
        rows = self.boxes[self.first[number] : self.first[number + 1]]
        classes, visible = rows[:, 1].astype(np.int64), rows[:, 6]
        low, high = rows[:, 2:4].copy(), rows[:, 2:4] + rows[:, 4:6]
        if rng.random() < 0.5:
            image = np.asarray(cv2.flip(image, 1), np.uint8)
            low[:, 0], high[:, 0] = WIDTH - high[:, 0], WIDTH - low[:, 0]
        if rng.random() < 0.5:
            image, low, high = zoomed(image, low, high, rng)
        canvas = np.full((HEIGHT, WIDTH, 3), GREY, np.uint8)
        top = (HEIGHT - len(image)) // 2
        canvas[top : top + len(image)] = spoil(image, rng)
        sizes = high - low
        small = (sizes.max(axis=1, initial=0.0) < _LEAST_PX) | (sizes.min(axis=1, initial=1e9) < _LEAST_PX / 2.7)
        classes[(visible < _SEEN) | small] = IGNORED
        kept = (visible > 0.04) & (sizes > 1.5).all(axis=1)
        return canvas, np.hstack([(low + high) / 2 + (0, top), sizes]).astype(np.float32)[kept], classes[kept]


def zoomed(
    image: Image, low: NDArray[np.float32], high: NDArray[np.float32], rng: Rng
) -> tuple[Image, NDArray[np.float32], NDArray[np.float32]]:
    """Return an image scaled about a place, and its boxes, clipped at the edges."""
    height, width = image.shape[:2]
    scale = float(np.exp(rng.uniform(math.log(0.6), math.log(1.8))))
    shift = rng.uniform(0, 1, 2) * (width - scale * width, height - scale * height)
    matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    made = cv2.warpAffine(image, matrix, (width, height), flags=way, borderValue=(GREY, GREY, GREY))
    corners = [np.clip(side * scale + shift, 0, (width, height)).astype(np.float32) for side in (low, high)]
    return np.asarray(made, np.uint8), corners[0], corners[1]


def show(text: str, *, last: bool = False) -> None:
    """Show progress in place on a terminal, and occasionally elsewhere."""
    if sys.stdout.isatty():
        print(f"\r{text}    ", end="\n" if last else "", flush=True)
    elif last or time.monotonic() - show.__dict__.get("shown", 0.0) > 10:
        show.__dict__["shown"] = time.monotonic()
        print(text, flush=True)


def torch_() -> Any:
    """Import PyTorch.

    Raises:
        UsageError: It is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise UsageError(
            f"training needs PyTorch, which is not part of Skyloop: pip install torch ({error})"
        ) from error
    return torch


def onnx_() -> Any:
    """Import the library that writes ONNX files.

    Raises:
        UsageError: It is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise UsageError(
            f"writing the file needs onnx, which is not part of Skyloop: pip install onnx ({error})"
        ) from error
    return onnx


def build(torch: Any, layers: tuple[Layer, ...]) -> Any:
    """Return the convolutions of the network with their normalisations, by name."""
    channels, modules = {"image": 3}, {}
    for layer in layers:
        channels[layer.name] = layer.channels or channels[layer.sources[0]]
        if layer.kind not in ("conv", "last"):
            continue
        final = layer.name.startswith("out")
        into = channels[layer.sources[0]]
        conv = torch.nn.Conv2d(into, layer.channels, layer.kernel, layer.stride, layer.kernel // 2, bias=final)
        torch.nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
        if final:
            torch.nn.init.normal_(conv.weight, std=0.01)
            torch.nn.init.zeros_(conv.bias)
            conv.bias.data[4:] = -4.6  # nearly all places are empty
            conv.bias.data[2:4] = 1.0
        norm = torch.nn.Identity() if final else torch.nn.BatchNorm2d(layer.channels, momentum=0.03)
        modules[layer.name.replace(".", "_")] = torch.nn.Sequential(conv, norm)
    return torch.nn.ModuleDict(modules).to(memory_format=torch.channels_last)


def run(torch: Any, layers: tuple[Layer, ...], modules: Any, image: Any) -> Any:
    """Return the network's raw outputs, (pictures, places, OUTPUTS)."""
    values = {"image": image}
    for layer in layers:
        sources = [values[name] for name in layer.sources]
        if layer.kind in ("conv", "last"):
            value = modules[layer.name.replace(".", "_")](sources[0])
            values[layer.name] = torch.relu(value) if layer.kind == "conv" else value
        elif layer.kind == "sum and relu":
            values[layer.name] = torch.relu(sources[0] + sources[1])
        else:
            values[layer.name] = torch.nn.functional.interpolate(sources[0], scale_factor=2, mode="nearest")
    found = [values[f"out{stride}"].flatten(2) for stride in STRIDES]
    return torch.cat(found, dim=2).transpose(1, 2).float()


def loss(torch: Any, raw: Any, answer: Any, target: Any, grid: tuple[Any, Any]) -> Any:
    """Return the loss: generalised overlap of the boxes, and varifocal loss of the classes.

    Rezatofighi et al., "Generalized Intersection over Union", CVPR 2019; Zhang et al., "VarifocalNet", CVPR 2021: a
    place's score should be the overlap of its box, so that of two boxes for a thing the better one is kept.
    """
    middles, strides = grid
    positive = answer >= 0
    centre = middles + raw[..., :2] * strides[:, None]
    size = torch.exp(raw[..., 2:4].clamp(max=5.0)) * strides[:, None]
    made, true = torch.cat([centre, size], dim=-1)[positive], target[positive]
    low, high = made[:, :2] - made[:, 2:] / 2, made[:, :2] + made[:, 2:] / 2
    true_low, true_high = true[:, :2] - true[:, 2:] / 2, true[:, :2] + true[:, 2:] / 2
    shared = (torch.minimum(high, true_high) - torch.maximum(low, true_low)).clamp(min=0).prod(dim=1)
    both = made[:, 2:].prod(dim=1) + true[:, 2:].prod(dim=1) - shared
    around = (torch.maximum(high, true_high) - torch.minimum(low, true_low)).prod(dim=1)
    overlap = shared / both
    boxes = 1 - overlap + (around - both) / around

    wanted = torch.zeros_like(raw[..., 4:])
    quality = overlap.detach().clamp(min=0.05)
    wanted[positive, answer[positive]] = quality
    logits = raw[..., 4:]
    score = torch.sigmoid(logits)
    weight = torch.where(wanted > 0, wanted, 0.75 * score.detach() ** 1.5)
    weight = weight * (answer != IGNORED)[..., None]
    classes = torch.nn.functional.binary_cross_entropy_with_logits(logits, wanted, weight, reduction="sum")
    total = quality.sum().clamp(min=1.0)
    return (classes + 2.0 * (boxes * quality).sum()) / total


def train(album: Album, steps: int, seed: int) -> dict[str, NDArray[np.float32]]:
    """Train; return the weights and biases of the convolutions, with their normalisations folded in."""
    torch = torch_()
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    rng, layers = np.random.default_rng(seed), network()
    modules = build(torch, layers)
    optimizer = torch.optim.AdamW(modules.parameters(), lr=_RATE, weight_decay=0.02)
    # With half the bits, training is twice as fast on processors that multiply them natively.
    short = "avx512_bf16" in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    grid = places(WIDTH, HEIGHT)
    grids = tuple(torch.from_numpy(part) for part in grid)
    begun, mean = time.monotonic(), math.nan
    order = np.zeros(0, np.int64)
    for step in range(steps):
        rate = _RATE * min(1.0, (step + 1) / 100) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        for group in optimizer.param_groups:
            group["lr"] = rate
        if len(order) < _BATCH:
            order = np.append(order, rng.permutation(len(album.rows)))
        batch, order = order[:_BATCH], order[_BATCH:]
        images, answers, targets = [], [], []
        for number in batch:
            image, boxes, classes = album.sample(int(number), rng)
            answer, target = assign(boxes, classes, grid)
            images.append(image)
            answers.append(answer)
            targets.append(target)
        batched = torch.from_numpy(np.stack(images)[..., ::-1].copy()).permute(0, 3, 1, 2)
        batched = (batched.float() / 255).contiguous(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16, enabled=short):
            raw = run(torch, layers, modules, batched)
        error = loss(torch, raw, torch.from_numpy(np.stack(answers)), torch.from_numpy(np.stack(targets)), grids)
        optimizer.zero_grad()
        error.backward()
        torch.nn.utils.clip_grad_norm_(modules.parameters(), 10.0)
        optimizer.step()
        mean = float(error.detach()) if step == 0 else 0.98 * mean + 0.02 * float(error.detach())
        left = (time.monotonic() - begun) / (step + 1) * (steps - step - 1) / 60
        show(f"{step + 1} of {steps} steps, loss {mean:.3f}, {left:.1f} minutes left", last=step + 1 == steps)
    return folded(layers, modules)


def folded(layers: tuple[Layer, ...], modules: Any) -> dict[str, NDArray[np.float32]]:
    """Return weight and bias of each convolution, with the normalisation that follows it."""
    made = {}
    for layer in layers:
        if layer.kind not in ("conv", "last"):
            continue
        conv, norm = modules[layer.name.replace(".", "_")]
        weight = conv.weight.detach().numpy()
        if conv.bias is not None:
            bias = conv.bias.detach().numpy().copy()
        else:
            factor = norm.weight.detach().numpy() / np.sqrt(norm.running_var.numpy() + norm.eps)
            bias = norm.bias.detach().numpy() - norm.running_mean.numpy() * factor
            weight = weight * factor[:, None, None, None]
        made[f"{layer.name}.weight"], made[f"{layer.name}.bias"] = np.ascontiguousarray(weight), bias
    return made


def write(path: Path, weights: Mapping[str, NDArray[np.float32]]) -> None:
    """Write the network as an ONNX file in the layout of YOLOv8. Weights are stored as float16, and used as float32."""
    onnx = onnx_()
    helper, to_tensor, float32 = onnx.helper, onnx.numpy_helper.from_array, onnx.TensorProto.FLOAT
    nodes, constants = [], []

    def constant(name: str, value: Any) -> str:
        constants.append(to_tensor(np.asarray(value), name))
        return name

    def node(kind: str, sources: list[str], name: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, sources, [name], name=name, **attributes))
        return name

    constant("twice", np.array([1, 1, 2, 2], np.float32))
    for layer in network():
        sources = list(layer.sources)
        if layer.kind in ("conv", "last"):
            half = constant(f"{layer.name}.half", weights[f"{layer.name}.weight"].astype(np.float16))
            weight = node("Cast", [half], f"{layer.name}.weight", to=float32)
            bias = constant(f"{layer.name}.bias", weights[f"{layer.name}.bias"].astype(np.float32))
            pad = [layer.kernel // 2] * 4
            plain = layer.name if layer.kind == "last" else f"{layer.name}.plain"
            node("Conv", [sources[0], weight, bias], plain, pads=pad, strides=[layer.stride] * 2)
            if layer.kind == "conv":
                node("Relu", [plain], layer.name)
        elif layer.kind == "sum and relu":
            node("Relu", [node("Add", sources, f"{layer.name}.plain")], layer.name)
        else:
            like = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
            node("Resize", [sources[0], "", "twice"], layer.name, **like)
    shape = constant("flat", np.array([1, OUTPUTS, -1], np.int64))
    flat = [node("Reshape", [f"out{stride}", shape], f"flat{stride}") for stride in STRIDES]
    node("Concat", flat, "raw", axis=2)
    parts = ["offset", "growth", "logit"]
    split = constant("parts", np.array([2, 2, OUTPUTS - 4], np.int64))
    nodes.append(helper.make_node("Split", ["raw", split], parts, axis=1))
    middles, strides = places(WIDTH, HEIGHT)
    stride = constant("strides", strides[None, None])
    centre = node("Mul", ["offset", stride], "moved")
    centre = node("Add", [centre, constant("middles", middles.T[None])], "centre")
    size = node("Mul", [node("Exp", ["growth"], "grown"), stride], "size")
    node("Concat", [centre, size, node("Sigmoid", ["logit"], "score")], "output0", axis=1)
    image = helper.make_tensor_value_info("images", float32, [1, 3, HEIGHT, WIDTH])
    nodes[0:0] = [helper.make_node("Identity", ["images"], ["image"])]
    output = helper.make_tensor_value_info("output0", float32, [1, OUTPUTS, len(middles)])
    graph = helper.make_graph(nodes, "figures", [image], [output], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    names = repr(dict(enumerate(CLASS_NAMES)))
    described = "People, cars and crates as Skyloop's simulator draws them; useless on real images"
    told = {"task": "detect", "names": names, "imgsz": repr([HEIGHT, WIDTH]), "stride": "32", "description": described}
    helper.set_model_props(model, told)
    path.write_bytes(model.SerializeToString())


def settle(path: Path, weights: dict[str, NDArray[np.float32]], seed: int) -> None:
    """Write the network so that its misses and false alarms balance at the usual score, class by class.

    Only shifts the scores; the order of two detections of a class stays the same.
    """
    write(path, weights)
    rng = np.random.default_rng(seed)
    seen = [Picture(spoil(each.image, rng), each.boxes) for each in training_pictures(seed, _SETTLING)]
    detector = OnnxDetector(path, score=0.05)
    found = [detector.detect(each.image) for each in seen]
    for number, name in enumerate(CLASS_NAMES):
        balanced = balanced_score(matches(found, seen, name))
        for stride in STRIDES:
            weights[f"out{stride}.bias"][4 + number] += math.log(SCORE / (1 - SCORE) * (1 - balanced) / balanced)
        show(f"{name}: a score of {balanced:.2f} becomes {SCORE}", last=True)
    write(path, weights)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m scripts.train_detector",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", type=Path, help="the ONNX file to write")
    parser.add_argument("--pictures", type=int, default=6000, help="number to train with [default: 6000]")
    parser.add_argument(
        "--steps", type=int, default=4500, help=f"number of training steps, {_BATCH} pictures each [default: 4500]"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of pictures and training [default: 1]")
    parser.add_argument("--keep", type=Path, metavar="FILE.npz", help="keep the pictures there, or reuse them")
    options = parser.parse_args()
    try:
        if not _BATCH <= options.pictures <= 100_000 or not 1 <= options.steps <= 10_000_000 or options.seed < 0:
            raise UsageError(f"give {_BATCH} to 100000 pictures, 1 to 10000000 steps, and a seed of at least 0")
        if not options.file.absolute().parent.is_dir():
            raise UsageError(f"no folder {options.file.parent} for {options.file.name}")
        torch_(), onnx_()
        use_one_core()
        album = _album(options)
        settle(options.file, train(album, options.steps, options.seed), options.seed + 1)
        print(f"{options.file}: {options.file.stat().st_size / 1e6:.2f} MB", flush=True)
        print_scores(options.file)
    except SkyloopError as error:
        parser.error(str(error))


def _album(options: argparse.Namespace) -> Album:
    if options.keep is not None and options.keep.exists():
        with np.load(options.keep) as kept:
            return Album(kept["images"], kept["rows"], kept["boxes"], kept["first"])
    album = Album.of(training_pictures(options.seed, options.pictures), options.pictures)
    if options.keep is not None:
        np.savez(options.keep, images=album.images, rows=album.rows, boxes=album.boxes, first=album.first)
    return album


if __name__ == "__main__":
    main()
