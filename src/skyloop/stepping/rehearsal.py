"""Rehearsals: flights in simulated time, with a clock that stops while the controller computes.

Simulator, driver, proxy and application share this process. Whenever the application waits in :meth:`Controller.run`,
for the next frame, or for a state, time advances to the next event. A one-minute flight therefore takes only as long as
its computation, a slow machine misses nothing, and the same seeds give the same flight. Delay, loss and position noise
between proxy and vehicle are simulated.
"""

from __future__ import annotations

import heapq
import itertools
import math
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.client import Drone
from skyloop.client.drone import open_drone
from skyloop.clock import NS_PER_S, Clock, ManualClock, nanoseconds
from skyloop.drivers.base import Sink
from skyloop.drivers.uri import VehicleUri, parse_uri
from skyloop.errors import UsageError
from skyloop.messages import AnyAction, Feedback
from skyloop.proxy.proxy import Proxy
from skyloop.sim.camera import CameraModel
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.host import TICK_S, Report, ReportPublisher, SimHost, Stepper
from skyloop.sim.options import SimOptions
from skyloop.stepping.transport import StepExecutor, SteppedServer, StepScheduler
from skyloop.vehicles.sim.driver import SimDriver
from skyloop.vehicles.sim.options import options_of

if TYPE_CHECKING:
    from skyloop.sim.camera_pipeline import PipelineCamera, SteppedCameraPipeline

_BEGIN_NS: Final = 10 * NS_PER_S  #: start of the simulated clock
_CONNECT_S: Final = 20.0  #: connection timeout


@dataclass(frozen=True, slots=True)
class Radio:
    """Simulated delay, loss and noise between proxy and vehicle.

    Raises:
        UsageError: A number is negative or not finite, or ``drop`` is not below 1.
    """

    command_delay_s: float = 0.04
    feedback_delay_s: float = 0.02
    picture_delay_s: float = 0.02  #: delay of frames, in addition to the camera's own latency
    drop: float = 0.05  #: probability that a command, a feedback sample or a frame is lost
    position_noise_m: float = 0.01  #: standard deviation of each component of the position in feedback
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("command_delay_s", "feedback_delay_s", "picture_delay_s", "position_noise_m"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise UsageError(f"{name} is {getattr(self, name)!r} and must be a finite number, 0 or more")
        if not 0.0 <= self.drop < 1.0:
            raise UsageError(f"drop is {self.drop!r} and must be a probability below 1")


@contextmanager
def rehearse(uri: str = "sim://?cameras=none", *, radio: Radio | None = None) -> Iterator[Drone]:
    """Connect as a pilot to a drone in a simulated world.

    Only the thread that runs the ``with`` block may wait. Frames are rendered when they are exposed, not in real time.

    Args:
        uri: A ``sim://`` address without ``speed``.
        radio: The radio link between proxy and vehicle, or None for the defaults.

    Yields:
        The connected drone.

    Raises:
        UsageError: The address is not a ``sim://`` address, or specifies a ``speed``.
    """
    address = parse_uri(uri)
    if address.scheme != "sim" or "speed" in address.options:
        raise UsageError(f"{uri} can't be rehearsed: give an address such as sim://?seed=3, without speed")
    clock = ManualClock(_BEGIN_NS)
    host = SteppedHost(replace(options_of(address), speed=1.0), clock)
    driver = _RehearsalDriver(address, host, radio or Radio(), clock)
    executor = StepExecutor("skyloop-rehearsal")
    try:
        server = SteppedServer(executor)
        proxy = Proxy(driver, server, name="rehearsal", clock=clock, ticker=False)
        scheduler = StepScheduler(clock, executor, proxy, lambda: driver, _BEGIN_NS)
        proxy.start()
        try:
            with open_drone(server.dial, app="rehearsal", scheduler=scheduler, timeout_s=_CONNECT_S) as drone:
                yield drone
        finally:
            proxy.end()
    finally:
        executor.close()


class _RehearsalDriver(SimDriver):
    """The simulated drone behind a radio, advanced step by step on a single thread."""

    def __init__(self, uri: VehicleUri, host: SimHost, radio: Radio, clock: ManualClock) -> None:
        super().__init__(uri, host=host)
        self._radio = radio
        self._clock = clock
        self._random = random.Random(f"rehearsal/{radio.seed}")
        # Cameras use a separate generator, so that they do not affect which commands and feedback are lost.
        self._picture_random = random.Random(f"rehearsal/pictures/{radio.seed}")
        self._on_the_way: list[tuple[int, int, Callable[[], None]]] = []  # a heap ordered by arrival time
        self._numbers = itertools.count()

    @property
    def due_ns(self) -> int | None:
        """Time at which the next step or arrival is due."""
        assert isinstance(self.host, SteppedHost)
        step_ns = self.host.due_ns
        if step_ns is None or not self._on_the_way:
            return step_ns
        return min(step_ns, self._on_the_way[0][0])

    def step(self) -> None:
        """Deliver the next arrival if it is due, or else advance the world."""
        assert isinstance(self.host, SteppedHost)
        if self._on_the_way and self._on_the_way[0][0] <= self._clock.now_ns:
            heapq.heappop(self._on_the_way)[2]()
        else:
            self.host.step()

    def open(self, sink: Sink) -> None:
        super().open(cast(Sink, _NoisySink(sink, self._radio.position_noise_m, self._random)))

    def report(self, report: Report) -> None:
        self._send(self._radio.feedback_delay_s, lambda: SimDriver.report(self, report), self._random)

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        def arrive() -> None:
            SimDriver.show(self, model, pixels, captured_ns)

        self._send(self._radio.picture_delay_s, arrive, self._picture_random)

    def _command(self, host: SimHost, action: AnyAction) -> AnyAction:
        self._send(self._radio.command_delay_s, lambda: self._arrive(host, action), self._random)
        return action

    def _arrive(self, host: SimHost, action: AnyAction) -> None:
        if self._sink is not None:
            super()._command(host, action)

    def _send(self, delay_s: float, arrive: Callable[[], None], chance: random.Random) -> None:
        if chance.random() >= self._radio.drop:
            due_ns = self._clock.now_ns + nanoseconds(delay_s)
            heapq.heappush(self._on_the_way, (due_ns, next(self._numbers), arrive))


class _NoisySink:
    """A sink that adds noise to positions and passes everything else on unchanged."""

    def __init__(self, sink: Sink, noise_m: float, chance: random.Random) -> None:
        self._sink = sink
        self._noise_m = noise_m
        self._gauss = chance.gauss

    def feedback(self, feedback: Feedback) -> None:
        if feedback.position_m is not None:
            x, y, z = (value + self._gauss(0.0, self._noise_m) for value in feedback.position_m)
            feedback = msgspec.structs.replace(feedback, position_m=(x, y, z))
        self._sink.feedback(feedback)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sink, name)


class SteppedHost(SimHost):
    """A :class:`SimHost` without threads.

    :meth:`step` advances by :data:`~skyloop.sim.host.TICK_S`, reports to the observers and delivers due frames on the
    caller's thread. The option ``speed`` has no effect.
    """

    def __init__(self, options: SimOptions, clock: Clock, drones: int = 1) -> None:
        """Load the world; the caller moves the clock to :attr:`due_ns` before each step."""
        super().__init__(options, drones)
        self._clock = clock
        self._manual_stepper: _ManualStepper | None = None

    @property
    def due_ns(self) -> int | None:
        """Time on the clock at which the next step is due; None if there is no observer."""
        return None if self._manual_stepper is None else self._manual_stepper.due_ns

    def step(self) -> None:
        """Advance the simulation by one tick."""
        if self._manual_stepper is not None:
            self._manual_stepper.step()

    def _make_stepper(self) -> Stepper:
        self._manual_stepper = _ManualStepper(self, self._clock)
        return self._manual_stepper

    def ended(self) -> None:
        """Discard the stepper after the last observer has been detached."""
        self._manual_stepper = None


class _ManualStepper:
    def __init__(self, host: SteppedHost, clock: Clock) -> None:
        self._host = host
        self._clock = clock
        self._pipeline: SteppedCameraPipeline | None = None
        self._publisher = ReportPublisher(host, self._make_pipeline)
        self.due_ns = clock() + nanoseconds(TICK_S)

    def step(self) -> None:
        self._host.simulation.step(round(TICK_S / STEP_S))
        self._publisher.publish(self.due_ns)
        if self._pipeline is not None:
            self._pipeline.hand_out(self.due_ns)
        self.due_ns += nanoseconds(TICK_S)

    def stop(self) -> None:
        if self._pipeline is not None:
            self._pipeline.stop()
        self._host.ended()

    def forget(self, cameras: tuple[PipelineCamera, ...]) -> None:
        if self._pipeline is not None:
            self._pipeline.forget(cameras)

    def _make_pipeline(self) -> SteppedCameraPipeline:
        from skyloop.sim.camera_pipeline import SteppedCameraPipeline

        self._pipeline = SteppedCameraPipeline(
            self._host.simulation.world, self._host.drones, self._host.options.quality
        )
        return self._pipeline
