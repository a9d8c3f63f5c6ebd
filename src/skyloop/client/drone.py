"""The drone as an application sees it: commands, sensor readings, callbacks, and the end of a flight."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, Final, Literal, ParamSpec, Self, TypedDict, TypeVar, Unpack

import msgspec
import numpy as np

from skyloop.client.actions import (
    CommandSchedule,
    ReturnWatch,
    above_zero,
    checked,
    in_world_axes,
    is_there,
    number,
    position_action,
    return_action,
)
from skyloop.client.authority import (
    Authority,
    AuthorityStatus,
    AuthorityTracker,
    EndedSessions,
    TakeoverAnswer,
    TakeoverRequest,
    TakeoverWay,
    answering,
    authority_request,
)
from skyloop.client.channels import JOIN_S, Channel, Listener, Mailbox, checked_age
from skyloop.client.commands import CommandSender
from skyloop.client.connection import ConnectionSupervisor, ProxyConnection, RedialPolicy, Scheduler
from skyloop.client.frame import Frame, ReceivedFrame
from skyloop.client.monitoring import ChannelStats, Distribution
from skyloop.client.parameters import Config, Restorer
from skyloop.client.piloting import OnExit, Piloting
from skyloop.client.preflight import PreflightFinding, inspect
from skyloop.client.publishing import Logbook, checked_time
from skyloop.client.results import Result, ResultListener, ResultMailbox, is_old, silence
from skyloop.client.telemetry import ClientState, LinkStatus, SessionSamples, Wanted, as_predicate
from skyloop.client.video import StreamChannel, VideoOptions
from skyloop.errors import AuthorityError, ClosedError, LinkError, NoAnswerError, UnknownNameError, UsageError
from skyloop.messages import (
    Annotation,
    AnyAction,
    Applied,
    Attitude,
    Capabilities,
    EmergencyStop,
    EncodedFrame,
    Event,
    EventKind,
    Feedback,
    FeedbackRequest,
    FlightState,
    GetStatistics,
    Hello,
    Hover,
    Idle,
    Land,
    LinkState,
    LogEntry,
    Overview,
    ResetEmergency,
    Role,
    Severity,
    Statistics,
    Takeoff,
    Vector,
    VehiclePose,
    Velocity,
    encode,
)
from skyloop.messages.command import check_pose
from skyloop.messages.frame import Chain
from skyloop.messages.relayed import Shape
from skyloop.messages.subscription import EVERY_SAMPLE
from skyloop.transport.base import EVENTS, Dialer

Access = Literal["pilot", "observe"]
P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")
UP: Final = frozenset({FlightState.HOVERING, FlightState.FLYING})
DOWN: Final = frozenset({FlightState.LANDED})
EVENT_DEPTH: Final = 256  #: maximum number of events or log entries waiting for a slow callback
WHOLE_S: Final = 1.0  #: time limit for a complete sample of feedback if a reduced rate was requested [s]
_CAMERA_CHECK_S: Final = 0.5  #: how often a thread waiting for a frame checks that its camera still exists
_SOON_S: Final = 1.0  #: time after which the log reports that a vehicle is still starting up
_ENDED: Final = EndedSessions()  #: shared by all drones of this process
_log = logging.getLogger("skyloop")


class DroneOptions(TypedDict, total=False):
    """Options of a :class:`Drone`."""

    access: Access  #: ``"pilot"`` may send commands; ``"observe"`` only reads
    rate_hz: float  #: rate at which commands are repeated, 1 to 200 Hz
    stall_s: float  #: time without a call after which a velocity or attitude decays to hover [s]; ``math.inf``: never
    on_exit: OnExit  #: what an airborne vehicle does at the end of the block
    policy: RedialPolicy | None  #: when to reconnect, and when a link counts as lost
    scheduler: Scheduler | None  #: provides the current time and the ways to wait; None: real time
    on_close: Callable[[], None] | None  #: called at the end of :meth:`Drone.close`, on the closing thread
    reach: str | None  #: name or address at which other processes can reach the vehicle; None: they can't


def by_name(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of keyword-only arguments so that a wrong call raises an error that shows a correct one."""
    known = list(function.__kwdefaults__ or {})

    @wraps(function)
    def call(*args: P.args, **given: P.kwargs) -> R:
        try:
            return function(*args, **given)
        except TypeError as error:
            if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                raise  # the function raised it, not the call itself
            for unknown in given.keys() - known:
                raise UnknownNameError(f"argument of {function.__name__}", unknown, known) from None
            first = f"{function.__name__}({known[0]}={args[1]!r:.20})" if len(args) > 1 else "its own"
            raise UsageError(f"{function.__name__} takes {', '.join(known)} by their names, as in {first}") from None

    return call


def _all_finite(a: object, b: object, c: object, d: object) -> bool:
    """Return whether four values are finite floats that can be sent unchanged; avoids calling :func:`number` for each.

    False does not mean that the values are invalid: ints may be valid, and so may four huge floats whose sum overflows.
    """
    floats = type(a) is float and type(b) is float and type(c) is float and type(d) is float
    return floats and math.isfinite(a + b + c + d)  # type: ignore[operator]


class Drone:
    """A connected vehicle, returned by :func:`skyloop.connect`.

    It is a context manager, and every method is thread-safe. At the end of its ``with`` block, a drone that is flying
    under this application's authority lands, and the authority is released. Once the end has begun, commands from other
    threads raise :class:`ClosedError`, except for an emergency stop. A drone that someone else is flying is left
    alone, and a drone that is returning because of a low battery continues to return. ``sys.exit()`` in a callback ends
    the flight in the same way. Pressing Ctrl-C (or a notebook's *Stop*) while a call waits makes the vehicle hover;
    during :meth:`land`, the landing continues. With ``wait=False``, calls don't wait and can't be interrupted. A lost
    connection to the proxy is re-established, however long that takes. Then everything but old set-points is restored.

    Body axes are x forward, y left, z up (REP 103); units are SI and radians. Every command describes the full desired
    state. It is sent immediately and then repeated at ``rate_hz`` until the next command. Commands that return a bool
    return True if the command was handed to the transport, and False while the link is down or the authority has not
    been granted yet. The command is then sent once both are available, unless it is more than 0.5 s old by that time.
    Set-points also return False while the proxy is known to refuse them, for example on the ground or while someone
    else flies the vehicle. Events give the reason. Every command raises:

    - :class:`AuthorityError` while another application holds the authority or none was requested,
    - :class:`UsageError` for numbers that are not finite,
    - :class:`UnsupportedError` for a vehicle without commands,
    - :class:`ClosedError` after :meth:`close`, or once the end of the block has begun.

    The name of a reading method says what it returns: the newest sample (:meth:`feedback`, :meth:`frame`), the
    next unread one (:meth:`next_feedback`, :meth:`next_frame`), or all of them (:meth:`frames`, :meth:`on_feedback`).
    """

    def __init__(
        self,
        dial: Dialer,
        *,
        app: str,
        access: Access = "pilot",
        rate_hz: float = 32.0,
        stall_s: float = 1.0,
        on_exit: OnExit = "land",
        policy: RedialPolicy | None = None,
        scheduler: Scheduler | None = None,
        on_close: Callable[[], None] | None = None,
        reach: str | None = None,
    ) -> None:
        """Prepare an unconnected drone; use :func:`skyloop.connect` instead. See :class:`DroneOptions`.

        Raises:
            UsageError: If ``access``, ``on_exit``, ``app``, ``rate_hz`` or ``stall_s`` is out of range.
        """
        if access not in ("pilot", "observe"):
            raise UsageError(f'access is {access!r} and must be "pilot" or "observe"')
        if on_exit not in ("land", "hover"):
            raise UsageError(f'on_exit is {on_exit!r} and must be "land" or "hover"')
        if not 1 <= len(app) <= 64:
            raise UsageError(f"an application's name must have 1 to 64 characters, got {len(app)}: {app!r:.80}")
        role = Role.PILOT if access == "pilot" else Role.OBSERVER
        scheduler = scheduler or Scheduler()
        self._reach = reach
        self._on_close = on_close
        self._read: Feedback | None = None  # the last sample that feedback() or next_feedback() returned
        # Each object uses only objects created before it; the receiver handles the samples of every session.
        connection = self._connection = ProxyConnection(scheduler.clock)
        authority = AuthorityTracker(app, _ENDED)
        state = self._state = ClientState(app, connection, scheduler, whole_feedback=access == "pilot")
        restorer = Restorer(connection, state.emit)
        self.config = Config(connection, authority, restorer)
        self.log = Logbook(connection, app)
        schedule = CommandSchedule(rate_hz=rate_hz, stall_s=stall_s)
        changed = state.notifier.notify
        self._commands = CommandSender(
            role, authority, schedule, connection, scheduler, emit=state.emit, changed=changed, granted=restorer.restore
        )
        self._piloting = Piloting(connection, state, self._commands, on_exit, self.close)
        receiver = SessionSamples(state, connection, self._commands, restorer)
        self._supervisor = ConnectionSupervisor(
            connection, receiver, dial, Hello(app, role), policy=policy, clock=scheduler.clock, begin=scheduler.begin
        )
        connection.subscribe(EVENTS)

    def _connect(
        self,
        *,
        timeout_s: float = 5.0,
        authority: Authority | None = None,
        acquire: bool = True,
        wait_for_state: bool = True,
        wake_s: float = 0.0,
    ) -> None:
        """Connect, then wait for feedback and, as a pilot, for the authority. Closes the drone on failure.

        ``timeout_s`` limits the wait for the proxy's answer, for the first feedback and, as a pilot, for the vehicle to
        start up, which gets at least ``wake_s`` once the authority is granted. With ``acquire=False``, a pilot does not
        request the authority yet. Raises the errors of :func:`skyloop.connect`.
        """
        state = self._state

        def known() -> bool:
            return state.newest is not None and state.status.application is not LinkState.CONNECTING

        try:
            deadline = time.monotonic() + timeout_s
            self._supervisor.start(timeout_s)
            if wait_for_state and not state.notifier.wait_for(known, max(0.1, deadline - time.monotonic())):
                raise NoAnswerError(f"{self.name} answered but reported no vehicle state within {timeout_s:g} s")
            if acquire and self._commands.role is Role.PILOT:
                self._connection.check_open()
                asked = authority or Authority()
                request = authority_request(asked.priority, asked.for_s, asked.takeover)
                self._commands.request(request, asked.wait_s, stay=asked.stay)
                if wait_for_state and not state.scheduler.in_step:
                    self._wait_until_awake(max(deadline, time.monotonic() + wake_s))
            state.scheduler.opened()
        except BaseException:
            self.close()
            raise

    def _wait_until_awake(self, deadline_s: float) -> None:
        """Wait until the vehicle has started up, or until the deadline; log what it is waiting for."""

        def why_asleep() -> str:
            newest = self._state.newest
            return newest.link_reason if newest is not None and newest.waking_up and not self.closed else ""

        wait_for = self._state.notifier.wait_for
        if wait_for(lambda: not why_asleep(), min(_SOON_S, deadline_s - time.monotonic())):
            return
        _log.warning("%s is %s; waiting for it", self.name, why_asleep())
        if not wait_for(lambda: not why_asleep(), deadline_s - time.monotonic()):
            _log.warning("%s is %s: it can't take off yet", self.name, why_asleep())

    # Properties --------------------------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Name of the proxy; empty before the first connection."""
        return self._state.name

    @property
    def uri(self) -> str:
        """Address of the vehicle; empty before the first connection."""
        return "" if self._state.welcome is None else self._state.welcome.uri

    @property
    def capabilities(self) -> Capabilities:
        """Actions and cameras of the vehicle; ``vehicle`` is ``unknown`` before the first connection."""
        welcome = self._state.welcome
        return Capabilities("unknown") if welcome is None else welcome.capabilities

    @property
    def clock_offset_ns(self) -> int:
        """Estimate of the proxy's clock minus this process's clock [ns]."""
        return self._connection.offset_ns

    @property
    def now_ns(self) -> int:
        """Estimate of the time on the proxy's clock [ns]; in a stepped replay, the time in the recorded flight."""
        return self._connection.now_ns

    @property
    def clock_uncertainty_ns(self) -> int:
        """Maximum error of :attr:`clock_offset_ns`, and thus of ages and delays [ns]; 0 if both use the same clock."""
        return self._connection.uncertainty_ns

    @property
    def app_id(self) -> int:
        """Number of this application in the proxy's current run."""
        return self._commands.app_id

    @property
    def link(self) -> LinkStatus:
        """State of both links: from the application to the proxy, and from the proxy to the vehicle.

        ``reason`` explains the last change or, while the proxy is lost, why the last attempt to reconnect failed.
        """
        status = self._state.status
        return replace(status, reason=self._connection.reason) if status.application is LinkState.LOST else status

    @property
    def start_position(self) -> Vector | None:
        """Position of the last take-off in world axes: east, north, up [m]; None if unknown."""
        newest = self._state.newest
        return None if newest is None else newest.start_position_m

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` has been called."""
        return self._connection.why_closed != ""

    @property
    def stats(self) -> dict[str, ChannelStats]:
        """Statistics by channel: ``command``, ``feedback``, ``video/<camera>``, ``results/<processor>``.

        While :meth:`on_command` has a callback, the delay of ``command`` is measured from the echoes of this
        application's own commands. Otherwise, it covers all pilots and is requested from the proxy (up to 0.2 s).
        """
        found = self._state.stats(self._commands.sends)
        uncertainty_s = self.clock_uncertainty_ns / 1e9
        found = {name: replace(stats, uncertainty_s=uncertainty_s) for name, stats in found.items()}
        if found["command"].delay_s is None and self._connection.connected and not self._connection.receiving:
            found["command"] = replace(found["command"], delay_s=_delay(self._proxy_statistics()))
        return found

    def recent_events(self) -> list[Event]:
        """Return the last 256 events, oldest first."""
        return list(self._state.recent)

    def on_takeover(self, function: Callable[[TakeoverRequest], TakeoverAnswer]) -> Listener[Event]:
        """Call ``function`` when another application requests the authority that this application holds.

        Args:
            function: Called in its own thread. It returns True to hand over the authority, False or a reason (a
                string) to decline, or None to leave the decision to the proxy. In any case, an application with a
                strictly higher priority wins after the proxy's ``authority.ask_s``.

        Raises:
            UsageError: If ``function`` is not callable.
            ClosedError: If the drone was closed.
        """
        return self.on_event(answering(function, lambda: self.app_id, self._commands.answer))

    # Authority and commands --------------------------------------------------------------------------------------

    @property
    def authority(self) -> AuthorityStatus:
        """Current status of this application's authority."""
        return self._commands.status

    def request_authority(
        self,
        priority: int | None = None,
        *,
        wait_s: float = 0.0,
        for_s: float | None = None,
        takeover: TakeoverWay = "now",
        stay: bool = False,
    ) -> AuthorityStatus:
        """Request the authority and wait for it.

        By default, a holder of lower priority is pre-empted immediately. With ``takeover="ask"``, the holder is asked
        first. A holder of lower priority is pre-empted when it agrees or after the proxy's ``authority.ask_s``. A
        holder of the same or higher priority may decline. Once granted, the authority is kept: it is requested again
        after a lost link, and regained after a pre-emption when the other application releases it.

        Args:
            priority: Priority from 0 (highest) to 31 (lowest); None: the priority of the previous request.
            wait_s: Maximum time to wait in the queue [s].
            for_s: How long to hold the authority [s], up to a day; after that, others can acquire it. None: unlimited.
            takeover: ``"now"`` pre-empts a holder of lower priority immediately; ``"ask"`` asks the holder first.
            stay: Whether to remain in the queue after ``wait_s`` instead of raising an error.

        Returns:
            The status: held or, if ``stay`` is True, possibly queued, with the position and the expected waiting time.

        Raises:
            AuthorityError: If the authority is not granted within ``wait_s`` (the message names the holder), if the
                proxy refuses the request, or if this application is only an observer.
            NoAnswerError: If the proxy does not answer the request.
            UsageError: If ``priority``, ``for_s`` or ``takeover`` is out of range.
            ClosedError: If the drone was closed.
        """
        self._connection.check_open()
        request = authority_request(self._commands.status.priority if priority is None else priority, for_s, takeover)
        return self._commands.request(request, wait_s, stay=stay)

    def release_authority(self) -> None:
        """Release the authority or leave the queue, and wait for the proxy's confirmation.

        Does nothing if this application neither holds nor requests the authority.

        Raises:
            NoAnswerError: If the proxy does not answer.
            ClosedError: If the drone was closed.
        """
        self._connection.check_open()
        self._commands.release()

    def command(self, action: AnyAction) -> bool:
        """Make ``action`` the newest set-point. See :class:`Drone` for return values and exceptions."""
        return self._commands.command(checked(action))

    def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Take off, then hover.

        If the vehicle is not ready yet, the take-off is retried twice a second while the call waits. If the call fails,
        for example because of a time-out or Ctrl-C, the take-off is cancelled: the vehicle hovers if it is in the air,
        and otherwise stays on the ground. Without ``wait``, a refused take-off is not retried.

        Args:
            wait: Whether to wait until the vehicle hovers or flies, rather than only send the command.
            timeout_s: Maximum time to wait [s].

        Raises:
            NoAnswerError: If the vehicle does not hover in time; the message gives its state and the reason, if known.
            RefusedError: If the proxy refuses the take-off in the current state; if a failsafe, a lost link, a new
                lease or another command of this application ends it before it takes effect; if the application lands
                the vehicle or stops its motors; or if the vehicle lands or disarms before it hovers, for any reason.
            UnsupportedError: If the vehicle can't take off.
            LinkError: If the link is down and ``wait`` is False; the take-off is not sent later.
            AuthorityError: If this application does not hold the authority, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If called with ``wait`` from an inline callback; nothing is sent in that case.
        """
        self._piloting.complete(Takeoff(), lambda feedback: feedback.state in UP, wait, timeout_s)

    def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land at the current position.

        During the wait, a landing interrupted by a failsafe, a lost link or a lost lease is commanded again. If the
        vehicle's own link breaks, the proxy continues the landing, even if no application is waiting for it.

        Args:
            wait: Whether to wait until the vehicle has landed, rather than only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If the vehicle has not landed in time; the message gives its state and the reason, if known.
            RefusedError: If the proxy refuses the landing in the current state.
            UnsupportedError: If the vehicle can't land.
            LinkError: If the link is down and ``wait`` is False; if possible, the landing is still sent within 0.5 s.
            AuthorityError: If the authority is not held, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If called with ``wait`` from an inline callback; the landing is still commanded.
        """
        self._piloting.complete(Land(), lambda feedback: feedback.state in DOWN, wait, timeout_s)

    def hover(self) -> bool:
        """Stop and hold position. See :class:`Drone` for return values and exceptions."""
        return self._commands.command(Hover())

    def idle(self) -> bool:
        """Keep the authority without changing what the vehicle does."""
        return self._commands.command(Idle())

    @by_name
    def velocity(self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Fly at a velocity given in the levelled body axes, which turn with the yaw but not with roll and pitch.

        See :class:`Drone` for return values and exceptions.

        Args:
            forward: Velocity along x, forward [m/s].
            left: Velocity along y, to the left [m/s].
            up: Velocity along z, up [m/s].
            yaw_rate: Yaw rate, counter-clockwise seen from above [rad/s].
        """
        if not _all_finite(forward, left, up, yaw_rate):
            forward, left = number("forward", forward), number("left", left)
            up, yaw_rate = number("up", up), number("yaw_rate", yaw_rate)
        return self._commands.command(Velocity(forward, left, up, yaw_rate))

    @by_name
    def attitude(self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Hold an attitude while climbing or descending. See :class:`Drone` for return values and exceptions.

        Args:
            roll: Roll [rad]; right side down is positive and accelerates the vehicle to the right.
            pitch: Pitch [rad]; nose down is positive and accelerates the vehicle forward.
            climb: Vertical velocity, up positive [m/s].
            yaw_rate: Yaw rate, counter-clockwise seen from above [rad/s].
        """
        if not _all_finite(roll, pitch, climb, yaw_rate):
            roll, pitch = number("roll", roll), number("pitch", pitch)
            climb, yaw_rate = number("climb", climb), number("yaw_rate", yaw_rate)
        return self._commands.command(Attitude(roll, pitch, climb, yaw_rate))

    @by_name
    def go_to(
        self,
        *,
        x: float | None = None,
        y: float | None = None,
        z: float | None = None,
        latitude_deg: float | None = None,
        longitude_deg: float | None = None,
        altitude_m: float | None = None,
        yaw: float | None = None,
        speed: float | None = None,
        wait: bool = True,
        timeout_s: float = 60.0,
        tolerance_m: float = 0.2,
        tolerance_rad: float = 0.15,
    ) -> None:
        """Fly straight to a position and hold it.

        The world axes are the same as for ``Feedback.position_m``. If the vehicle knows its geographic position
        (``Feedback.origin``), you can give latitude and longitude instead; this call converts them. ArduPilot and PX4
        fly to the position natively; for other vehicles, the proxy sends velocities. Unlike a velocity, a position does
        not decay when the application stops sending: the vehicle stops there. The vehicle holds the position until the
        next command, even after a time-out; after Ctrl-C or a cancelled task, it hovers. It does not avoid obstacles.

        Args:
            x: Distance east of the origin [m].
            y: Distance north of the origin [m].
            z: Height above the origin [m].
            latitude_deg: Latitude [°], north positive; used instead of x, y and z.
            longitude_deg: Longitude [°], east positive.
            altitude_m: Altitude above mean sea level [m]; None: the current height.
            yaw: Yaw to turn to during the flight, counter-clockwise from x [rad]; None: keep the current yaw.
            speed: Maximum speed [m/s], within ``limits.speed`` and ``limits.climb``; None: these limits only.
            wait: Whether to wait until the vehicle has arrived and is nearly at rest, or only send the command.
            timeout_s: How long to wait [s].
            tolerance_m: Maximum distance from the position on arrival [m].
            tolerance_rad: Maximum deviation from ``yaw`` on arrival [rad].

        Raises:
            NoAnswerError: If the vehicle has not arrived in time; the message gives its state and the reason, if known.
            RefusedError: If the proxy refuses the flight, for example because the vehicle's position is unknown, the
                target is outside the safety box or in a no-fly zone, or a zone is in the way; or if a failsafe or
                another command ends the flight. Also if latitude and longitude are given but the vehicle's are unknown.
            UnsupportedError: If neither the vehicle nor its proxy can fly to a position.
            LinkError: If the link is down and ``wait`` is False; the command is not sent later.
            AuthorityError: If the authority is not held, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If a number is invalid, or if called with ``wait`` from an inline callback; nothing is sent.
        """
        newest = self._state.newest
        age_s = math.inf if newest is None else self.age_s(newest)
        local = in_world_axes((x, y, z), (latitude_deg, longitude_deg, altitude_m), newest, age_s)
        place = position_action(*local, yaw, speed)
        near_m, near_rad = above_zero("tolerance_m", tolerance_m), above_zero("tolerance_rad", tolerance_rad)
        self._piloting.complete(place, lambda feedback: is_there(place, feedback, near_m, near_rad), wait, timeout_s)

    def return_to_start(
        self, height_m: float | None = None, *, land: bool | None = None, wait: bool = True, timeout_s: float = 180.0
    ) -> None:
        """Fly back to where the vehicle took off, and then land or hover.

        If the vehicle is below a safe height, it first climbs straight up, within ``limits.altitude``, the ceiling of
        the room and the top of the safety box. It then flies straight to a point above its start
        (:attr:`start_position`), as :meth:`go_to` does, and lands or hovers there. Any other command, another pilot or
        a failsafe ends the flight. The vehicle does not avoid obstacles.

        Args:
            height_m: Minimum height above the start during the flight [m]; None: the parameter ``return.height``.
            land: Whether to land at the start instead of hovering above it; None: the parameter ``return.land``.
            wait: Whether to wait until the vehicle has landed or hovers above its start, or only send the command.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If the flight does not end in time; the message gives the vehicle's state and a known reason.
            RefusedError: If the proxy refuses the flight, for example because the position or start is unknown, the
                vehicle is not flying, or a no-fly zone is in the way; or if a failsafe or another command ends it.
            UnsupportedError: If neither the vehicle nor its proxy can fly to a position.
            LinkError: If the link is down and ``wait`` is False; the command is not sent later.
            AuthorityError: If the authority is not held, or another application takes it over.
            ClosedError: If the drone is closed.
            UsageError: If an argument is invalid, or if called with ``wait`` from an inline callback; nothing is sent.
        """
        self._piloting.complete(return_action(height_m, land), ReturnWatch(), wait, timeout_s)

    def emergency_stop(self) -> bool:
        """Cut the motors immediately: the vehicle falls.

        Requires ``access="pilot"`` but not the authority. The stop is sent immediately and repeated until the vehicle
        confirms it (``FlightState.EMERGENCY``). After 8 s it is abandoned with an event (``vehicle_message``, reason
        ``stop_given_up``). Until then, this connection sends nothing else: :meth:`velocity`, :meth:`hover` and similar
        methods return False; :meth:`takeoff` and :meth:`land` raise :class:`RefusedError`. A program with several
        connections must stop sending on the others itself. A stop not sent within 2 s is dropped.

        Returns:
            False if the link is down and the stop can't be sent immediately.

        Raises:
            AuthorityError: If this application is only an observer.
            UnsupportedError: If the vehicle can't stop its motors, or accepts no commands.
            ClosedError: If the drone was closed.
        """
        return self._commands.command(EmergencyStop())

    def reset_emergency(self) -> bool:
        """Leave the emergency state while on the ground.

        If the vehicle has not yet confirmed this application's stop, the reset is sent once it has, within 2 s.
        """
        return self._commands.command(ResetEmergency())

    def send_external_pose(
        self,
        position: Vector,
        quaternion: tuple[float, float, float, float],
        *,
        at_ns: int | None = None,
        position_std_m: float | None = None,
        attitude_std_rad: float | None = None,
    ) -> bool:
        """Send the vehicle its own externally measured pose, for an autopilot that uses it instead of GPS.

        Thread-safe; returns immediately. Requires no authority. Refusals cause events (``command_refused``).

        Args:
            position: Position [m]: x east, y north, z up.
            quaternion: Rotation from body axes (x forward, y left, z up) to world axes, as x, y, z, w.
            at_ns: Time of the measurement, on the proxy's clock [ns]; None: now.
            position_std_m: Standard deviation of the position [m], if known.
            attitude_std_rad: Standard deviation of the attitude [rad], if known.

        Returns:
            True if the pose was handed to the transport.

        Raises:
            AuthorityError: If this application only observes.
            UsageError: If a number is missing or not finite, if a standard deviation is negative, if the quaternion's
                length differs from 1 by more than 0.001, or if ``at_ns`` is out of range.
        """
        if self._commands.role is not Role.PILOT:
            text = 'send_external_pose: this application only observes; connect with access="pilot"'
            raise AuthorityError(text, code="observer")
        check_pose(position, quaternion, position_std_m, attitude_std_rad)
        known_ns = self.now_ns if at_ns is None else checked_time(at_ns)
        pose = VehiclePose(known_ns, position, quaternion, position_std_m, attitude_std_rad)
        return self._connection.transmit(encode(pose))

    # Reading ---------------------------------------------------------------------------------------------------

    def feedback(self, *, max_age_s: float | None = None, max_hz: float | None = None) -> Feedback:
        """Return the newest feedback.

        An observer receives only as much data as its consumers need; if any of them sets no limit, it receives every
        sample. The first call of this method adds a permanent consumer. A pilot always receives everything.

        Args:
            max_age_s: Maximum age since capture [s]; None: no limit.
            max_hz: Maximum rate of new samples, 0.001 to 1000 Hz; None: no limit.

        Raises:
            NoAnswerError: If there is no feedback yet, or if the newest sample is older than ``max_age_s``.
            ClosedError: If the drone was closed.
            UsageError: If ``max_hz`` is out of range.
        """
        self._connection.check_open()
        self._state.demand.keep(_feedback_request(max_hz))
        newest = self._state.newest
        if newest is None:
            raise NoAnswerError("no feedback has arrived yet")
        if max_age_s is not None:
            age_s = self.age_s(newest)
            if age_s > max_age_s:
                raise NoAnswerError(f"the newest feedback is {age_s:.3f} s old, {max_age_s:g} s were allowed")
        self._read = newest
        return newest

    def overview(self, timeout_s: float = 2.0) -> Overview:
        """Return the newest overview of all vehicles in the proxy's process, which has one row per vehicle.

        Overviews arrive once a second and are much smaller than feedback, and therefore suit applications that watch
        many vehicles. The first call subscribes permanently and waits for the first overview.

        Args:
            timeout_s: How long to wait for the first overview [s].

        Raises:
            NoAnswerError: If no overview arrives in time, for example because the proxy is too old to send one.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback before the first overview has arrived.
        """
        self._connection.check_open()
        state = self._state
        if state.overview is None:
            self._connection.check_may_wait()
            state.on_overview.keep()
            state.notifier.wait_for(lambda: state.overview is not None or self.closed, timeout_s)
            self._connection.check_open()
        state.on_overview.keep()
        if state.overview is None:
            raise NoAnswerError(f"no overview arrived within {timeout_s:g} s: older proxies send none")
        return state.overview

    def age_s(self, sample: Feedback | Frame) -> float:
        """Return the time since a sample was captured [s]; the maximum error is ``clock_uncertainty_ns``."""
        return (self.now_ns - sample.captured_ns) / 1e9

    def next_feedback(self, timeout_s: float = 1.0, *, max_hz: float | None = None) -> Feedback:
        """Wait for feedback that has not been read yet, and return the newest sample.

        Args:
            timeout_s: How long to wait [s].
            max_hz: As for :meth:`feedback`; may also return samples that other consumers requested.

        Raises:
            NoAnswerError: If no feedback arrives in time.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback, or an option is out of range.
        """
        self._connection.check_open()
        self._connection.check_may_wait()
        state = self._state
        state.demand.keep(_feedback_request(max_hz))
        if not state.notifier.wait_for(lambda: state.newest is not self._read or self.closed, timeout_s):
            link = self._connection.state.value
            raise NoAnswerError(f"no feedback arrived within {timeout_s:g} s: the link is {link}")
        return self.feedback(max_hz=max_hz)

    def frame(self, camera: str | None = None, *, max_age_s: float | None = None) -> Frame | None:
        """Return the newest frame without waiting. The first call subscribes to the camera permanently.

        Args:
            camera: Name of the camera; None: the vehicle's first camera.
            max_age_s: Maximum age since capture [s]; None: no limit.

        Returns:
            The frame; None if no frame has arrived yet, or if it is too old or can't be decoded.

        Raises:
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
        channel = self._state.video.channel(camera)
        channel.keep()
        arrival = channel.newest
        if arrival is None or (max_age_s is not None and arrival.age_s > max_age_s):
            return None
        return channel.picture(arrival)

    def next_frame(self, camera: str | None = None, *, timeout_s: float = 1.0) -> Frame:
        """Wait for a frame that this method has not returned yet, then return the newest one.

        The first call subscribes to the camera permanently.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            timeout_s: How long to wait [s].

        Raises:
            NoAnswerError: If no frame arrives in time.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
        deadline = time.monotonic() + timeout_s
        waited_s = 0.0  # a stepped replay skips the waiting time at once
        while True:
            # Look up the channel each time, because the proxy may have restarted with a different camera.
            channel = self._state.video.channel(camera)
            channel.keep()
            self._connection.check_may_wait()
            left_s = min(_CAMERA_CHECK_S, deadline - time.monotonic(), timeout_s - waited_s)
            while channel.notifier.wait_for(lambda: channel.unread or self.closed, left_s):  # noqa: B023
                self._connection.check_open()
                frame = channel.read()
                if frame is not None:
                    return frame
            waited_s += left_s
            if time.monotonic() >= deadline or waited_s >= timeout_s:
                raise self._state.no_frame(channel.camera.name, timeout_s)

    def frames(
        self, camera: str | None = None, *, timeout_s: float = 5.0, **how: Unpack[VideoOptions]
    ) -> Iterator[Frame]:
        """Yield the newest frame repeatedly until the drone is closed; a slow loop skips frames.

        The first iteration raises the errors; the call itself does not.

        Args:
            camera: Name of the camera; None: the vehicle's first.
            timeout_s: How long to wait for each frame [s].
            **how: ``max_fps``: maximum number of frames per second. ``scale``: factor for width and height, above 0, at
                most 1. ``part``: (k, n) for only every n-th frame, which lets n workers, numbered by k from 0, share
                the frames. ``encoding``: how frames are sent over a network: ``"jpeg"`` (``quality`` 1 to 100, default
                80), ``"h264"`` (``kbit_s`` kilobits per second; by default the rate that the network path can carry,
                with smaller and fewer frames if that rate is low) or ``"raw"``; within one host, all frames are raw.
                ``max_age_s``: frames older than this on delivery are skipped and counted as dropped.

        Raises:
            NoAnswerError: If no frame arrives within ``timeout_s``.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            UsageError: If an option is out of range, or if called from an inline callback.
            ClosedError: If the drone was already closed.
        """
        channel = self._state.follow(lambda: self._state.video.channel(camera, **how))
        mailbox: Mailbox[ReceivedFrame] = Mailbox(notifier=self._state.sample_notifier())
        self._connection.check_may_wait()
        max_age_s, deadline = how.get("max_age_s"), time.monotonic() + timeout_s
        with self._state.closing(mailbox), channel.into(mailbox):
            while not self.closed:
                arrival = mailbox.wait(max(0.0, deadline - time.monotonic()))
                if arrival is not None:
                    frame = channel.current.picture(arrival, max_age_s)
                    if frame is not None:
                        yield frame
                        deadline = time.monotonic() + timeout_s
                elif not mailbox.closed:
                    raise self._state.no_frame(channel.current.camera.name, timeout_s)

    def wait(self, state: Wanted, timeout_s: float = 10.0) -> Feedback:
        """Wait until the newest feedback meets a condition.

        Args:
            state: A flight state or its name, several of them, or a function that tests feedback on this thread.
            timeout_s: How long to wait [s].

        Returns:
            The feedback that met the condition.

        Raises:
            NoAnswerError: If no feedback meets it in time; the message gives the current state.
            UnknownNameError: If no flight state has this name.
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
        self._connection.check_open()
        self._connection.check_may_wait()
        wanted, what = as_predicate(state)
        met: list[Feedback] = []

        def is_met() -> bool:
            newest = self._state.newest
            if newest is not None and wanted(newest):
                met.append(newest)
            return bool(met) or self.closed

        with self._state.demand.wanted(EVERY_SAMPLE):
            in_time = self._state.notifier.wait_for(is_met, timeout_s)
        if not in_time:
            newest = self._state.newest
            now = "its state is unknown" if newest is None else f"it is {newest.state.value}"
            raise NoAnswerError(f"the vehicle was not {what} within {timeout_s:g} s: {now}")
        if not met:
            raise ClosedError("this drone was closed")
        return met[0]

    # Callbacks -------------------------------------------------------------------------------------------------

    def on_feedback(
        self, function: Callable[[Feedback], object], *, inline: bool = False, max_hz: float | None = None
    ) -> Listener[Feedback]:
        """Call ``function`` with the newest feedback.

        Like every ``on_...`` method, it returns a :class:`Listener`; the listener's ``cancel()`` ends the calls. It
        raises :class:`UsageError` if ``function`` is not callable and :class:`ClosedError` if the drone was closed.

        Args:
            function: Called in its own thread; samples replaced by newer ones are dropped and counted.
            inline: Whether to call it on the receiving thread instead, with every sample. It must not wait.
            max_hz: Maximum rate of samples, 0.001 to 1000 Hz; None: no limit. An observer receives no more than that
                unless another consumer requests more.
        """
        channel = self._state.feedback_channel(_feedback_request(max_hz))
        return self._listen(channel, function, "feedback", inline=inline)

    def on_overview(self, function: Callable[[Overview], object], *, inline: bool = False) -> Listener[Overview]:
        """Call ``function`` once a second with an overview of all vehicles in the proxy's process (:meth:`overview`).

        It runs in its own thread or, with ``inline``, on the receiving thread.
        """
        return self._listen(self._state.on_overview, function, "overview", inline=inline)

    def on_event(self, function: Callable[[Event], object], *, inline: bool = False) -> Listener[Event]:
        """Call ``function`` with each event, including the client's own (number 0).

        Args:
            function: Called in its own thread; at most 256 events wait for it.
            inline: Whether to call it on the receiving thread instead. The client's own events are then delivered on
                the thread that emits them.
        """
        return self._listen(self._state.on_event, function, "event", depth=EVENT_DEPTH, inline=inline)

    def on_link(self, function: Callable[[LinkStatus], object]) -> Listener[LinkStatus]:
        """Call ``function`` in its own thread whenever one of the two links changes state; up to 256 changes wait."""
        return self._listen(self._state.on_link, function, "link", depth=EVENT_DEPTH)

    def on_command(self, function: Callable[[Applied], object], *, inline: bool = False) -> Listener[Applied]:
        """Call ``function`` with the proxy's echo of every command from any application; up to 256 echoes may wait.

        It runs in its own thread or, with ``inline``, on the receiving thread.
        """
        return self._listen(self._state.on_command, function, "command", depth=EVENT_DEPTH, inline=inline)

    def on_annotation(self, function: Callable[[Annotation], object], *, inline: bool = False) -> Listener[Annotation]:
        """Call ``function`` with the annotations that applications draw on frames; up to 256 annotations may wait.

        It runs in its own thread or, with ``inline``, on the receiving thread.
        """
        return self._listen(self._state.on_annotation, function, "annotation", depth=EVENT_DEPTH, inline=inline)

    def on_log(self, function: Callable[[LogEntry], object], *, inline: bool = False) -> Listener[LogEntry]:
        """Call ``function`` with all applications' log entries (``drone.log``), including our own; up to 256 wait.

        It runs in its own thread or, with ``inline``, on the receiving thread.
        """
        return self._listen(self._state.on_log, function, "log", depth=EVENT_DEPTH, inline=inline)

    def on_frame(
        self,
        function: Callable[[Frame], object],
        camera: str | None = None,
        *,
        depth: int = 1,
        inline: bool = False,
        **how: Unpack[VideoOptions],
    ) -> Listener[ReceivedFrame]:
        """Call ``function`` with the newest frame of a camera.

        Args:
            function: Called in its own thread with frames that it has not seen yet.
            camera: Name of the camera; None: the vehicle's first camera, whichever it is after a restart.
            depth: How many frames may wait, at least 1; older ones are dropped and counted.
            inline: Whether to call it on the receiving thread instead, with every frame. It must be quick and not wait.
            **how: As for :meth:`frames`.

        Raises:
            UsageError: If ``function`` is not callable or an option is out of range.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
        self._check_listener(function)
        channel = self._state.follow(lambda: self._state.video.channel(camera, **how))
        max_age_s = how.get("max_age_s")

        def call(arrival: ReceivedFrame) -> None:
            frame = channel.current.picture(arrival, max_age_s)
            if frame is not None:
                function(frame)

        return self._listen(channel, call, f"frames of {channel.current.camera.name}", depth=depth, inline=inline)

    def on_encoded(
        self,
        function: Callable[[EncodedFrame], object],
        camera: str | None = None,
        *,
        kbit_s: int | None = None,
        max_fps: float | None = None,
        scale: float = 1.0,
        depth: int = 30,
        inline: bool = False,
    ) -> Listener[EncodedFrame]:
        """Call ``function`` with a camera's encoded frames, to store or forward them.

        Each frame is an H.264 access unit in Annex B format that can be decoded after its predecessors. The first one
        is a key frame. After a loss, the client requests a key frame from the proxy and delivers it next. Without
        ``kbit_s``, ``max_fps`` and ``scale``, frames arrive as the vehicle encoded them. If the vehicle doesn't send
        H.264, the proxy encodes them at the rate that the network path can carry.

        Args:
            function: Called in its own thread.
            camera: Name of the camera; None: the vehicle's first.
            kbit_s: Bit rate at which the proxy encodes [kbit/s]; clients with the same request share one encoder.
            max_fps: Maximum number of frames per second; None: no limit.
            scale: Factor for width and height, greater than 0 and at most 1.
            depth: How many frames may wait, at least 1; any further frames are lost.
            inline: Call it on the receiving thread instead. It must be quick and must not wait.

        Raises:
            UsageError: If ``function`` is not callable or an option is out of range.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If the vehicle has no camera.
            ClosedError: If the drone was closed.
        """
        self._check_listener(function)

        def find() -> StreamChannel:
            video = self._state.video
            info = video.channel(camera).camera
            as_it_came = bool(info.stream) and kbit_s is None and max_fps is None and scale == 1.0
            subscriber = "" if as_it_came or kbit_s is not None else f"{video.subscriber}-encoded"
            return video.stream(info.name, kbit_s=kbit_s, max_fps=max_fps, scale=scale, subscriber=subscriber)

        stream, chain = self._state.follow(find), Chain()

        def call(picture: EncodedFrame) -> None:
            follows = chain.follows(picture.seq, key=picture.key)
            stream.current.report(picture.seq, wants_key=not follows)
            if follows:
                function(picture)

        return self._listen(stream, call, f"encoded frames of {camera or 'the camera'}", depth=depth, inline=inline)

    def annotate(self, frame: Frame, shapes: Iterable[Shape], source: str | None = None) -> bool:
        """Publish shapes drawn over a frame, for the cockpit and for recordings.

        Args:
            frame: The frame on which the shapes are drawn.
            shapes: Shapes in pixels of this frame; coordinates may be NumPy numbers.
            source: Name of the component that drew the shapes; None: this application. For each source and camera, new
                shapes replace the earlier ones.

        Returns:
            True if the shapes were handed to the transport.

        Raises:
            UsageError: If an item is not a shape, there are too many, coordinates are not finite, or colours are not
                within 0 to 255.
        """
        height, width = frame.shape[:2]
        fields = (source or self._state.app, frame.camera, frame.captured_ns, width, height, tuple(shapes))
        try:
            annotation = msgspec.convert(msgspec.to_builtins(fields, enc_hook=_from_numpy), Annotation)
            packet = encode(annotation)
        except (msgspec.ValidationError, TypeError, ValueError) as error:
            raise UsageError(f"this can't be drawn on a frame: {error}") from None
        return self._connection.transmit(packet)

    def emit(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: str) -> None:
        """Emit an event (number 0), only to this application's own callbacks.

        Args:
            kind: Kind of the event.
            text: Human-readable text.
            severity: Severity of the event.
            **data: Details, by name.
        """
        self._state.emit(kind, text, severity, **data)

    # Results of processors ---------------------------------------------------------------------------------------

    def result(self, processor: str, *, max_age_s: float | None = None) -> Result | None:
        """Return a processor's newest result without waiting. The first call subscribes to the processor permanently.

        Args:
            processor: Name of the processor.
            max_age_s: Maximum age since the frame's capture [s]; None: no limit.

        Returns:
            The result; None if no result has arrived yet or the newest one is too old.

        Raises:
            UsageError: If ``processor`` is not a valid name or ``max_age_s`` is negative.
            ClosedError: If the drone was closed.
        """
        checked_age(max_age_s)
        channel = self._state.results.channel(processor)
        channel.keep()
        newest = channel.newest
        return None if newest is None or is_old(newest, max_age_s) else newest

    def results(self, processor: str, *, max_age_s: float | None = None, timeout_s: float = 5.0) -> Iterator[Result]:
        """Yield a processor's newest result repeatedly until the drone is closed.

        A slow loop skips results; :attr:`stats` counts them and results that are too old. The first iteration raises
        the errors, not the call itself.

        Args:
            processor: Name of the processor.
            max_age_s: Maximum age since the frame's capture [s]; None: any.
            timeout_s: How long to wait for each result [s].

        Raises:
            NoAnswerError: If no result that is new enough arrives in time.
            UsageError: If ``processor`` is invalid or ``max_age_s`` is negative, or if called from an inline callback.
            ClosedError: If the drone was already closed.
        """
        mailbox = ResultMailbox(checked_age(max_age_s), self._state.scheduler.notifier())
        channel = self._state.results.channel(processor)
        self._connection.check_may_wait()
        with self._state.closing(mailbox), channel.into(mailbox):
            while not self.closed:
                result = mailbox.wait(timeout_s)
                if result is not None:
                    yield result
                elif not mailbox.closed:
                    raise NoAnswerError(silence(processor, timeout_s, mailbox.expired))

    def on_result(
        self,
        function: Callable[[Result], object],
        processor: str | None = None,
        *,
        max_age_s: float | None = None,
        depth: int | None = None,
        inline: bool = False,
    ) -> ResultListener:
        """Call ``function`` with the results of one processor or of all processors.

        Args:
            function: Called in its own thread.
            processor: Name of the processor; None: all processors.
            max_age_s: Maximum age [s]. Results that are older when they would be delivered are skipped and counted in
                the listener's ``expired``. None: no limit.
            depth: How many results may wait, at least 1; None: 1 for a single processor, 256 for all processors.
            inline: Call it on the receiving thread instead. It must be quick and must not wait.

        Raises:
            UsageError: If ``function`` is not callable or another argument is out of range.
            ClosedError: If the drone was closed.
        """
        known, make = self._state.results, partial(ResultListener, max_age_s=checked_age(max_age_s))
        if processor is None:
            channel, name, usual = known.everything, "results", EVENT_DEPTH
        else:
            channel, name, usual = known.channel(processor), f"results of {processor}", 1
        depth = usual if depth is None else depth
        listener = self._listen(channel, function, name, depth=depth, inline=inline, make=make)
        assert isinstance(listener, ResultListener)
        return listener

    # The end ---------------------------------------------------------------------------------------------------

    def preflight(self, *, video_s: float = 1.5, folder: str | Path | None = None) -> list[PreflightFinding]:
        """Run the pre-flight checklist; each problem found has a reason and a remedy.

        Reads the proxy's parameters and requests one image from each camera. Neither flies nor requires the authority.

        Args:
            video_s: Total time to wait for frames [s]; 0 skips the camera check.
            folder: Folder for recordings, whose free space is checked; None skips this check.

        Raises:
            ClosedError: If the drone is closed.
            UsageError: If called from an inline callback.
        """
        self._connection.check_open()
        self._connection.check_may_wait()
        state = self._state
        before = None if state.demand.request.is_plain else state.newest
        with state.demand.wanted(EVERY_SAMPLE):
            if before is not None:  # if a reduced rate was requested, wait for a complete sample
                state.notifier.wait_for(lambda: state.newest is not before, WHOLE_S)
            return inspect(self, state.newest, video_s, folder)

    def close(self) -> None:
        """Release the authority, then end the connection, all threads and the private proxy, if any.

        Does not land, but a private proxy lands a flying vehicle before it ends. Idempotent. Threads that wait on this
        drone get :class:`ClosedError`.
        """
        if self.closed:
            return
        self._piloting.finish_stop()
        self._connection.why_closed = "this drone was closed: connect again"
        self._commands.notifier.notify()  # from here on, no thread can acquire the authority
        try:
            if self._connection.connected:
                self._commands.release(wait=not self._connection.receiving)
        except LinkError:
            pass  # the link is already lost, and the authority with it
        finally:
            self._supervisor.close()
            listeners = list(self._state.listeners)
            for listener in listeners:
                listener.cancel(wait=False)
            deadline_s = time.monotonic() + JOIN_S  # all of them share the time limit
            for listener in listeners:
                listener.join(max(0.0, deadline_s - time.monotonic()))
            for close in list(self._state.to_close):
                close()
            self._state.wake_all()
            if self._on_close is not None:
                self._on_close()

    def __enter__(self) -> Self:
        self._connection.check_open()
        return self

    def __exit__(self, *_: object) -> None:
        problem = self._piloting.end_flight()
        if problem is not None:
            _log.warning("%s could not be left properly: %s", self.name, problem)

    def __repr__(self) -> str:
        return f"<Drone {self.name or '?'} ({self._connection.state.value}, authority {self.authority.state})>"

    # Inside ------------------------------------------------------------------------------------------------------

    def _proxy_statistics(self) -> Statistics | None:
        try:
            answer = self._connection.call(GetStatistics, 0.2)
        except LinkError:
            return None
        return answer if isinstance(answer, Statistics) else None

    def _listen(
        self,
        channel: Channel[T],
        function: Callable[[T], object],
        name: str,
        *,
        depth: int = 1,
        inline: bool = False,
        make: Callable[..., Listener[T]] = Listener,
    ) -> Listener[T]:
        self._check_listener(function)
        if depth < 1:
            raise UsageError(f"depth is {depth!r} and must be at least 1")
        state, report = self._state, self._piloting.report
        inline = inline or state.scheduler.in_step
        listener = make(function, channel, report, name=name, depth=depth, inline=inline, on_cancel=state.forget)
        self._state.listeners.append(listener)
        return listener

    def _check_listener(self, function: Callable[[Any], object]) -> None:
        self._connection.check_open()
        if not callable(function):
            raise UsageError(f"{function!r:.80} can't be called: expected a function with one argument")


def open_drone(
    dial: Dialer,
    *,
    app: str,
    timeout_s: float = 5.0,
    authority: Authority | None = None,
    **options: Unpack[DroneOptions],
) -> Drone:
    """Connect through a dialer, and reconnect after each loss; applications call :func:`skyloop.connect`.

    ``app``: the application's name, 1 to 64 characters. See :func:`connect` and :class:`DroneOptions` for the rest.
    """
    drone = Drone(dial, app=app, **options)
    drone._connect(timeout_s=timeout_s, authority=authority)
    return drone


def _feedback_request(max_hz: float | None) -> FeedbackRequest:
    return EVERY_SAMPLE if max_hz is None else FeedbackRequest(max_hz)


def _from_numpy(value: Any) -> Any:
    """Convert NumPy scalars and arrays to plain numbers and lists."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is neither a shape nor a number")


def _delay(statistics: Statistics | None) -> Distribution | None:
    """Return the delay from sending to applying that the proxy measured; None if there is no measurement."""
    counters = {} if statistics is None else statistics.counters
    count = int(counters.get("commands.delay.count", 0))
    if not count:
        return None
    median = counters.get("commands.delay.median_s", 0.0)
    p99, most, mean = (counters.get(f"commands.delay.{name}_s", median) for name in ("p99", "max", "mean"))
    return Distribution(median, p99, most, mean, count)
