"""``skyloop fly follow``: follows the target in a box drawn on the image, or a target of a given class."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from skyloop.cli import interrupt_by_signals
from skyloop.cli.fly import ADVICE, Flight, FlightProgress, land, run, say
from skyloop.cli.naming import DroneOption, KeysOption, NetworkOption, drone_names, join_network, one_drone
from skyloop.errors import LinkError, NoAnswerError, UnknownNameError, UsageError

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.control import FollowTarget
    from skyloop.vision import OnnxDetector
    from skyloop.vision.tracking import Box

SIMULATED: Final = "sim://?world=park&cameras=front&fps=15"
#: Directions as seen from the target, counter-clockwise from its direction of motion.
SIDES: Final = {"ahead": 0.0, "behind": math.pi, "left": math.pi / 2, "right": -math.pi / 2}
_RESULT_WITHIN_S: Final = 3.0
_FIRST_FRAME_S: Final = 10.0
_LINE_EVERY_S: Final = 1.0


def fly_follow(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]",
            help="A running proxy, or a vehicle's address; without: a simulated park",
            autocompletion=drone_names,
            show_default=False,
        ),
    ] = None,
    drone: DroneOption = None,
    box: Annotated[
        str | None, typer.Option("--box", metavar="X,Y,W,H", help="The target in the first frame in the air, in pixels")
    ] = None,
    class_name: Annotated[
        str | None, typer.Option("--class", metavar="CLASS", help="Follow the largest of a class, such as person")
    ] = None,
    detector: Annotated[
        str | None,
        typer.Option(
            "--detector",
            metavar="FILE.onnx|NAME",
            help="ONNX file, or running processor of detections [in simulation, for --class: Skyloop's own]",
        ),
    ] = None,
    mode: Annotated[str, typer.Option(metavar="MODE", help="follow, orbit or look")] = "follow",
    distance: Annotated[float, typer.Option(metavar="M", help="Distance to keep; above 2")] = 4.0,
    side: Annotated[
        str | None,
        typer.Option(metavar="SIDE", help="Side of the target to stay on: ahead, behind, left or right [default: any]"),
    ] = None,
    leash: Annotated[
        float | None, typer.Option(metavar="M", help="Maximum distance from its start [default: no limit]")
    ] = None,
    camera: Annotated[str | None, typer.Option(metavar="CAMERA", help="Camera to use [default: the first]")] = None,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", min=0.0, help="Duration [default: until Ctrl-C]")
    ] = None,
    priority: Annotated[int, typer.Option(metavar="P", min=0, max=31, help="0 is the highest, 31 the lowest")] = 16,
    wait: Annotated[
        float, typer.Option(metavar="S", min=0.0, help="Longest wait in the queue for the authority")
    ] = 0.0,
    takeoff: Annotated[bool, typer.Option(help="Take off first, if it is on the ground")] = True,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Take off, follow a target by the camera, land. Without NAME a simulated drone follows a person in a park.

    Give --class, --box, or both. It does not see walls and trees: fly it where there are none.

    A line each second on standard error shows the progress. Ctrl-C lands. Exit code 1 if the target was lost for good.
    """
    from skyloop.cli.listing import connect_pilot
    from skyloop.client import Authority
    from skyloop.control import ChaseSettings, FollowMode, FollowTarget

    if Path("follow").is_file():
        say("follow is the command here, not the file of that name: skyloop fly flies files that end in .py")
    join_network(network, keys)
    target = one_drone(name, drone, default=SIMULATED)
    if box is None and class_name is None:
        raise UsageError("no target given: give --class CLASS, such as person, or --box X,Y,W,H")
    modes = [each.value for each in FollowMode]
    if mode not in modes:
        raise UnknownNameError("mode", mode, modes)
    if side is not None and side not in SIDES:
        raise UnknownNameError("side", side, SIDES)
    settings = ChaseSettings(distance_m=distance, bearing_rad=None if side is None else SIDES[side], leash_m=leash)
    given = None if box is None else _box(box)
    loaded = None if detector is None else _detector(detector, class_name)
    interrupt_by_signals()
    authority = Authority(priority=priority, wait_s=wait)
    with connect_pilot(target, ADVICE, name="follow", authority=authority) as flown:
        if loaded is None and given is None:
            loaded = _packaged(flown, class_name)
        pilot = FollowTarget(
            flown, given, class_name=class_name, mode=mode, detector=loaded, camera=camera, settings=settings
        )
        _check(flown, camera, given, loaded)
        progress = FlightProgress(flown, what=lambda: status_line(pilot), every_s=_LINE_EVERY_S)
        worked = run(Flight(flown, pilot, say), flown, seconds, takeoff=takeoff, progress=progress)
        if pilot.done:
            say("the target was lost for too long")
        land(flown)
    if not worked or pilot.done:
        raise typer.Exit(1)


def _box(text: str) -> Box:
    try:
        x, y, width, height = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"--box must be X,Y,W,H: left and upper edge, width and height in pixels, got {text!r}"
        ) from None
    if not all(map(math.isfinite, (x, y, width, height))):
        raise UsageError(f"--box must consist of finite numbers, got {text!r}")
    return x, y, width, height


def _detector(given: str, class_name: str | None) -> OnnxDetector | str:
    """Return the detector loaded from a file, or the name of a processor."""
    from skyloop.vision import OnnxDetector

    if not given.endswith(".onnx") and "/" not in given and not Path(given).is_file():
        return given
    found = OnnxDetector(given)
    _check_class(found, class_name, given)
    return found


def _packaged(drone: Drone, class_name: str | None) -> OnnxDetector:
    from skyloop.vision import simulated_detector

    if drone.capabilities.vehicle != "sim":
        raise UsageError(
            f"following a {class_name!r} needs a detector, and Skyloop's own only knows the simulator's figures: give "
            "--detector FILE.onnx, or the NAME of a running skyloop detect; or --box X,Y,W,H"
        )
    found = simulated_detector()
    _check_class(found, class_name, "Skyloop's detector")
    return found


def _check_class(detector: OnnxDetector, class_name: str | None, where: str) -> None:
    known = detector.names.values()
    if class_name is not None and known and class_name not in known:
        raise UnknownNameError(f"class in {where}", class_name, known)


def _check(drone: Drone, camera: str | None, box: Box | None, detector: OnnxDetector | str | None) -> None:
    """Refuse, while still on the ground, anything that would end the flight in the air."""
    from skyloop.vision.tracking import checked_box

    if box is not None:
        checked_box(box, drone.next_frame(camera, timeout_s=_FIRST_FRAME_S).shape)
    if isinstance(detector, str):
        try:
            next(iter(drone.results(detector, timeout_s=_RESULT_WITHIN_S)))
        except NoAnswerError as error:
            raise LinkError(
                f"no results from a processor named {detector!r} within {_RESULT_WITHIN_S:g} s: start it with "
                f"skyloop detect FILE.onnx --on {drone.name} --name {detector}, or give an ONNX file"
            ) from error


def status_line(pilot: FollowTarget) -> str:
    """Return the state of following in one line: the target's phase, its position, and how certain it is."""
    status = pilot.status
    parts = [
        status.phase,
        "" if status.range_m is None else f"{status.range_m:.1f} m away",
        "" if status.confidence is None else f"confidence {status.confidence:.0%}",
        f"unseen for {status.lost_s:.1f} s" if status.lost_s else "",
        status.problem,
    ]
    return "  ".join(part for part in parts if part)
