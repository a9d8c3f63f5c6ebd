"""The contract for measuring every contender: two processes with one end each, and stamps on one clock.

A contender is a module with two classes, ``Vehicle(address, received)``, ``Application(address, received)``. The
sender's stamp is taken when the data are ready and before the contender is called; ``received(channel, sent_ns)`` is
called when the receiver's user has them (a frame as an array). Stamps travel with the samples.

Interpreters with only NumPy and the contender import this module, so it imports nothing else.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring.schedule import COMMAND, FEEDBACK, SETTLE_S, VIDEO, Size, Turn, paced
from benchmarks.measuring.waypoints import Setpoint, fly
from benchmarks.measuring.workers import Pipe

Image = NDArray[np.uint8]
#: Called for each sample that its receiver has: its channel, and its time of sending [ns, monotonic].
Received = Callable[[str, int], None]
#: By channel: the times of sending and receiving each sample [ns].
Arrivals = dict[str, list[tuple[int, int]]]


class VehicleEnd(Protocol):
    """The end that sends feedback and frames and receives commands."""

    def feedback(self, sent_ns: int) -> None: ...
    def frame(self, sent_ns: int, image: Image) -> None: ...
    def close(self) -> None: ...


class ApplicationEnd(Protocol):
    """The user's end, which sends commands and receives feedback and frames. Opened after the vehicle's."""

    def command(self, sent_ns: int, setpoint: Setpoint) -> None: ...
    def close(self) -> None: ...


class Recorder:
    """Records arrivals."""

    def __init__(self) -> None:
        self.arrivals: Arrivals = {}

    def received(self, channel: str, sent_ns: int) -> None:
        """Record that a sample of a channel arrived now. Any thread."""
        now_ns = time.monotonic_ns()
        self.arrivals.setdefault(channel, []).append((sent_ns, now_ns))


def vehicle_side(pipe: Pipe, module: str, address: str) -> None:
    """Run the vehicle's process, turn by turn."""
    contender = import_module(module)
    for turn in _turns(pipe):
        recorder = Recorder()
        end: VehicleEnd = contender.Vehicle(address, recorder.received)
        try:
            pipe.send("open")
            if (begin_ns := pipe.recv()) is None:
                return
            produce(end, turn, begin_ns)
            time.sleep(SETTLE_S)
        finally:
            end.close()
        pipe.send(recorder.arrivals)


def application_side(pipe: Pipe, module: str, address: str) -> None:
    """Run the application's process, turn by turn."""
    contender = import_module(module)
    for turn in _turns(pipe):
        recorder = Recorder()
        end: ApplicationEnd = contender.Application(address, recorder.received)
        try:
            pipe.send("open")
            begin_ns = pipe.recv()
            for _, setpoint in zip(paced(turn.deadlines_ns(COMMAND, begin_ns)), fly(), strict=False):
                end.command(time.monotonic_ns(), setpoint)
            time.sleep(SETTLE_S)
        finally:
            end.close()
        pipe.send(recorder.arrivals)


def produce(end: VehicleEnd, turn: Turn, begin_ns: int) -> None:
    """Send feedback from one thread and frames from another, as drivers do.

    Args:
        end: Sends them.
        turn: The schedule.
        begin_ns: When counting begins, on the monotonic clock.
    """

    def publish_feedback() -> None:
        for _ in paced(turn.deadlines_ns(FEEDBACK, begin_ns)):
            end.feedback(time.monotonic_ns())

    publisher = threading.Thread(target=publish_feedback, name="bench-feedback", daemon=True)
    publisher.start()
    image = picture(turn.size)
    for _ in paced(turn.deadlines_ns(VIDEO, begin_ns)):
        end.frame(time.monotonic_ns(), image)
    publisher.join()


def picture(size: Size) -> Image:
    """Return noise, which can't be compressed on the way, shape (height, width, 3), dtype uint8."""
    return np.random.default_rng(1).integers(0, 255, (size.height, size.width, 3), np.uint8)


def _turns(pipe: Pipe) -> Iterator[Any]:
    pipe.send("ready")
    while (turn := pipe.recv()) is not None:
        yield turn
