"""Execute actions with the driver or, for actions that the vehicle lacks, the software autopilot; fly the return.

Not thread-safe: the command handler's lock is held during every call. Parameters and external poses bypass this module.
"""

from __future__ import annotations

from skyloop.drivers.base import Driver
from skyloop.errors import DriverError, RefusedError, shortened
from skyloop.messages import (
    ACTION_NAMES,
    Action,
    AnyAction,
    Attitude,
    Capabilities,
    Feedback,
    FlightState,
    Hover,
    Land,
    Position,
    Refusal,
    ReturnPhase,
    ReturnToStart,
    Takeoff,
    Velocity,
)
from skyloop.messages.feedback import MAX_LINK_TEXT
from skyloop.proxy.core.autopilot import PATIENCE_NS, SoftwareAutopilot, software_actions
from skyloop.proxy.core.command_checks import CommandChecks
from skyloop.proxy.core.failsafe import FailsafeLadder
from skyloop.proxy.core.flight import STALE_NS, Changed, Flight, Snapshot
from skyloop.proxy.publisher import VehiclePublisher
from skyloop.zones import Vec3


class ActionExecutor:
    """Sends supported actions to the driver and emulates the others with the software autopilot, if there is one."""

    def __init__(
        self,
        driver: Driver,
        capabilities: Capabilities,
        flight: Flight,
        autopilot: SoftwareAutopilot | None,
        publisher: VehiclePublisher,
    ) -> None:
        software = software_actions(capabilities.actions)
        self.native = frozenset(kind for kind, name in ACTION_NAMES.items() if name in capabilities.actions)
        self.supported: frozenset[type[Action]] = self.native | {
            kind for kind, name in ACTION_NAMES.items() if name in software
        }
        self.why_not = capabilities.why_not
        self.flight = flight
        self.autopilot = autopilot
        #: Whether the path to a target must be checked. If so, the software autopilot flies there.
        self.guarded = False
        self._driver = driver
        self._left_to = ""  # the driver's last answer
        self.observe_error: Exception | None = None  #: why the driver gave no answer; the tick clears it and raises it
        self._publisher = publisher
        self.autopilot_refusal = ""  #: why the vehicle refused to continue a software take-off; cleared by the reader

    @property
    def state(self) -> FlightState:
        """The current flight state, which may be more recent than the last feedback."""
        return self.flight.state(self._publisher.reported_state)

    @property
    def airborne(self) -> bool:
        """Whether the vehicle flies, or may be flying, as :meth:`Flight.flies` decides."""
        return self.flight.flies(self.state)

    @property
    def drifts(self) -> bool:
        """Whether the software autopilot can't brake the vehicle because its velocity is unknown."""
        return self.autopilot is not None and self.autopilot.drifts

    def seen(self, now_ns: int) -> Snapshot:
        vehicle = self._publisher
        state = self.flight.state(vehicle.reported_state)
        return Snapshot(now_ns, state, vehicle.feedback_now, vehicle.link_state, vehicle.link_up)

    def observe(self, now_ns: int) -> Changed | None:
        """Observe the vehicle, and return the change if its flight has changed hands."""
        try:
            left_to = self._driver.left_to()
            self._left_to = shortened(left_to, MAX_LINK_TEXT // 2) if left_to else ""
        except Exception as error:  # noqa: BLE001  the failsafe comes first, whatever the driver's code does
            self.observe_error = error
        return self.flight.observe(self._publisher.reported_state, self._left_to, now_ns, self._shown(now_ns))

    def _shown(self, now_ns: int) -> Feedback | None:
        """Return the newest sample if it contains the current state."""
        feedback = self._publisher.feedback_now if self._publisher.link_up else None
        return feedback if feedback is not None and now_ns - feedback.captured_ns <= STALE_NS else None

    @property
    def stands(self) -> bool:
        """Whether the vehicle reports being on the ground, even if the software autopilot is about to take off."""
        return self._publisher.reported_state is FlightState.LANDED

    def stop_autopilot(self) -> None:
        """Stop the software autopilot because others are in control."""
        if self.autopilot is not None:
            self.autopilot.stop("idle")

    def execute(self, action: AnyAction, now_ns: int, *, new: bool = True) -> AnyAction:
        """Execute a supported action, and return the action that was actually applied. Raises the driver's errors.

        ``new``: whether it is a new request of the application rather than a repeat. Raises :class:`RefusedError` if
        the vehicle certainly won't follow commands in its present state.
        """
        autopilot = self.autopilot
        try:
            if type(action) in self.native and not (self.guarded and type(action) is Position and autopilot):
                applied = self._driver.apply(action, new=new)
                if autopilot is not None:
                    autopilot.stop(action.name)
            else:
                try:
                    self._driver.check(action)
                except DriverError as error:
                    raise RefusedError(str(error), code=Refusal.WRONG_STATE) from error
                self._start(action, now_ns)
                applied = action
        except Exception:
            if autopilot is not None and isinstance(action, Hover | Land):
                autopilot.brake()
            raise
        self.flight.sent(applied)
        return applied

    def attempt(self, action: AnyAction, now_ns: int, where: str) -> bool:
        """Apply an action that is not a new request; return whether it was accepted. Failures are published."""
        try:
            self.execute(action, now_ns, new=False)
        except Exception as error:  # noqa: BLE001  it is reported, and the next step retries
            self._publisher.driver_failed(where, error)
            return False
        return True

    def failsafe(self, action: Hover | Land, now_ns: int) -> bool:
        """Hover or land without a pilot; return whether the driver accepted this. Failures are published."""
        if type(action) in self.native:
            taken = False
            try:
                taken = self._driver.failsafe(action)
            except Exception as error:  # noqa: BLE001  it is reported and retried
                self._publisher.driver_failed("failsafe", error)
            if taken and self.autopilot is not None:
                self.autopilot.stop(action.name)
            elif self.autopilot is not None:
                self.autopilot.brake()
        elif type(action) in self.supported:
            self._start(action, now_ns)
            taken = True
        else:
            return False
        if taken:
            self.flight.sent(action)
        return taken

    def leave(self, now_ns: int) -> None:
        """Make the vehicle hover with the last command that is sent.

        A vehicle without a native hover gets a set-point instead: zero velocity, or a level attitude.
        """
        if Hover in self.native or self.autopilot is None:
            self.failsafe(Hover(), now_ns)
            return
        last: Velocity | Attitude = Velocity() if Velocity in self.native else Attitude()
        try:
            self._driver.apply(last)
        except Exception as error:  # noqa: BLE001 it is reported, and nothing more can be done
            self._publisher.driver_failed("failsafe", error)

    def step(self, now_ns: int) -> AnyAction | None:
        """If the software autopilot is on, let it send its next set-point. Return what the driver applied."""
        if self.autopilot is None:
            return None
        action = self.autopilot.step(now_ns, self._shown(now_ns), self._publisher.reported_state)
        if action is None:
            return None
        try:
            return self._driver.apply(action)
        except Exception as error:  # noqa: BLE001  it is reported, and the next step retries
            self._publisher.driver_failed("autopilot", error)
            if isinstance(error, DriverError):
                before = self.autopilot.mode
                self.autopilot.refused(self._publisher.reported_state)
                self.autopilot_refusal = str(error) if self.autopilot.mode is not before else ""
            return None

    def _start(self, action: AnyAction, now_ns: int) -> None:
        assert self.autopilot is not None
        assert isinstance(action, Takeoff | Hover | Land | Velocity | Position)
        self.autopilot.start(action, now_ns, self._publisher.feedback_now)


class ReturnSupervisor:
    """Flies the vehicle back to its start for the failsafe ladder, and reports this in feedback."""

    def __init__(self, checks: CommandChecks, ladder: FailsafeLadder, executor: ActionExecutor) -> None:
        self.start: Vec3 | None = None  #: where the vehicle took off, as reported in feedback [m]
        self.phase = ReturnPhase.NONE  #: progress of the return, as reported in feedback
        self._checks = checks
        self._ladder = ladder
        self._executor = executor
        self._problem = ""  # reason why the ladder's return flight can't continue
        self._good_ns = 0  # last time at which the return could continue

    def begin(self, action: ReturnToStart, now_ns: int) -> None:
        """Start the ladder's return; :meth:`update` continues it."""
        self._checks.begin_return(action)
        self._problem, self._good_ns = "", now_ns

    def update(self, seen: Snapshot, *, ours: bool) -> bool:
        """Update the start position, and fly back if the ladder requires it; return whether feedback must change.

        ``ours``: whether the flight is the proxy's. Vehicles flown by others do not return on the proxy's behalf.
        """
        checks = self._checks
        checks.start.observe(seen.state, seen.feedback, seen.now_ns)
        if self._ladder.returning and checks.way_back is not None:
            self._fly(seen)
        if not ours:
            checks.way_back = None
        return self.observe()

    def observe(self) -> bool:
        """Observe the progress of the return; return whether feedback must change."""
        before, back = (self.start, self.phase), self._checks.way_back
        self.start = self._checks.start.position
        self.phase = ReturnPhase.NONE if back is None or not self._executor.airborne else back.phase
        return (self.start, self.phase) != before

    def why_not(self, seen: Snapshot) -> str:
        """Return why the ladder can't fly back to the start; empty if it can or does not need to."""
        settings = self._ladder.settings
        if self._ladder.returning:
            return self._problem
        if not (settings.returns or settings.battery_return):
            return ""
        if ReturnToStart not in self._executor.supported:
            return "neither the vehicle nor the software autopilot can do it"
        return self._checks.why_no_return(seen.feedback, seen.now_ns)

    def _fly(self, seen: Snapshot) -> None:
        """Take the next step of the ladder's return to the start. The ladder handles any objections."""
        now_ns = seen.now_ns
        if not seen.link_up:
            self._good_ns = now_ns  # nothing is known, so there is no objection
            return
        decision = self._checks.step_return(seen.feedback, now_ns)
        action, problem = decision.action, "" if decision.refusal is None else decision.why
        if isinstance(action, Position):
            if not self._executor.attempt(action, now_ns, "failsafe"):
                problem = "its driver fails to fly there"
        elif action is None or seen.state is not FlightState.LANDING:
            self._executor.failsafe(action or Hover(), now_ns)
        if not problem:
            self._good_ns = now_ns
        elif decision.lasting or now_ns - self._good_ns >= PATIENCE_NS:
            self._problem = problem
