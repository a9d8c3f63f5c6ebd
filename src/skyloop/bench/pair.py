"""Skyloop's own pair of processes: a proxy, and an application that connects for each turn."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from multiprocessing.context import SpawnContext
from typing import TYPE_CHECKING

from skyloop.bench.rounds import COMMAND, FEEDBACK, Channel, Pipe, Workers, paced
from skyloop.messages import AnyAction, Applied, Feedback, Velocity

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

WARM_UP = 5  #: samples at the start of a turn that are not counted: threads and slots of a new connection
SETTLE_S = 0.3  #: for the last samples of a turn to arrive


class Pair:
    """A proxy in one process, an application in another, over the local transport."""

    def __init__(self, context: SpawnContext) -> None:
        name = f"bench-{os.getpid()}"
        self._workers = Workers(context)
        self._proxy = self._workers.start(serve, name)
        self._application = self._workers.start(apply, name)

    def measure(self, channel: Channel, count: int) -> tuple[list[int], list[int]]:
        """Delays in ns: in the hands of an inline listener, and of one in its own thread.

        Commands count from the user's call to the driver having them, feedback and frames from the driver's hand-over
        to the application's; for commands there is no second list.
        """
        self._application.send((channel, count + WARM_UP))
        self._application.recv()
        if channel.name != COMMAND.name:
            self._proxy.send((channel, count + WARM_UP))
            self._proxy.recv()
        inline, threaded = self._application.recv()
        return inline[WARM_UP:], threaded[WARM_UP:]

    def close(self) -> None:
        self._workers.close()


def serve(pipe: Pipe, name: str) -> None:
    """The proxy's process."""
    from skyloop.bench.vehicle import BenchVehicle
    from skyloop.proxy import Proxy
    from skyloop.transport.local import LocalServer

    vehicle = BenchVehicle()
    proxy = Proxy(vehicle, LocalServer(name), name=name)
    proxy.start()
    pipe.send("ready")
    try:
        while (turn := pipe.recv()) is not None:
            channel, count = turn
            vehicle.produce(channel, count)
            pipe.send("done")
    finally:
        proxy.stop()


def apply(pipe: Pipe, name: str) -> None:
    """The application's process."""
    from skyloop.client import connect

    pipe.send("ready")
    while (turn := pipe.recv()) is not None:
        channel, count = turn
        with connect(name, name="bench", on_exit="hover") as drone:
            inline, threaded = _listen(drone, channel)
            pipe.send("connected")
            for index in paced(count, channel.period_s):
                if channel.name == COMMAND.name:
                    drone.velocity(forward=0.001 * (index % 100 + 1))
            time.sleep(SETTLE_S)
        pipe.send((inline, threaded))


def _listen(drone: Drone, channel: Channel) -> tuple[list[int], list[int]]:
    """Two lists that fill with the delays of the channel's samples."""
    inline: list[int] = []
    threaded: list[int] = []

    last: AnyAction = Velocity()

    def applied(echo: Applied) -> None:
        nonlocal last
        if type(echo.asked) is Velocity and echo.asked != last:  # each call has another one: equal ones are repeats
            last = echo.asked
            inline.append(echo.applied_ns - echo.sent_ns)

    def came(into: list[int]) -> Callable[[Feedback | Frame], None]:
        known = 0

        def arrived(sample: Feedback | Frame) -> None:
            nonlocal known
            now_ns = time.monotonic_ns()
            if sample.captured_ns > known:  # the proxy repeats an old state when somebody took the authority
                known = sample.captured_ns
                into.append(now_ns - known)

        return arrived

    if channel.name == COMMAND.name:
        drone.on_command(applied)
    elif channel.name == FEEDBACK.name:
        drone.on_feedback(came(inline), inline=True)
        drone.on_feedback(came(threaded))
    else:
        drone.add_processor(came(inline), inline=True)
        drone.add_processor(came(threaded))
    return inline, threaded
