"""``python -m benchmarks.loop``: from a frame's capture until the resulting command is applied, by stage."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from benchmarks.measuring.contract import vehicle_side
from benchmarks.measuring.ours import proxy_name
from benchmarks.measuring.schedule import SETTLE_S, VIDEO, WARM_UP_S, Size, Turn
from benchmarks.measuring.statistics import Summary, summarize
from benchmarks.measuring.workers import STARTS_WITHIN_S, Pipe, Workers
from skyloop.bench import CAMERA, Machine, stamp_of, stamped
from skyloop.client import Drone, Frame, connect
from skyloop.control import Controller
from skyloop.errors import LinkError
from skyloop.files import MAX_RESULTS, read_json
from skyloop.messages import Applied, Velocity

FRAME_PERIOD_S: Final = 1 / 30
TURN_S: Final = 5.0
_AHEAD_NS: Final = 50_000_000
_LATE_S: Final = 20.0

#: The stages by the moment at which each ends.
STAGES: Final = {
    "published": "the driver has the image → the proxy has stamped it",
    "delivered": "→ the application's receiving thread has the frame",
    "controller": "→ the controller's on_frame is called in its own thread",
    "sent": "→ its drone.velocity() has been checked, encoded and stamped",
    "applied": "→ the driver has it, all checks passed",
}
TOTAL: Final = "total"

Progress = Callable[[float, str], None]


class Trip(NamedTuple):
    """The times at which a frame, and then its command, reached each stage [ns]."""

    captured: int
    published: int
    delivered: int
    controller: int
    sent: int
    applied: int

    def stages_ns(self) -> dict[str, int]:
        """Return the duration of each stage, and the total [ns]."""
        stages = {name: self[number + 1] - self[number] for number, name in enumerate(STAGES)}
        return stages | {TOTAL: self.applied - self.captured}


class SizeResult(msgspec.Struct, frozen=True):
    """The stages with frames of one size."""

    size: str
    stages: dict[str, Summary]


class Loop(msgspec.Struct, frozen=True, tag_field="what", tag="loop"):
    """A whole run, as in ``loop.json``. ``seconds``: how long each size was measured."""

    machine: Machine
    seconds: float
    frames_per_s: float
    sizes: list[SizeResult]


def measure(seconds: float, sizes: Sequence[Size], progress: Progress = lambda _share, _what: None) -> Loop:
    """Measure the loop with each size of frames, in turns.

    Args:
        seconds: Duration for each size [s].
        sizes: Sizes of the frames.
        progress: Called with the fraction done, 0 to 1, and the next step.

    Raises:
        LinkError: No command was applied.
    """
    machine = Machine.here()
    rounds = max(1, round(seconds / TURN_S))
    turns = [Turn(number, seconds / rounds, size, FRAME_PERIOD_S) for number in range(rounds) for size in sizes]
    trips: dict[Size, list[Trip]] = {size: [] for size in sizes}
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, Workers() as workers:
        vehicle = workers.start(vehicle_side, "benchmarks.measuring.ours", folder)
        application = workers.start(control, proxy_name(folder))
        for worker in (vehicle, application):
            worker.answer(STARTS_WITHIN_S)
        for number, turn in enumerate(turns):
            progress(number / len(turns), f"the loop, {turn.size}")
            for worker in (vehicle, application):
                worker.pipe.send(turn)
                worker.answer(STARTS_WITHIN_S)
            begin_ns = time.monotonic_ns() + round(WARM_UP_S * 1e9) + _AHEAD_NS
            vehicle.pipe.send(begin_ns)
            application.pipe.send(begin_ns)
            ends_within_s = turn.seconds + WARM_UP_S + SETTLE_S + _LATE_S
            trips[turn.size] += [Trip(*trip) for trip in application.answer(ends_within_s) if trip[0] >= begin_ns]
            vehicle.answer(ends_within_s)
    results = [_size_result(size, found, rounds * turns[0].count(VIDEO)) for size, found in trips.items()]
    return Loop(machine, seconds, round(1 / FRAME_PERIOD_S, 1), results)


def _size_result(size: Size, trips: Sequence[Trip], sent: int) -> SizeResult:
    if not trips:
        raise LinkError(f"not one command that a frame of {size} caused was applied")
    taken = [trip.stages_ns() for trip in trips]
    return SizeResult(
        str(size),
        {
            stage: summarize([times[stage] for times in taken], sent=sent, period_s=FRAME_PERIOD_S)
            for stage in (*STAGES, TOTAL)
        },
    )


class Answering(Controller):
    """Answers each frame with a command at once, so that only Skyloop's own part of the loop remains.

    Args:
        drone: The drone.
    """

    camera = CAMERA

    def __init__(self, drone: Drone) -> None:
        super().__init__(drone)
        self.called: dict[int, tuple[int, int, int]] = {}  # by capture: published, delivered, called [ns]

    def on_frame(self, frame: Frame) -> None:
        """Record the time of the call, and send a command that carries the frame's stamp."""
        now_ns = time.monotonic_ns()
        self.called[frame.captured_ns] = (frame.published_ns, frame.received_ns, now_ns)
        self.drone.velocity(forward=0.1, up=stamped(frame.captured_ns))


def control(pipe: Pipe, proxy: str) -> None:
    """Run the application's process: a controller, turn by turn.

    Args:
        pipe: To the measuring process.
        proxy: The proxy's name.
    """
    pipe.send("ready")
    while (turn := pipe.recv()) is not None:
        echoes: dict[int, tuple[int, int]] = {}  # by capture: sent, applied [ns]; repeats are ignored

        def applied(echo: Applied, echoes: dict[int, tuple[int, int]] = echoes) -> None:
            if type(echo.asked) is Velocity:
                echoes.setdefault(stamp_of(echo.asked.up, echo.applied_ns), (echo.sent_ns, echo.applied_ns))

        with connect(proxy, name="bench", on_exit="hover") as drone:
            drone.on_command(applied, inline=True)
            controller = Answering(drone)
            pipe.send("open")
            end_s = (pipe.recv() - time.monotonic_ns()) / 1e9 + turn.seconds + SETTLE_S
            controller.run(seconds=end_s)
        pipe.send(
            [
                (captured, *controller.called[captured], *echoes[captured])
                for captured in controller.called.keys() & echoes.keys()
            ]
        )


def load(path: Path) -> Loop:
    """Read ``loop.json``.

    Raises:
        FileFormatError: The file has another format.
    """
    return read_json(path, Loop, "the results of benchmarks.loop", MAX_RESULTS)
