"""What a drone is made of, and what Skyloop's own packages do with it; applications use :class:`Drone`."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Final, Literal, Protocol, TypedDict, Unpack

from skyloop.child_process import leave_to_parent
from skyloop.client.actions import ActionWait
from skyloop.client.authority import Authority, AuthorityTracker, EndedSessions, authority_request
from skyloop.client.channels import JOIN_S, C, FollowingChannel, Listener, checked_age, checked_name
from skyloop.client.command_schedule import CommandSchedule
from skyloop.client.commands import LANDING, CommandSender, GivenUpError, cancelled
from skyloop.client.connection import ConnectionSupervisor, ProxyConnection, RedialPolicy, Scheduler
from skyloop.client.parameters import Config, Restorer
from skyloop.client.publishing import Logbook, Membership
from skyloop.client.results import ResultChannel
from skyloop.client.telemetry import ClientState, Mailboxes, Receiver
from skyloop.client.video import StreamChannel, StreamOptions, VideoChannel, VideoOptions
from skyloop.errors import (
    ClosedError,
    LinkError,
    NoAnswerError,
    RefusedError,
    SkyloopError,
    UsageError,
)
from skyloop.messages import (
    AnyAction,
    EventKind,
    Failsafe,
    Feedback,
    FlightState,
    Hello,
    Hover,
    Idle,
    Land,
    LinkState,
    ReturnPhase,
    Role,
    Severity,
    Takeoff,
)
from skyloop.messages.relayed import MAX_CODE
from skyloop.transport.base import EVENTS, Dialer

Access = Literal["pilot", "observe"]
OnExit = Literal["land", "hover"]
UP: Final = frozenset({FlightState.HOVERING, FlightState.FLYING})
STOP_S: Final = 2.0  #: how long closing waits for an emergency stop to show
DOWN: Final = frozenset({FlightState.LANDED})
_ENDED: Final = EndedSessions()  #: of all drones of this process
LANDING_S: Final = 20.0  #: how long a landing is waited for
OTHERS_S: Final = 1.0  #: within which feedback says who took a vehicle whose landing was refused
RETURN_S: Final = 180.0  #: how long a return that the proxy began is waited for
_ENDED_IN: Final = (FlightState.LANDED, FlightState.EMERGENCY)
_SINKING: Final = (*_ENDED_IN, FlightState.LANDING)
_SOON_S: Final = 1.0  #: a vehicle that still wakes up then is waited for audibly
_log = logging.getLogger("skyloop")


def _silent(step: str) -> None:
    """Report nothing."""


class Closable(Protocol):
    """What ends with the drone."""

    def close(self) -> None: ...


class DroneOptions(TypedDict, total=False):
    """Options of a :class:`DroneCore`, as it documents them."""

    access: Access
    rate_hz: float
    stall_s: float
    on_exit: OnExit
    policy: RedialPolicy | None
    scheduler: Scheduler | None
    on_close: Callable[[], None] | None
    reach: str | None


class InboxOptions(TypedDict, total=False):
    """What one thread waits for."""

    feedback: bool  #: whether feedback is wanted; True if left out
    frames: bool  #: whether frames are wanted; True if left out
    camera: str | None  #: name of the camera; None: the vehicle's first
    results: bool  #: whether results of processors are wanted
    processors: Iterable[str] | None  #: names of the processors whose results are wanted; None: all
    max_age_s: float | None  #: oldest age of a result that is accepted [s]; None: any


class DroneCore:
    """The parts of one drone, wired, with its beginning and its end. May be used from any thread.

    It is the client's own: other packages use :mod:`skyloop.extend`.
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
        """Prepare a drone without connecting; :meth:`open` connects.

        Args:
            dial: Makes a connection to the proxy each time one is needed.
            app: Name of this application, 1 to 64 characters.
            access: ``"pilot"`` may command, ``"observe"`` only reads.
            rate_hz: Rate at which commands are repeated, 1 to 200 Hz.
            stall_s: Time without a call after which a velocity or attitude decays to hover [s]; ``math.inf``: never.
            on_exit: What an airborne vehicle does at the end of the block, ``"land"`` or ``"hover"``.
            policy: When to reconnect and when a link counts as lost.
            scheduler: Source of the time and of waiting; None: real time.
            on_close: Called at the end of :meth:`close`, on the closing thread.
            reach: Name or address under which another process reaches the same vehicle; None if none can.

        Raises:
            UsageError: If ``access``, ``on_exit``, ``app``, ``rate_hz`` or ``stall_s`` is out of range.
        """
        if access not in ("pilot", "observe"):
            raise UsageError(f'access is {access!r} and must be "pilot" or "observe"')
        if on_exit not in ("land", "hover"):
            raise UsageError(f'on_exit is {on_exit!r} and must be "land" or "hover"')
        if not 1 <= len(app) <= 64:
            raise UsageError(f"an application's name has 1 to 64 characters, not {len(app)}: {app!r:.80}")
        scheduler = scheduler or Scheduler()
        self.app = app
        self.role = Role.PILOT if access == "pilot" else Role.OBSERVER
        self.reach = reach
        self.listeners: list[Listener[Any]] = []
        self._end = threading.Lock()  # one end of the flight, whoever asks for it
        self._on_exit = on_exit
        self._on_close = on_close
        self._to_close: list[Closable] = []  # what ends with the drone
        # Each part uses those before it; the receiver handles what arrives in every session.
        connection = self.connection = ProxyConnection(scheduler.clock)
        authority = AuthorityTracker(app, _ENDED)
        state = self.state = ClientState(app, connection, scheduler, whole_feedback=access == "pilot")
        restorer = Restorer(connection, state.emit)
        self.config = Config(connection, authority, restorer)
        self.log = Logbook(connection, app)
        self.commands = CommandSender(
            self.role,
            authority,
            CommandSchedule(rate_hz=rate_hz, stall_s=stall_s),
            connection,
            scheduler,
            emit=state.emit,
            changed=state.notifier.notify,
            granted=restorer.granted,
        )
        self.supervisor = ConnectionSupervisor(
            connection,
            Receiver(state, connection, self.commands, restorer),
            dial,
            Hello(app, self.role),
            policy=policy,
            clock=scheduler.clock,
            begin=scheduler.begin,
        )
        connection.subscribe(EVENTS)
        leave_to_parent(self)

    # Beginning and end -------------------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Name of the proxy; empty before the first connection."""
        return "" if self.state.welcome is None else self.state.welcome.proxy

    def open(
        self,
        *,
        timeout_s: float = 5.0,
        authority: Authority | None = None,
        acquire: bool = True,
        wait_for_state: bool = True,
    ) -> None:
        """Connect, then wait for feedback and, as a pilot, for the authority. Closes the drone if anything fails.

        Args:
            timeout_s: Time for the proxy to answer, to send its first feedback and, as a pilot, for the vehicle to
                wake up [s].
            authority: How a pilot asks for the authority; None: ``Authority()``.
            acquire: Whether a pilot asks for the authority now; if False it does so when it wants.
            wait_for_state: Whether to wait for feedback.

        Raises:
            NoAnswerError: If no answer or no feedback comes in time.
            RefusedError: If the proxy refuses the connection.
            AuthorityError: If the authority can't be had.
            LinkError: If the proxy can't be reached.
        """
        try:
            deadline = time.monotonic() + timeout_s
            self.supervisor.start(timeout_s)
            left_s = max(0.1, deadline - time.monotonic())
            if wait_for_state and not self.state.notifier.wait_for(self._known, left_s):
                raise NoAnswerError(f"{self.name} answered, but reported no vehicle state within {timeout_s:g} s")
            if acquire and self.role is Role.PILOT:
                self.check_open()
                asked = authority or Authority()
                self.commands.request(
                    authority_request(asked.priority, asked.for_s, asked.takeover), asked.wait_s, stay=asked.stay
                )
                if wait_for_state and not self.state.scheduler.in_step:
                    self._wait_until_awake(deadline)
            self.state.scheduler.opened()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the authority, then end the connection, all threads and a private proxy. Does not land. Idempotent.

        A private proxy lands what flies. Threads that wait for this drone get :class:`ClosedError`.
        """
        if self.closed:
            return
        self._finish_stop()
        self.commands.close("this drone was closed: connect again")
        try:
            if self.connection.connected:
                self.commands.release(wait=not self.connection.receiving)
        except LinkError:
            pass  # the link is lost already, and the authority with it
        finally:
            self.supervisor.close()
            listeners = list(self.listeners)
            for listener in listeners:
                listener.cancel(wait=False)
            deadline_s = time.monotonic() + JOIN_S  # for all of them
            for listener in listeners:
                listener.join(max(0.0, deadline_s - time.monotonic()))
            for one in list(self._to_close):
                one.close()
            self.state.wake_all()
            if self._on_close is not None:
                self._on_close()

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` was called, or the drone belongs to the parent process."""
        return self.commands.why_closed != ""

    @property
    def ending(self) -> bool:
        """Whether the end of the flight has begun, or it is closed."""
        return self.closed or self.commands.barred

    def forked(self) -> None:
        """Leave the vehicle and the connection to the parent process; in a child made by ``os.fork``."""
        if not self.closed:
            self.commands.why_closed = (
                f"this drone belongs to process {os.getppid()}, of which this one is a fork: connect here as well"
            )
            self.connection.forked()

    def let_go(self, reason: str, *, land: bool = False) -> bool:
        """Hover, or land, because the library finds that it has to: the only place where it does so by itself.

        Nobody decided that, so a vehicle that others fly, that lands or that returns is left alone, here and by the
        proxy, and so is what the application itself has landed or stopped. A take-off that does not show is ended.
        With ``land`` it lands, rather than hovers. Returns whether something was sent.
        """
        commands, feedback, kind = self.commands, self.state.newest, type(self.commands.newest)
        if self.closed or kind in LANDING or (kind is Hover and not land):
            return False
        leave = feedback is None or feedback.others or _returns(feedback)
        if land or (kind is Takeoff and feedback is not None and feedback.state is FlightState.LANDED):
            action: AnyAction = Idle() if leave else Land()
        else:
            action = Idle() if leave or (feedback is not None and feedback.state in _SINKING) else Hover()
        try:
            if commands.status.state != "held":
                commands.drop()
                return False
            sent = commands.send(action, automatic=True)
        except SkyloopError:
            return False
        if type(action) is not Idle:
            _log.info("%s: %s, because %s", self.name, action.name, reason)
        return sent

    def end_flight(self, report: Callable[[str], object] = _silent) -> SkyloopError | None:
        """End the flight: land what this application flies, or hover (see ``on_exit``), then close.

        From its first line on commands of the application's other threads raise :class:`ClosedError`; only an emergency
        stop still passes. Waits until the vehicle has landed. A second call waits for the first. Idempotent.

        Args:
            report: Called with each step, for people.

        Returns:
            What went wrong; None if nothing did.
        """
        if self.closed:  # also in a fork, where somebody may have held the locks
            return None
        self.commands.bar()
        with self._end:
            try:
                land = self._on_exit == "land"
                return None if self.closed else self.bring_down("its flight ends", report, land=land)
            finally:
                self.close()

    def bring_down(
        self, reason: str, report: Callable[[str], object] = _silent, *, land: bool = True
    ) -> SkyloopError | None:
        """Land what this application flies and wait until it has landed, or let it go; see :meth:`end_flight`."""
        self._finish_stop()
        feedback = self.state.newest
        if not self._flies():
            if feedback is not None and feedback.state.airborne and (whose := self._others_hands()):
                report(f"{whose}: the drone is left to it")
            return None
        try:
            if not land:
                self.let_go(reason)
            elif feedback is not None and _returns(feedback):
                report("it returns to its start and lands")
                self.check_may_wait()
                if not self.state.notifier.wait_for(lambda: self._is_down() or cancelled.get()(), RETURN_S):
                    return NoAnswerError(f"the vehicle has not returned and landed within {RETURN_S:g} s")
            else:
                report("landing")
                self.complete(Land(), lambda newest: newest.state in _ENDED_IN, True, LANDING_S, automatic=True)
        except RefusedError as error:
            if not self.state.notifier.wait_for(lambda: self._others_hands() != "", OTHERS_S):
                return error
            report(f"{self._others_hands()}: the drone is left to it")  # who took it a moment ago, too
        except SkyloopError as error:
            return error
        return None

    @contextmanager
    def closing(self, mailbox: Closable) -> Iterator[None]:
        """Close ``mailbox``, which wakes its consumer, if the drone is closed within the block."""
        self._to_close.append(mailbox)
        try:
            yield
        finally:
            self._to_close.remove(mailbox)

    def check_open(self) -> None:
        """Raise :class:`ClosedError` after :meth:`close`."""
        if self.closed:
            raise ClosedError(self.commands.why_closed)

    def check_may_wait(self) -> None:
        """Raise :class:`UsageError` on the receiving thread."""
        if self.connection.receiving:
            raise UsageError("an inline listener can't wait for what it would itself have to receive")

    def no_frame(self, camera: str, timeout_s: float) -> NoAnswerError:
        """Return the error for a frame that did not come, with what is known of the reason."""
        link = self.state.status
        words = [f"no frame of {camera} came within {timeout_s:g} s"]
        if link.vehicle is not LinkState.UP:
            words += [f"the vehicle's link is {link.vehicle.value}", link.reason, link.remedy]
        return NoAnswerError(": ".join(filter(None, words)))

    def _finish_stop(self) -> None:
        """Wait, for 2 s at most, until an emergency stop has shown: it would end with the connection."""
        if self.connection.connected and not self.connection.receiving:
            self.state.notifier.wait_for(lambda: not self.commands.stopping, STOP_S)

    def _known(self) -> bool:
        """Whether feedback has come and the link's state was judged."""
        return self.state.newest is not None and self.state.status.application is not LinkState.CONNECTING

    def _wait_until_awake(self, deadline_s: float) -> None:
        """Wait while the vehicle wakes up, as long as there is time; what it waits for goes to the log."""
        if self.state.notifier.wait_for(lambda: not self._why_asleep(), min(_SOON_S, deadline_s - time.monotonic())):
            return
        _log.warning("%s is %s; waiting for it", self.name, self._why_asleep())
        if not self.state.notifier.wait_for(lambda: not self._why_asleep(), deadline_s - time.monotonic()):
            _log.warning("%s is %s: it can't take off yet", self.name, self._why_asleep())

    def _why_asleep(self) -> str:
        newest = self.state.newest
        return newest.link_reason if newest is not None and newest.waking_up and not self.closed else ""

    def _is_down(self) -> bool:
        newest = self.state.newest
        return self.closed or newest is None or newest.state in _ENDED_IN

    def _others_hands(self) -> str:
        """Return who flies the vehicle in place of this application; empty if nobody took it."""
        status, newest = self.commands.status, self.state.newest
        if status.state in ("queued", "preempted"):
            return f"{status.holder or 'another application'} took over"
        return "" if newest is None else newest.others or ""

    def _flies(self) -> bool:
        """Whether this application has the vehicle in the air, or has just commanded a take-off."""
        newest = self.state.newest
        if self.state.status.vehicle is LinkState.CLOSED:
            return False  # a recording that has ended: nothing to land
        airborne = newest is not None and newest.state.airborne
        if newest is not None and newest.others:
            return False  # flown by others too: not ours to land or to stop
        return self.commands.status.state == "held" and (airborne or self.commands.wants_flight)

    # Commands ----------------------------------------------------------------------------------------------------

    def complete(
        self,
        action: AnyAction,
        is_done: Callable[[Feedback], bool],
        wait: bool,
        timeout_s: float,
        *,
        automatic: bool = False,
    ) -> None:
        """Send the command and, if ``wait``, wait until feedback shows that it is done; see :meth:`Drone.land`.

        A take-off that is not done in time lets the vehicle go. So does a caller that waits no longer, as after Ctrl-C,
        but for a landing.
        """
        if not wait:
            self.commands.command(action, now=True)
            return
        if type(action) is not Land:  # a landing is commanded all the same: nothing is safer
            self.check_may_wait()
        deadline_s = time.monotonic() + timeout_s
        waiting = None
        try:
            waiting = ActionWait(
                action,
                is_done,
                self.commands,
                self.state,
                self.connection,
                automatic=automatic,
            )
            self.check_may_wait()
            waiting.wait(timeout_s, deadline_s)
        except SkyloopError as error:
            if isinstance(error, NoAnswerError) and type(action) is Takeoff:
                self.let_go("it did not take off in time")
            raise
        except BaseException as error:
            unasked = isinstance(error, GivenUpError) and (waiting is None or waiting.outdone)
            if type(action) is not Land and not unasked:
                self.let_go(f"nobody waits for {action.name} any more")
            raise

    # Consumers -----------------------------------------------------------------------------------------------------

    def channel(self, camera: str | None = None, **how: Unpack[VideoOptions]) -> VideoChannel:
        """Return the channel of a camera's frames; see :meth:`VideoChannels.channel`.

        Raises:
            ClosedError: If the drone was closed.
        """
        self.check_open()
        return self.state.video.channel(camera, **how)

    def stream(self, camera: str | None = None, **how: Unpack[StreamOptions]) -> StreamChannel:
        """Return the channel of a camera's H.264; see :func:`skyloop.extend.stream_channel`."""
        self.check_open()
        return self.state.video.stream(camera, **how)

    def follow(self, find: Callable[[], C]) -> FollowingChannel[Any, C]:
        """Return the channel that ``find`` returns, also once the proxy was started again with other cameras."""
        return FollowingChannel(find, self.state.on_welcome)

    def result_channel(self, processor: str) -> ResultChannel:
        """Return the channel of a processor's results, whether or not such a processor runs.

        Raises:
            UsageError: If ``processor`` can't be a name.
            ClosedError: If the drone was closed.
        """
        self.check_open()
        return self.state.results.channel(checked_name(processor))

    def inbox(
        self,
        *,
        feedback: bool = True,
        frames: bool = True,
        camera: str | None = None,
        results: bool = False,
        processors: Iterable[str] | None = None,
        max_age_s: float | None = None,
    ) -> Mailboxes:
        """Return mailboxes of what is wanted; see :func:`skyloop.extend.inbox`.

        Raises:
            UsageError: If ``max_age_s`` or the name of a processor is unusable.
            UnknownNameError: If the vehicle has no camera of this name.
            UnsupportedError: If frames are wanted and the vehicle has no camera.
        """
        channels = self.state.results
        named = None if processors is None else [checked_name(one) for one in processors]
        wanted = [channels.everything] if named is None else [channels.channel(one) for one in named]
        return Mailboxes(
            self.state.scheduler,
            self.connection,
            feedback=self.state.on_feedback if feedback else None,
            frames=self.follow(lambda: self.channel(camera)) if frames else None,
            results=wanted if results else [],
            max_age_s=checked_age(max_age_s),
        )

    def join_processor(
        self, name: str, *, code: str, camera: str | None = None, shared: bool = True, timeout_s: float = 5.0
    ) -> Membership:
        """Become a worker of a processor; see :func:`skyloop.extend.join_processor`."""
        self.check_may_wait()
        if not isinstance(code, str) or len(code) > MAX_CODE:
            raise UsageError(f"code is {code!r:.80} and must be a text of at most {MAX_CODE} characters")
        membership = Membership(
            self.connection,
            self.state,
            checked_name(name),
            code,
            lambda: self.channel(camera).camera.name,
            shared=shared,
        )
        membership.start(timeout_s)
        self._to_close.append(membership)  # ends with the drone
        return membership

    def cancelled(self, listener: Listener[Any]) -> None:
        """Forget a listener, which was cancelled."""
        if listener in self.listeners:
            self.listeners.remove(listener)

    def report(self, where: str, error: Exception | SystemExit) -> None:
        """Emit an event that a callback of the application raised an exception; ``sys.exit()`` ends the flight."""
        text = f"{where} raised {type(error).__name__}: {error}"
        self.state.emit(EventKind.CALLBACK_ERROR, text, Severity.ERROR, where=where)
        if isinstance(error, SystemExit) and not self.ending:
            self.commands.bar()
            try:  # no daemon: the interpreter waits for the landing
                threading.Thread(target=self.end_flight, name="skyloop-end").start()
            except RuntimeError:  # there is none to be had, and this one may not wait
                self.let_go(f"{where} ended the program", land=True)


def _returns(feedback: Feedback) -> bool:
    """Whether a failsafe flies the vehicle back to its start."""
    return feedback.failsafe is Failsafe.LAND and feedback.return_phase is not ReturnPhase.NONE
