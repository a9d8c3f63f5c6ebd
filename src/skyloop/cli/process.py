"""``skyloop process`` and ``skyloop detect``: run a user's class, or a detector, on the frames of a drone."""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from skyloop.cli import interrupt_by_signals, naming
from skyloop.cli.text import json_text, tell
from skyloop.clock import beats
from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages.relayed import Polyline, Shape, Text
from skyloop.processing.worker import Output

if TYPE_CHECKING:
    from skyloop.client import Frame
    from skyloop.processing import Settings, Status
    from skyloop.vision.object_tracks import Detection, ObjectDetector

LINE_EVERY_S: Final = 1.0  #: interval between lines of progress
_POLL_S: Final = 0.1  # interval at which a group of workers is checked
_MOST_WORKERS: Final = 64  # maximum of --workers
MOST: Final = 64  #: only the most certain detections are published, because a result is limited to 32 768 bytes


def process(
    target: Annotated[
        str, typer.Argument(metavar="CLASS", help="module:Class, FILE.py or FILE.py:Class, with process(self, frame)")
    ],
    drone_name: naming.AnyNameArgument = None,
    drone: naming.DroneOption = None,
    camera: Annotated[str | None, typer.Option(metavar="CAMERA", help="Camera to use [default: the first]")] = None,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the processor [default: the class's, in lower case]")
    ] = None,
    share: Annotated[
        bool, typer.Option("--share/--all", help="Send each frame to one worker of this name, or to all")
    ] = True,
    workers: Annotated[int, typer.Option(metavar="N", min=1, max=_MOST_WORKERS, help="Processes to run here")] = 1,
    max_age: Annotated[float, typer.Option(metavar="S", min=0.0, help="Skip frames older than this")] = 1.0,
    max_fps: Annotated[
        float | None, typer.Option(metavar="F", min=0.001, help="Maximum frames per second of a worker")
    ] = None,
    stuck: Annotated[
        float, typer.Option(metavar="S", min=0.05, help="Time on one frame after which others get a worker's frames")
    ] = 2.0,
    seconds: naming.SecondsOption = None,
    json: Annotated[bool, typer.Option("--json", help="Print a JSON object each second")] = False,
    child: Annotated[bool, typer.Option("--child", hidden=True)] = False,
    network: naming.NetworkOption = None,
    keys: naming.KeysOption = None,
) -> None:
    """Process the newest frames of a drone with your own class, and publish the results. Read-only.

    The class has a method process(self, frame) that returns numbers, strings, lists, dicts, dataclasses or small NumPy
    arrays; read them with drone.results("NAME") and Controller.on_result. Progress is printed as one line per second.
    """
    from skyloop.processing import Settings, load_processor

    naming.join_network(network, keys)
    drone = naming.one_drone(drone_name, drone)
    code = load_processor(target)
    settings = Settings(name if name is not None else code.name, code.mark, camera, share, max_age, max_fps, stuck)
    interrupt_by_signals()
    show = show_json if json else show_text
    try:
        if workers == 1:
            work(code.make, settings, drone, seconds, show, child=child)
        else:
            _lead(workers, settings, target, drone, seconds, show)
    except KeyboardInterrupt:
        pass  # this is the normal way to stop


def work(
    make: Callable[[], Any],
    settings: Settings,
    target: str,
    seconds: float | None,
    show: Callable[[Status], str],
    *,
    child: bool,
) -> None:
    """Run one worker in this process until it ends, with the processor returned by ``make``."""
    from skyloop.client import connect
    from skyloop.processing import Worker
    from skyloop.processing.group import end_with_parent

    processor = make()
    app = f"{settings.name[:32]}@{socket.gethostname()[:20]}:{os.getpid()}"
    with connect(target, access="observe", name=app) as drone:
        worker = Worker(drone, processor, settings, tell)
        if child:
            end_with_parent(worker.stop)
        ended = threading.Event()
        lines = threading.Thread(target=_lines, args=(lambda: show(worker.status), ended), daemon=True)
        lines.start()
        try:
            worker.run(seconds)
        finally:
            ended.set()
            lines.join()


def _lines(line: Callable[[], str], ended: threading.Event) -> None:
    """Print a line every second."""
    for _ in beats(LINE_EVERY_S, ended):
        typer.echo(line())


def _lead(
    workers: int, settings: Settings, target: str, drone: str, seconds: float | None, show: Callable[[Status], str]
) -> None:
    """Run several workers, each in its own process, so that none has to wait for another worker's GIL."""
    from skyloop.processing.group import ProcessGroup, child_command

    if "://" in drone:
        raise UsageError(f"several workers need one proxy: skyloop proxy {drone} --name alpha, then --drone alpha")
    due = time.monotonic() + LINE_EVERY_S
    with ProcessGroup(child_command(_arguments(settings, target, drone, seconds)), workers, tell) as group:
        while (ended := group.code) is None:
            time.sleep(_POLL_S)
            status = group.status
            if time.monotonic() >= due and status is not None:
                due = max(due + LINE_EVERY_S, time.monotonic())
                typer.echo(show(status))
    if ended:
        raise typer.Exit(ended)


def _arguments(settings: Settings, target: str, drone: str, seconds: float | None) -> list[str]:
    """Return the command that starts one of several workers."""
    options: dict[str, object] = {
        "--drone": drone,
        "--name": settings.name,
        "--camera": settings.camera,
        "--max-age": settings.max_age_s,
        "--max-fps": settings.max_fps,
        "--stuck": settings.stuck_s,
        "--seconds": seconds,
    }
    given = [word for option, value in options.items() if value is not None for word in (option, str(value))]
    return ["process", target, *given, "--share" if settings.shared else "--all", "--json", "--child"]


def show_text(status: Status) -> str:
    return f"{time.strftime('%H:%M:%S')}  {status}"


def show_json(status: Status) -> str:
    return json_text(status)


def detect(
    file: Annotated[
        str | None,
        typer.Argument(
            metavar="[FILE]",
            help="ONNX file of a detector: YOLO, YOLOX, RT-DETR …; default: Skyloop's own, for the simulator's figures",
            show_default=False,
        ),
    ] = None,
    on: Annotated[
        str | None, typer.Option("--on", metavar="NAME", help="Running proxy", autocompletion=naming.drone_names)
    ] = None,
    camera: Annotated[str | None, typer.Option(metavar="CAMERA", help="Camera to use [default: the first]")] = None,
    score: Annotated[float, typer.Option(metavar="S", min=0.0, max=1.0, help="Minimum score of a detection")] = 0.4,
    classes: Annotated[
        str | None, typer.Option(metavar="NAME,…", help="Only these classes, by name [default: all]")
    ] = None,
    names: Annotated[
        str | None, typer.Option(metavar="FILE", help="Names of the classes, one per line [default: the file's own]")
    ] = None,
    layout: Annotated[
        str | None, typer.Option(metavar="LAYOUT", help="Layout of the outputs, if the file does not show it")
    ] = None,
    name: Annotated[str, typer.Option(metavar="NAME", help="Name of the processor and its results")] = "detections",
    max_fps: Annotated[float | None, typer.Option(metavar="F", min=0.001, help="Maximum frames per second")] = None,
    seconds: naming.SecondsOption = None,
    json: Annotated[bool, typer.Option("--json", help="Print a JSON object each second")] = False,
    network: naming.NetworkOption = None,
    keys: naming.KeysOption = None,
) -> None:
    """Detect people, cars or any class that your network knows in a drone's frames, and draw them live. Read-only.

    Without FILE, it finds the simulator's people, cars and crates: person, car, box. For a real camera, give FILE. The
    results carry their frame's time and are published as a processor's results: drone.results("detections"). Run the
    same command again to start another worker that shares the frames. Progress is printed as one line per second.
    """
    from skyloop.processing import Settings
    from skyloop.vision import OnnxDetector
    from skyloop.vision.simulated import SIMULATED_WEIGHTS

    naming.join_network(network, keys)
    drone = naming.one_drone(on, None)
    path = SIMULATED_WEIGHTS if file is None else Path(file)
    detector = OnnxDetector(path, score=score, names=None if names is None else Path(names), layout=layout)
    wanted = [each.strip() for each in (classes or "").split(",") if each.strip()]
    for each in wanted:
        if detector.names and each not in detector.names.values():
            raise UnknownNameError(f"class in {path.name if file is None else file}", each, detector.names.values())
    processor = DetectionProcessor(detector, wanted)
    digits = hashlib.sha256(path.read_bytes() + repr((score, sorted(wanted), names, layout)).encode()).hexdigest()
    settings = Settings(name, f"DetectionProcessor {digits[:16]}", camera, max_fps=max_fps)
    interrupt_by_signals()
    with contextlib.suppress(KeyboardInterrupt):  # this is the normal way to stop
        work(lambda: processor, settings, drone, seconds, show_json if json else show_text, child=False)


class DetectionProcessor:
    """Publishes a detector's results: ``{"detections": [{"box": …, "score": …, "class_id": …, "class_name": …}, …]}``.

    Each detection is drawn as a closed outline with four corners and a label with its class and score.
    """

    def __init__(self, detector: ObjectDetector, classes: Collection[str] = ()) -> None:
        """Set the detector, called on the worker's thread, and the names of the classes to publish, or none for all."""
        self._detector = detector
        self._classes = frozenset(classes)

    def process(self, frame: Frame) -> Output:
        found = [one for one in self._detector.detect(frame) if not self._classes or one.class_name in self._classes]
        found = found[:MOST]
        return Output({"detections": [_value(one) for one in found]}, [s for one in found for s in _shapes(one)])


def _value(one: Detection) -> dict[str, Any]:
    name = one.class_name[:64]
    return {"box": list(one.box), "score": one.score, "class_id": one.class_id, "class_name": name}


def _shapes(one: Detection) -> tuple[Shape, ...]:
    x, y, _, _ = one.box
    return Polyline(one.outline, closed=True), Text(f"{one.class_name[:64]} {one.score:.2f}", (x, y))
