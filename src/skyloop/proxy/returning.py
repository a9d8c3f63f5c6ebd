"""Flies the vehicle back to its start where the failsafe ladder says so, and knows what feedback shows of that.

Not thread-safe: called under the command handler's lock.
"""

from __future__ import annotations

from skyloop.messages import FlightState, Hover, Position, ReturnPhase, ReturnToStart
from skyloop.proxy.core.command_checks import CommandChecks
from skyloop.proxy.core.failsafe import FailsafeLadder
from skyloop.proxy.core.returning import PATIENCE_NS
from skyloop.proxy.executor import ActionExecutor
from skyloop.proxy.publisher import VehiclePublisher
from skyloop.zones import Vec3


class ReturnSupervisor:
    """The way back to the start, of one vehicle.

    Args:
        checks: Hold the start, and the flight back that a pilot or the ladder began.
        ladder: Whether to return.
        executor: Carries actions out.
        publisher: What the vehicle reported.
    """

    def __init__(
        self, checks: CommandChecks, ladder: FailsafeLadder, executor: ActionExecutor, publisher: VehiclePublisher
    ) -> None:
        self.start: Vec3 | None = None  #: where the vehicle took off, as feedback shows it [m]
        self.phase = ReturnPhase.NONE  #: how far it is on its way back, as feedback shows it
        self._checks = checks
        self._ladder = ladder
        self._executor = executor
        self._vehicle = publisher
        self._problem = ""  # why the ladder's flight back can't go on
        self._good_ns = 0  # when that went well last

    def begin(self, action: ReturnToStart, now_ns: int) -> None:
        """Begin the ladder's flight back; :meth:`update` goes on with it."""
        self._checks.begin_return(action)
        self._problem, self._good_ns = "", now_ns

    def update(self, now_ns: int, *, ours: bool) -> bool:
        """Observe the start, and fly back if the ladder does; return whether feedback has something else to show.

        Args:
            now_ns: The time now [ns].
            ours: Whether the flight is the proxy's; what others fly is not on its way back for us.
        """
        checks, executor = self._checks, self._executor
        checks.start.observe(executor.state, self._vehicle.feedback_now, now_ns)
        if self._ladder.returning and checks.back is not None:
            self._fly(now_ns)
        if not ours:
            checks.back = None
        return self.observe()

    def observe(self) -> bool:
        """Observe how far the way back is; return whether feedback has something else to show."""
        before = self.start, self.phase
        back = self._checks.back if self._checks.back is not None and self._executor.airborne else None
        self.start = self._checks.start.position
        self.phase = ReturnPhase.NONE if back is None else back.phase
        return (self.start, self.phase) != before

    def why_not(self, now_ns: int) -> str:
        """Return why the ladder can't return to the start; empty if it can, or is not to."""
        settings = self._ladder.settings
        if self._ladder.returning:
            return self._problem
        if not (settings.returns or settings.battery_return):
            return ""
        if ReturnToStart not in self._executor.supported:
            return "neither the vehicle nor the software autopilot can do it"
        return self._checks.why_no_return(self._vehicle.feedback_now, now_ns)

    def _fly(self, now_ns: int) -> None:
        """Take the next step of the ladder's flight; what is against it is left to the ladder."""
        if not self._vehicle.link_up:
            self._good_ns = now_ns  # nothing can be said about it, and nothing be done
            return
        decision = self._checks.step_return(self._vehicle.feedback_now, now_ns)
        action, problem = decision.action, "" if decision.refusal is None else decision.why
        if isinstance(action, Position):
            if not self._executor.fly_to(action, now_ns):
                problem = "its driver fails to fly it there"
        elif action is None or self._executor.state is not FlightState.LANDING:
            self._executor.failsafe(action or Hover(), now_ns)
        if not problem:
            self._good_ns = now_ns
        elif decision.lasting or now_ns - self._good_ns >= PATIENCE_NS:
            self._problem = problem
