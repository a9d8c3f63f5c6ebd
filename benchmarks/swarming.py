"""The processes of ``benchmarks.swarm``: the simulation, users that fly, observers, and one that records failsafes."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack, suppress
from typing import Final, NamedTuple

from benchmarks.measuring.workers import Pipe
from skyloop.client import Drone, Frame, connect
from skyloop.control import Controller
from skyloop.drivers.uri import parse_uri
from skyloop.errors import AuthorityError, LinkError, NoAnswerError
from skyloop.messages import Applied, Failsafe, Feedback, FlightState, Velocity
from skyloop.network import FabricServer, FabricSettings
from skyloop.proxy import Proxy
from skyloop.sim.host import SimHost
from skyloop.vehicles.sim.driver import SimDriver
from skyloop.vehicles.sim.options import options_of

#: Small pictures, because the drawing speed of this machine does not matter here.
VEHICLES: Final = "sim://?world=empty&cameras=front&width=160&height=120&fps=5"
QUALITY: Final = 70
_RADIUS_M: Final = 0.5
_SPEED_M_S: Final = 0.3
_CONNECTS_WITHIN_S: Final = 30.0
_ASKS_AGAIN_S: Final = 5.0


class Step(NamedTuple):
    """A vehicle began to fail safe."""

    drone: str
    at_ns: int  #: time on its proxy's clock


class Circle(Controller):
    """Flies a circle with a new command for each feedback sample, and records the samples' ages."""

    def __init__(self, drone: Drone, delays_ns: list[int]) -> None:
        super().__init__(drone)
        self._delays_ns = delays_ns

    def on_feedback(self, feedback: Feedback) -> None:
        self._delays_ns.append(time.monotonic_ns() - feedback.captured_ns)
        self.drone.velocity(forward=_SPEED_M_S, yaw_rate=_SPEED_M_S / _RADIUS_M)


def simulate(pipe: Pipe, place: str, names: list[str]) -> None:
    """Run all drones in one world, each with a proxy, until the end."""
    uri = parse_uri(VEHICLES)
    host = SimHost(options_of(uri), len(names))
    settings = FabricSettings(listen=(place,), multicast=False)
    proxies = [
        Proxy(SimDriver(uri, host=host, drone=number), FabricServer(name, settings), name=name)
        for number, name in enumerate(names)
    ]
    with ExitStack() as started:
        for proxy in proxies:
            proxy.start()
            started.callback(proxy.end)
        pipe.send("ready")
        pipe.recv()


def fly(pipe: Pipe, place: str, names: list[str]) -> None:
    """Run a user, who flies each of these drones with a separate controller, all in this process.

    On request, it sends the ages of feedback [ns] since the previous request.
    """
    pipe.send("ready")
    delays_ns: list[int] = []
    with ExitStack() as opened:
        if pipe.recv() is None:
            return
        drones = [opened.enter_context(_connect(name, place)) for name in names]
        for drone in drones:
            drone.takeoff(wait=False)
        for drone in drones:
            _hover(drone)
        controllers = [Circle(drone, delays_ns) for drone in drones]
        threads = [threading.Thread(target=controller.run, daemon=True) for controller in controllers]
        for thread in threads:
            thread.start()
        for drone in drones:
            drone.wait("flying", timeout_s=_CONNECTS_WITHIN_S)
        pipe.send("flying")
        while pipe.recv() is not None:
            pipe.send(list(delays_ns))
            del delays_ns[:]
        for controller in controllers:
            controller.stop()
        for thread in threads:
            thread.join()


def _hover(drone: Drone) -> None:
    """Wait until the drone hovers, repeating the request, which is not resent after a lost link."""
    deadline = time.monotonic() + _CONNECTS_WITHIN_S
    while True:
        try:
            drone.wait("hovering", timeout_s=_ASKS_AGAIN_S)
            return
        except NoAnswerError:
            if time.monotonic() > deadline:
                raise
            with suppress(LinkError, AuthorityError):  # the link was lost again, or control is not back yet
                drone.takeoff(wait=False)


def look_on(pipe: Pipe, place: str, names: list[str]) -> None:
    """Run an observer of all drones, with their video.

    On request, it sends the ages of feedback [ns] and the number of frames since the previous request.
    """
    pipe.send("ready")
    if pipe.recv() is None:
        return
    delays_ns: list[int] = []
    frames: list[int] = []

    def took(feedback: Feedback) -> None:
        delays_ns.append(time.monotonic_ns() - feedback.captured_ns)

    def saw(frame: Frame) -> None:
        frames.append(frame.seq)

    with ExitStack() as opened:
        for name in names:
            drone = opened.enter_context(_connect(name, place, observe=True))
            drone.on_feedback(took, inline=True)
            drone.on_frame(saw, encoding="jpeg", quality=QUALITY)
        pipe.send("looking")
        while pipe.recv() is not None:
            pipe.send((list(delays_ns), len(frames)))
            del delays_ns[:], frames[:]


def bear_witness(pipe: Pipe, place: str, names: list[str]) -> None:
    """Record when vehicles begin to fail safe, and the time and age of each applied command [ns].

    On the request ``"flying"``, it sends the drones that are flying at this moment.
    """
    pipe.send("ready")
    if pipe.recv() is None:
        return
    steps: list[Step] = []
    commands: list[tuple[int, int]] = []
    newest: dict[str, Feedback] = {}

    def applied(echo: Applied) -> None:
        if echo.app_id and type(echo.applied) is Velocity:
            commands.append((echo.applied_ns, echo.applied_ns - echo.sent_ns))

    def watch(name: str, drone: Drone) -> None:
        # Each feedback sample contains the ladder's state, so a lost sample hides nothing.
        def told(feedback: Feedback) -> None:
            before = newest.get(name)
            if feedback.failsafe is not Failsafe.NONE and before is not None and before.failsafe is Failsafe.NONE:
                steps.append(Step(name, feedback.captured_ns))
            newest[name] = feedback

        drone.on_feedback(told, inline=True)
        drone.on_command(applied, inline=True)

    with ExitStack() as opened:
        for name in names:
            watch(name, opened.enter_context(_connect(name, place, observe=True)))
        pipe.send("watching")
        while pipe.recv() == "flying":
            pipe.send({name for name, feedback in list(newest.items()) if feedback.state is FlightState.FLYING})
        pipe.send((steps, commands))


def _connect(name: str, place: str, *, observe: bool = False) -> Drone:
    settings = FabricSettings(connect=(place,), multicast=False)
    access = "observe" if observe else "pilot"
    return connect(name, access=access, network=settings, timeout_s=_CONNECTS_WITHIN_S)  # type: ignore[arg-type]
