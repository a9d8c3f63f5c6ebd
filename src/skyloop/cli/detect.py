"""``skyloop detect``: runs a detector on a drone's frames, in a process of its own."""

from __future__ import annotations

import contextlib
import hashlib
import signal
from pathlib import Path
from typing import Annotated, Any

import typer

from skyloop.cli.completion import drone_names
from skyloop.cli.naming import KeysOption, NetworkOption, join_network, one_drone
from skyloop.cli.process import interrupt, show_json, show_text, work
from skyloop.errors import UnknownNameError


def detect(
    file: Annotated[
        str | None,
        typer.Argument(
            metavar="[FILE]",
            help="ONNX file of a detector: YOLO, YOLOX, RT-DETR …; without: Skyloop's own, of the simulator's figures",
            show_default=False,
        ),
    ] = None,
    on: Annotated[
        str | None, typer.Option("--on", metavar="NAME", help="Running proxy", autocompletion=drone_names)
    ] = None,
    camera: Annotated[str | None, typer.Option(metavar="CAMERA", help="Whose frames; the first if not given")] = None,
    score: Annotated[float, typer.Option(metavar="S", min=0.0, max=1.0, help="Leave out what is less sure")] = 0.4,
    classes: Annotated[
        str | None, typer.Option(metavar="NAME,…", help="Only these classes, by name; all if not given")
    ] = None,
    names: Annotated[
        str | None, typer.Option(metavar="FILE", help="Names of the classes, one a line; else the file's own")
    ] = None,
    layout: Annotated[
        str | None, typer.Option(metavar="LAYOUT", help="Of the outputs, where the file does not show it")
    ] = None,
    name: Annotated[str, typer.Option(metavar="NAME", help="Of the processor and its results")] = "detections",
    max_fps: Annotated[
        float | None, typer.Option(metavar="F", min=0.001, help="Frames a second that it takes at most")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", min=0.0, help="How long; until Ctrl-C if not given")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="For programs: a JSON object each second")] = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Detect people, cars or whatever a network of yours knows in a drone's frames, and draw them live. Read-only.

    Without FILE it finds the simulator's people, cars and crates: person, car, box. For a real camera give a FILE.
    The results, with the time of their frame, are those of a processor: drone.results("detections"). Run the same
    command again for another worker that shares the frames. A line each second shows its progress.
    """
    from skyloop.processing import Settings
    from skyloop.processing.detecting import DetectionProcessor
    from skyloop.vision import OnnxDetector
    from skyloop.vision.simulated import SIMULATED_WEIGHTS

    join_network(network, keys)
    drone = one_drone(on, None)
    path = SIMULATED_WEIGHTS if file is None else Path(file)
    detector = OnnxDetector(path, score=score, names=None if names is None else Path(names), layout=layout)
    wanted = [each.strip() for each in (classes or "").split(",") if each.strip()]
    for each in wanted:
        if detector.names and each not in detector.names.values():
            raise UnknownNameError(f"class in {path.name if file is None else file}", each, detector.names.values())
    processor = DetectionProcessor(detector, wanted)

    def make() -> Any:
        return processor

    digits = hashlib.sha256(path.read_bytes() + repr((score, sorted(wanted), names, layout)).encode()).hexdigest()
    settings = Settings(name, f"DetectionProcessor {digits[:16]}", camera, max_fps=max_fps)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    with contextlib.suppress(KeyboardInterrupt):  # how it is meant to end
        work(make, settings, drone, seconds, show_json if json else show_text, child=False)
