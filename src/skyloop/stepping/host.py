"""A simulated world whose time advances only when it is stepped: for flights in simulated time, the same each time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from skyloop.clock import Clock, nanoseconds
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.host import TICK_S, ReportPublisher, SimHost, Stepper
from skyloop.sim.options import SimOptions

if TYPE_CHECKING:
    from skyloop.sim.camera_pipeline import Camera, SteppedCameraPipeline

_STEPS = round(TICK_S / STEP_S)


class SteppedHost(SimHost):
    """A :class:`SimHost` without threads.

    :meth:`step` advances by :data:`~skyloop.sim.host.TICK_S`, reports to the observers and delivers the frames that are
    due, on the caller's thread. ``speed`` of the options has no effect.
    """

    def __init__(self, options: SimOptions, clock: Clock, drones: int = 1) -> None:
        """Initialise the world.

        Args:
            options: Of the simulation.
            clock: Of the observers' samples; the caller moves it to :attr:`due_ns` before a step.
            drones: How many drones the world has.
        """
        super().__init__(options, drones)
        self._clock = clock
        self._manual_stepper: _ManualStepper | None = None

    @property
    def due_ns(self) -> int | None:
        """When the next step is due on the clock; None while no observer is attached."""
        return None if self._manual_stepper is None else self._manual_stepper.due_ns

    def step(self) -> None:
        """Advance by one tick."""
        if self._manual_stepper is not None:
            self._manual_stepper.step()

    def _make_stepper(self) -> Stepper:
        self._manual_stepper = _ManualStepper(self, self._clock)
        return self._manual_stepper

    def ended(self) -> None:
        """Forget the stepper: the last observer was detached."""
        self._manual_stepper = None


class _ManualStepper:
    def __init__(self, host: SteppedHost, clock: Clock) -> None:
        self._host = host
        self._clock = clock
        self._pipeline: SteppedCameraPipeline | None = None
        self._publisher = ReportPublisher(host, self._make_pipeline)
        self.due_ns = clock() + nanoseconds(TICK_S)

    def step(self) -> None:
        self._host.simulation.step(_STEPS)
        self._publisher.publish(self.due_ns)
        if self._pipeline is not None:
            self._pipeline.hand_out(self.due_ns)
        self.due_ns += nanoseconds(TICK_S)

    def stop(self) -> None:
        if self._pipeline is not None:
            self._pipeline.stop()
        self._host.ended()

    def forget(self, cameras: tuple[Camera, ...]) -> None:
        if self._pipeline is not None:
            self._pipeline.forget(cameras)

    def _make_pipeline(self) -> SteppedCameraPipeline:
        from skyloop.sim.camera_pipeline import SteppedCameraPipeline

        self._pipeline = SteppedCameraPipeline(
            self._host.simulation.world, self._host.drones, self._host.options.quality
        )
        return self._pipeline
