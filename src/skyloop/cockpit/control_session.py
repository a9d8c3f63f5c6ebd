"""One page's control of one drone: convert the page's messages to commands for the vehicle, and respond to them.

A command that arrives in time (:func:`skyloop.cockpit.commands.untimely`) is carried out; any other is refused and
never carried out later. The only exception is the hover sent when sticks are released, which may be of any age.

There is a dead-man switch: if a page that is flying the vehicle sends nothing for :data:`SILENT_S`, the vehicle hovers.
A page that has not confirmed for :data:`GONE_S` that it receives data from the cockpit is treated as a silent pilot:
the cockpit stops repeating its commands, so the proxy ends its lease and the failsafe ladder acts as it would for any
program. When the page's connection ends, a vehicle that it is flying hovers immediately, and authority is released.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from starlette.websockets import WebSocket

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.cockpit import commands
from skyloop.cockpit.commands import SETTLED_NS, UNTOUCHED_S, Alive, AnyCommand, Fly, decode_command, late_s, untimely
from skyloop.cockpit.feeds import call_soon, start_task
from skyloop.cockpit.follow_session import NO_CONTROL, FollowerFactory, FollowSession
from skyloop.cockpit.place_flight import UP, Leg, PlaceFlight, RouteSession, to_place, to_start
from skyloop.cockpit.stream import PageSocket
from skyloop.cockpit.takeover import AuthorityReport, TakeoverDialog
from skyloop.control.route import check_for
from skyloop.control.target_follower import TargetFollower
from skyloop.errors import AuthorityError, DecodeError, LinkError, RefusedError, SkyloopError
from skyloop.messages import Fate, FlightState, Land, Takeoff

if TYPE_CHECKING:
    from skyloop.cockpit.station import PilotConnection, Station
    from skyloop.control.waypoint import Waypoint
    from skyloop.messages import Event

SILENT_S: Final = 0.5  #: the vehicle hovers if the page that is flying it sends nothing for this long
#: If a page receives nothing from the cockpit for this long, it can't fly, and its control expires.
GONE_S: Final = 2.0
_REFUSE_AGAIN_S: Final = 1.0  # interval between identical refusals of stick commands, which arrive 20 times a second
_DOWN: Final = frozenset({FlightState.LANDED})
_TAKEOFF_NS: Final = 1_000_000_000  # time limit for repeating a take-off that the proxy has not acknowledged
_BEGUN_NS: Final = 6_000_000_000  # the same once the proxy has acknowledged it
_numbers = itertools.count(1)

Json = dict[str, Any]


class ControlSession:
    """Serves one control socket of a page from opening to closing. Used on the event loop."""

    def __init__(
        self,
        socket: WebSocket,
        station: Station,
        person: str = "",
        clock: Clock = monotonic_ns,
        *,
        photos: Path = Path("photos"),
        follower: FollowerFactory = TargetFollower,
    ) -> None:
        """Prepare the session; :meth:`run` serves it.

        ``photos``: the folder for photos taken along routes; each drone has a subfolder. ``follower``: creates
        followers for targets that the page marks.
        """
        self._page = PageSocket(socket)
        self._send = self._page.send
        self._station = station
        self._clock = clock
        #: The application name that other applications see.
        self.app = f"{person} (cockpit {next(_numbers)})" if person else f"cockpit {next(_numbers)}"
        self._pilot: PilotConnection | None = None
        self._jobs: set[asyncio.Task[None]] = set()
        self._turn = asyncio.Lock()  # only one job at a time waits for the proxy
        self._place = PlaceFlight(station, self.app, self._done, self._refuse)
        self._follow = FollowSession(station.drone, self._send, self._end_flight, follower, clock)
        self._route: RouteSession | None = None
        self._photos = photos / station.found.name
        self._steering = False  # whether the newest set-point is a velocity commanded by this page's sticks
        self._stood_down = False  # whether the page stopped commanding in mid-flight and has not resumed since
        self._silence: asyncio.TimerHandle | None = None
        self._authority = AuthorityReport(station, self.app, GONE_S)
        self._takeover = TakeoverDialog(self._send)
        self._decided = ("", 0)  # ``do`` and ``n`` of the page's last decision, even if it was refused or is waiting
        # The last command that ended an earlier command, and the number of the first intent of that last command.
        self._last_command, self._first = ("", 0), 0
        self._decisions = 0  # number of commands so far that fly or end a flight; compared by jobs that have waited
        self._hands = commands.HandWatch()
        #: A command that is not complete yet: its ``do`` and ``n``, the states that complete it, and its start time.
        self._awaited: tuple[str, int, frozenset[FlightState], int] | None = None
        self._repeated = False  # whether the take-off was repeated for as long as allowed
        self._last_refusal = ("", -_REFUSE_AGAIN_S)  # last refusal of a stick command: reason and time [s]
        self._handlers: dict[type[AnyCommand], Callable[[Any], None]] = {
            commands.Take: lambda command: self._run_in_turn(command, self._take),
            commands.Release: lambda command: self._run_in_turn(command, self._release),
            commands.Answer: lambda command: self._run_in_turn(command, self._answer),
            commands.TakeOff: lambda command: self._send_command(command, lambda pilot: pilot.command(Takeoff()), UP),
            commands.HoverHere: self._hover_here,
            commands.LandHere: lambda command: self._send_command(command, lambda pilot: pilot.command(Land()), _DOWN),
            commands.Reset: lambda command: self._send_command(command, lambda pilot: pilot.reset_emergency()),
            commands.Stop: lambda command: start_task(self._stop_motors(command), self._jobs),
            Fly: self._fly,
            commands.GoTo: lambda command: self._set_out(command, lambda pilot: to_place(command, pilot)),
            commands.FlyBack: lambda command: self._set_out(command, to_start),
            commands.StartRoute: lambda command: self._run_in_turn(
                command, partial(self._fly_route, held=self._still_held(command))
            ),
            commands.PauseRoute: lambda command: self._steer_route(command, RouteSession.pause),
            commands.ResumeRoute: lambda command: self._steer_route(command, RouteSession.resume),
            commands.SkipWaypoint: lambda command: self._steer_route(command, RouteSession.skip),
            commands.StopRoute: lambda command: self._steer_route(command, RouteSession.end),
            commands.SelectTarget: lambda command: self._run_in_turn(command, self._select_target),
            commands.TrackTarget: lambda command: self._run_in_turn(
                command, partial(self._follow_target, held=self._still_held(command))
            ),
            commands.SetFollowMode: self._set_follow_mode,
            commands.StopFollowing: self._stop_following,
            commands.Write: lambda command: self._run_in_turn(command, self._write),
        }

    @property
    def waits(self) -> bool:
        """Whether the page is waiting for authority, either in the queue or to regain it."""
        return self._pilot is not None and self._pilot.authority.state in ("queued", "preempted")

    async def run(self) -> None:
        """Serve the page until it disconnects, then leave the vehicle in a safe state."""
        update = self._update
        self._station.pilot_came()
        self._station.sessions.add(self)
        self._station.broadcast.subscribe(update)
        try:
            await self._page.serve(self._on_messages)
        finally:
            self._station.broadcast.unsubscribe(update)
            self._on_page_gone()
            try:
                await asyncio.shield(self._close())
            finally:
                self._station.sessions.discard(self)

    # Messages from the page ------------------------------------------------------------------------------------

    def _on_messages(self, texts: Sequence[str | bytes]) -> None:
        """Carry out the page's commands. If several stick commands have queued up, use only the newest."""
        decoded: list[AnyCommand] = []
        for text in texts:
            try:
                decoded.append(decode_command(text))
            except DecodeError as error:
                self._refuse("", 0, str(error))
        for command, after in itertools.zip_longest(decoded, decoded[1:]):
            if not (isinstance(command, Fly) and isinstance(after, Fly)):
                self._on_command(command)

    def _on_command(self, command: AnyCommand) -> None:
        now_ns = self._clock()
        problem = untimely(command, seconds(now_ns))
        if not problem and not _is_deaf(command, now_ns):
            self._restart_silence_timer()  # an old message is no sign of life
        if isinstance(command, Alive):
            self._on_ping(command, now_ns)
            return
        try:
            if problem and not (
                isinstance(command, commands.HoverHere) and command.automatic
            ):  # the page sends this command only once
                raise RefusedError(problem)
            if _decides(command):
                self._decisions += 1
                # A stop has its own connection, so refusals seen here never concern a stop.
                self._decided = self._decided if isinstance(command, commands.Stop) else (command.do, command.n)
            self._handlers[type(command)](command)
        except SkyloopError as error:
            self._refuse_command(command, str(error))

    def _on_ping(self, ping: Alive, now_ns: int) -> None:
        """Respond, and treat the page as present until :data:`GONE_S` after it last received data from the cockpit."""
        if ping.seen_s is not None and self._pilot is not None:
            ago_s = min(GONE_S, max(0.0, seconds(now_ns) - ping.seen_s))  # in case the page sends a time in the future
            self._pilot.present_until(now_ns + nanoseconds(GONE_S - ago_s))
        self._send({"type": "pong", "n": ping.n, "now_s": seconds(now_ns)})

    def _send_command(
        self, command: AnyCommand, act: Callable[[PilotConnection], bool], until: frozenset[FlightState] = frozenset()
    ) -> None:
        """Send one command, ending the page's previous flight.

        The command is complete once it is sent or, if ``until`` contains states, once the vehicle is in one of them.
        ``act``: sends the command; returns whether it was sent.
        """
        pilot = self._held()
        self._send_now(pilot, act, command)
        self._acknowledge(command)
        if until:
            self._awaited, self._repeated = (command.do, command.n, until, pilot.proxy_now_ns + SETTLED_NS), False
        else:
            self._done(command.do, command.n)

    def _send_now(self, pilot: PilotConnection, act: Callable[[PilotConnection], bool], command: AnyCommand) -> None:
        """End the page's previous flight and send a command; raise :class:`LinkError` if the command was not sent."""
        with self._in_place_of(pilot, f"{command.do} was commanded"):
            sent = act(pilot)
        if not sent:
            with suppress(SkyloopError):
                pilot.idle()  # otherwise it would still be executed if the link were restored soon
            raise LinkError(f"{command.do} was not sent: the link to the proxy is {pilot.link.application}")

    @contextmanager
    def _in_place_of(self, pilot: PilotConnection, why: str) -> Iterator[None]:
        """End the page's previous flight; hover if the command that replaces it is refused."""
        self._end_flight(why)
        with _else_hovering(pilot, "its replacement was refused"):
            yield

    def _hover_here(self, command: commands.HoverHere) -> None:
        if command.automatic:
            self._held()
            self.let_go("nothing is held on the page")
            self._acknowledge(command)
        else:
            self._send_command(command, lambda pilot: pilot.hover())

    def _fly(self, command: Fly) -> None:
        pilot = self._held()
        if not self._hands.holds(command, seconds(self._clock())):
            why = f"no hand has moved the sticks for {UNTOUCHED_S:g} s: the vehicle hovers until one does"
            if self._steering:
                self.let_go(why)
            raise RefusedError(why)
        with self._in_place_of(pilot, "the sticks were moved"):
            pilot.velocity(forward=command.forward, left=command.left, up=command.up, yaw_rate=command.yaw_rate)
        self._steering = True
        self._restart_silence_timer()

    def _set_out(self, command: AnyCommand, plan: Callable[[PilotConnection], Leg]) -> None:
        """Command a flight to a place and monitor the flight until it ends."""
        pilot = self._held()
        leg = plan(pilot)
        self._send_now(pilot, lambda pilot: pilot.command(leg.action), command)
        self._place.watch(command, pilot, leg)
        self._acknowledge(command)
        self._restart_silence_timer()

    async def _fly_route(self, command: commands.StartRoute, held: Callable[[], PilotConnection]) -> None:
        """Check a route again, because the situation may have changed, and fly it."""
        route = self._station.routes.get(command.id)
        held()
        check = await asyncio.to_thread(check_for, self._station.drone, route, wait_s=0.0)
        problem = next((one.reason for one in check.findings if one.severity == "error"), "")
        if problem:
            raise RefusedError(f"the route can't be flown: {problem}")
        pilot = held()
        with self._in_place_of(pilot, "another route was started"):
            self._end_route()
            self._route = RouteSession(route, pilot, self._station.drone, self._photos, self._send, self._aim)
            self._route.begin()
        self._acknowledge(command)
        self._restart_silence_timer()

    def _steer_route(self, command: AnyCommand, act: Callable[[RouteSession], None]) -> None:
        pilot, route = self._held(), self._route
        if route is None or route.law.over:
            raise RefusedError("this page is not flying a route")
        if isinstance(command, commands.ResumeRoute):
            self._end_flight()
        with _else_hovering(pilot, "its route can't be changed"):
            act(route)
        self._acknowledge(command)
        self._restart_silence_timer()

    async def _select_target(self, command: commands.SelectTarget) -> None:
        await self._follow.select(command)
        self._acknowledge(command)

    async def _follow_target(self, command: commands.TrackTarget, held: Callable[[], PilotConnection]) -> None:
        """Track the object inside a box. Authority is needed only if a mode is given."""
        await self._follow.begin(command, held)
        self._acknowledge(command)
        self._restart_silence_timer()

    def _set_follow_mode(self, command: commands.SetFollowMode) -> None:
        self._follow.fly(command, self._held())
        self._acknowledge(command)
        self._restart_silence_timer()

    def _stop_following(self, command: commands.StopFollowing) -> None:
        self._follow.end()
        self._acknowledge(command)

    def _aim(self, goal: Waypoint | None) -> None:
        """Show the goal that a route is flying to."""
        if goal is None:
            self._station.goals.pop(self.app, None)
        else:
            self._station.goals[self.app] = goal

    def _end_route(self) -> None:
        """End the route permanently: its connection ended, or another route or flight replaces it."""
        if self._route is not None:
            self._route.end(hover=False)
            self._route = None

    async def _stop_motors(self, command: commands.Stop) -> None:
        """Stop the motors; keep trying for as long as the page shows the command as pending."""
        assert command.at_s is not None  # a command without a time has already been refused
        until_ns = nanoseconds(command.at_s - command.unsure_s + late_s(command))
        try:
            await self._station.stop_motors(until_ns, lambda: self._acknowledge(command))
        except SkyloopError as error:
            self._refuse_command(command, str(error))
        else:
            self._done(command.do, command.n)

    async def _take(self, command: commands.Take) -> None:
        pilot = self._pilot
        if pilot is None:
            pilot, self._first = await self._station.open_pilot(self.app), 0
            self._pilot = pilot
            pilot.set_flown_by_person()
            loop = asyncio.get_running_loop()
            pilot.on_event(lambda event: call_soon(loop, self._on_event, event), inline=True)
        elif not pilot.is_linked:
            raise LinkError("the link to the proxy is lost: take control when it is back")
        pilot.present_until(monotonic_ns() + nanoseconds(GONE_S))
        if self.waits and not command.ask and not self._authority.outranks(command.priority):
            # Another request to the proxy would give up the place in the queue.
            raise AuthorityError(f"{self._authority.busy(command.priority)}; you stay in the queue", code="busy")
        self._takeover.request(ask=command.ask)
        self._acknowledge(command)
        try:
            await asyncio.to_thread(pilot.acquire, command.priority, ask=command.ask)
        except SkyloopError as error:
            if pilot.authority.state == "none":
                await self._close_pilot()
            if isinstance(error, AuthorityError) and error.code == "busy":
                raise AuthorityError(self._authority.busy(command.priority), code="busy") from error
            raise
        self._done(command.do, command.n)
        self._update()

    async def _answer(self, command: commands.Answer) -> None:
        pilot = self._held()
        self._acknowledge(command)
        if command.grant:
            self._authority.handed_over()  # observers may notice this before the proxy has confirmed the answer
        try:
            await self._takeover.answer(command, pilot)
        except RefusedError:
            self._authority.handed_over(given=False)
            raise
        self._done(command.do, command.n)

    async def _release(self, command: commands.Release) -> None:
        self.let_go("the page gives control back")
        self._authority.released()
        self._acknowledge(command)
        await self._close_pilot()
        self._done(command.do, command.n)
        self._update()

    async def _close_pilot(self) -> None:
        """End the route and close the page's own connection, which is not needed without authority."""
        self._end_route()
        pilot, self._pilot = self._pilot, None
        if pilot is not None:
            await self._station.close_pilot(pilot)

    async def _write(self, command: commands.Write) -> None:
        pilot = self._held()
        self._acknowledge(command)

        def write() -> Any:
            pilot.config[command.name] = command.value
            return pilot.config[command.name]

        value = await asyncio.to_thread(write)
        self._send({"type": "done", "do": command.do, "name": command.name, "value": value})

    def _held(self) -> PilotConnection:
        """Return the connection that holds authority.

        Raise ``AuthorityError`` if the page does not hold authority, ``RefusedError`` during an emergency stop.
        """
        pilot = self._pilot
        if pilot is None or pilot.authority.state == "none":
            raise AuthorityError("take control first", code="no_authority")
        self._station.check_stop()
        if pilot.authority.state != "held":
            raise AuthorityError(f"{pilot.authority.holder or 'another application'} has control", code="no_authority")
        return pilot

    def _still_held(self, command: AnyCommand) -> Callable[[], PilotConnection]:
        """Return a replacement for :meth:`_held` in a job that waits for responses.

        It also raises :class:`RefusedError` if another command has started or ended a flight since then (the newest
        decision wins), the page has been silent, or the command is now too old.
        """
        number = self._decisions

        def held() -> PilotConnection:
            if self._decisions != number:
                raise RefusedError("another command was given, or the page was silent")
            if problem := untimely(command, seconds(self._clock())):
                raise RefusedError(problem)
            return self._held()

        return held

    # The dead-man switch ---------------------------------------------------------------------------------------

    def _restart_silence_timer(self) -> None:
        """Restart the timer after a sign of life from the page."""
        if self._silence is not None:
            self._silence.cancel()
            self._silence = None
        if self._is_under_way:
            self._silence = asyncio.get_running_loop().call_later(SILENT_S, self._on_silence)

    def _on_silence(self) -> None:
        self._silence = None
        if self._is_under_way:
            why = f"the page was silent for {SILENT_S:g} s: the vehicle hovers"
            self.let_go(why)
            self._refuse(*self._last_command, why)

    @property
    def _is_under_way(self) -> bool:
        """Whether this page is flying the vehicle: with sticks, to a waypoint, along a route or after a target."""
        route = self._route is not None and self._route.is_under_way
        return self._steering or self._place.is_under_way or route or self._follow.is_under_way

    def _end_flight(self, why: str = "another command was given, or the page was silent") -> None:
        """End the page's previous flight; a route is only paused and can be resumed."""
        self._decisions += 1
        if self._decided != self._last_command:  # earlier intents, and refusals of them, belong to the previous command
            self._last_command, self._first = self._decided, 1 + (self._pilot.intent if self._pilot else 0)
        self._steering = self._stood_down = False
        self._follow.interrupt(why)
        if self._route is not None:
            self._route.pause(why, hover=False)
        self._awaited = None
        self._place.cancel()

    def let_go(self, why: str) -> None:
        """Hover if the page is flying the vehicle. A take-off or landing continues: it completes without the page."""
        flies = self._is_under_way or self._stood_down
        self._end_flight(why)
        pilot = self._pilot
        if pilot is not None and (flies or pilot.is_flying):
            pilot.let_go(why)

    def stand_down(self, why: str) -> None:
        """Send no more commands, because the motors are being stopped. Authority is kept."""
        flies = self._is_under_way or self._stood_down
        self._end_flight(why)
        self._stood_down = flies
        if self._pilot is not None:
            with suppress(SkyloopError):
                self._pilot.idle()

    # The end ---------------------------------------------------------------------------------------------------

    def _on_page_gone(self) -> None:
        """Hover immediately, because the page has disconnected."""
        if self._silence is not None:
            self._silence.cancel()
            self._silence = None
        self.let_go("the page is gone")

    async def _close(self) -> None:
        """Wait for running jobs and release authority."""
        await asyncio.gather(*self._jobs, return_exceptions=True)
        await self._follow.close()
        self.let_go("the page is gone")  # a job may have taken control or started a flight just now
        await self._close_pilot()
        await self._station.pilot_went()

    # Messages to the page --------------------------------------------------------------------------------------

    def _update(self) -> None:
        """Send changes of authority and of open questions to the page, and report completed commands."""
        pilot = self._pilot
        if (message := self._authority.update(pilot, self._takeover.update(pilot))) is not None:
            if not message["mine"]:
                self._end_flight(NO_CONTROL)
            self._send(message)
        if pilot is not None:
            self._observe_refusal(pilot)
        if self._awaited is not None and pilot is not None:
            do, n, states, from_ns = self._awaited
            if do == commands.TakeOff().do and not self._repeated:
                patience_ns = _BEGUN_NS if pilot.is_acknowledged else _TAKEOFF_NS
                if pilot.proxy_now_ns - from_ns > patience_ns:
                    self._repeated = True
                    with suppress(SkyloopError):
                        pilot.idle()  # a landing in progress continues, but none may begin when a slow link recovers
            with suppress(LinkError):
                feedback = pilot.feedback()
                if feedback.captured_ns >= from_ns and feedback.state in states:
                    self._awaited = None
                    self._done(do, n)

    def _on_event(self, event: Event) -> None:
        if self._pilot is not None:
            self._takeover.on_event(event, self._pilot)

    def _observe_refusal(self, pilot: PilotConnection) -> None:
        """If the proxy has refused or ended this page's flight, end it here and inform the page."""
        outcome = pilot.refusal(self._first)
        if outcome is None:
            return
        self._first = outcome.intent + 1
        watched = self._follow.is_under_way or (self._route is not None and self._route.is_under_way)
        refused = outcome.fate in (Fate.UNDER_WAY, Fate.REFUSED, Fate.OTHERS)
        if not watched and (refused or self._awaited or self._is_under_way):
            self._refuse(*self._last_command, outcome.text.removeprefix(f"{self.app}: "))  # the page knows its pilot
        if watched or self._place.is_under_way:
            self.let_go(outcome.text)  # this feedback also reveals whether others have taken control
        elif self._last_command[0] == commands.TakeOff().do:
            with suppress(SkyloopError):
                pilot.idle()  # otherwise the drone would take off unexpectedly as soon as it could
        self._awaited = None

    def _refuse(self, do: str, n: int, why: str) -> None:
        self._send({"type": "refused", "do": do, "n": n, "why": why})

    def _done(self, do: str, n: int) -> None:
        self._send({"type": "done", "do": do} | ({"n": n} if n else {}))

    def _refuse_command(self, command: AnyCommand, why: str) -> None:
        if isinstance(command, Fly):  # stick commands arrive 20 times a second
            now_s = seconds(self._clock())
            before, at_s = self._last_refusal
            if why == before and now_s - at_s <= _REFUSE_AGAIN_S:
                return
            self._last_refusal = why, now_s
        self._send({"type": "refused", "do": command.do, "n": command.n, "why": why})

    def _acknowledge(self, command: AnyCommand) -> None:
        self._send({"type": "sent", "do": command.do, "n": command.n})

    def _run_in_turn(self, command: AnyCommand, work: Callable[[Any], Coroutine[Any, Any, None]]) -> None:
        """Start a job that may block, once the jobs started earlier have ended."""
        start_task(self._run(command, work), self._jobs)

    async def _run(self, command: AnyCommand, work: Callable[[Any], Coroutine[Any, Any, None]]) -> None:
        try:
            async with self._turn:
                problem = untimely(command, seconds(self._clock()))
                if problem:  # the earlier jobs took too long
                    raise RefusedError(problem)
                await work(command)
        except SkyloopError as error:
            self._refuse_command(command, str(error))


@contextmanager
def _else_hovering(pilot: PilotConnection, why: str) -> Iterator[None]:
    """Hover if the command in this block is refused, because by then the previous flight is no longer monitored."""
    try:
        yield
    except SkyloopError:
        pilot.let_go(why)
        raise


def _is_deaf(command: AnyCommand, now_ns: int) -> bool:
    """Return whether a ping shows that its page receives no data; its vehicle hovers before the page counts as gone."""
    if not isinstance(command, Alive) or command.seen_s is None:
        return False
    return seconds(now_ns) - command.seen_s > GONE_S - SILENT_S


def _decides(command: AnyCommand) -> bool:
    """Return whether a command starts, controls or ends a flight."""
    if isinstance(command, commands.TrackTarget):
        return command.mode is not None
    return not isinstance(command, commands.Take | commands.Answer | commands.Write | commands.SelectTarget | Alive)
