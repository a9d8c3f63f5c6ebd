"""A world whose time goes on only when somebody says so: for flights in simulated time, the same each time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from skyloop.clock import Clock, nanoseconds
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.host import TICK_S, Runner, SimHost, Teller
from skyloop.sim.options import SimOptions

if TYPE_CHECKING:
    from skyloop.sim.studio import Camera, StepStudio

_STEPS = round(TICK_S / STEP_S)


class SteppedHost(SimHost):
    """As :class:`SimHost`, without threads: :meth:`step` goes on by :data:`~skyloop.sim.host.TICK_S`, tells the
    passengers and shows the pictures that are due, on the caller's thread. ``speed`` of the options has no meaning."""

    def __init__(self, options: SimOptions, clock: Clock, drones: int = 1) -> None:
        """``clock``: of the passengers' samples; it is for the caller to move it to :attr:`due_ns` before a step."""
        super().__init__(options, drones)
        self._clock = clock
        self._stepper: _Stepper | None = None

    @property
    def due_ns(self) -> int | None:
        """When the next step is due on the clock; None while nobody is aboard."""
        return None if self._stepper is None else self._stepper.due_ns

    def step(self) -> None:
        """Go on by one tick."""
        if self._stepper is not None:
            self._stepper.step()

    def _make_runner(self) -> Runner:
        self._stepper = _Stepper(self, self._clock)
        return self._stepper

    def ended(self) -> None:
        """The last passenger left."""
        self._stepper = None


class _Stepper:
    def __init__(self, host: SteppedHost, clock: Clock) -> None:
        self._host = host
        self._clock = clock
        self._studio: StepStudio | None = None
        self._teller = Teller(host, self._make_studio)
        self.due_ns = clock() + nanoseconds(TICK_S)

    def step(self) -> None:
        self._host.simulation.step(_STEPS)
        self._teller.tell(self.due_ns)
        if self._studio is not None:
            self._studio.hand_out(self.due_ns)
        self.due_ns += nanoseconds(TICK_S)

    def stop(self) -> None:
        if self._studio is not None:
            self._studio.stop()
        self._host.ended()

    def forget(self, cameras: tuple[Camera, ...]) -> None:
        if self._studio is not None:
            self._studio.forget(cameras)

    def _make_studio(self) -> StepStudio:
        from skyloop.sim.studio import StepStudio

        options = self._host.options
        self._studio = StepStudio(self._host.simulation.world, self._host.drones, options.renderer, options.quality)
        return self._studio
