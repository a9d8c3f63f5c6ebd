"""One page's controls of one drone: from its messages to commands, and what it is told of them.

The page is watched (*dead-man*): while it flies by sticks or to a waypoint and says nothing for :data:`SILENT_S`, the
vehicle hovers. When its connection ends the vehicle hovers too, and the authority is given back, so that the proxy's
failsafe ladder, or whoever waits in line, goes on from there.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from starlette.websockets import WebSocket, WebSocketDisconnect

from skyloop.clock import monotonic_ns
from skyloop.cockpit.asking import Asking, Place
from skyloop.cockpit.feeds import call_soon
from skyloop.cockpit.orders import (
    Alive,
    Answer,
    AnyOrder,
    Fly,
    GoTo,
    HoverHere,
    LandHere,
    Release,
    Reset,
    Stop,
    Take,
    TakeOff,
    Write,
    decode_order,
)
from skyloop.cockpit.telemetry import encode_json
from skyloop.control.waypoint import Waypoint, lacking, reached, velocity_to
from skyloop.errors import AuthorityError, DecodeError, LinkError, RefusedError, SkyloopError
from skyloop.messages import EventKind, FlightState, LinkState

if TYPE_CHECKING:
    from skyloop.cockpit.hands import Hands
    from skyloop.cockpit.station import Station
    from skyloop.messages import Event

SILENT_S: Final = 0.5  #: a page that flies and says nothing for so long is taken for dead
GOTO_PERIOD_S: Final = 0.05
MAX_WAITING: Final = 256  #: answers to a page that does not read; what comes on top is not said
_SAY_AGAIN_S: Final = 1.0  # the same refusal of sticks, which come twenty times a second
_UP: Final = frozenset({FlightState.HOVERING, FlightState.FLYING})
_DOWN: Final = frozenset({FlightState.LANDED})
_SETTLED_NS: Final = 50_000_000  # feedback captured so soon after a command may still be from before it
_numbers = itertools.count(1)

Json = dict[str, Any]


class ControlSession:
    """Made when a page opens its control socket, gone when that closes. On the event loop."""

    def __init__(self, socket: WebSocket, station: Station, person: str = "") -> None:
        """``person``: the name of who flies, if it is known."""
        self._socket = socket
        self._station = station
        #: The name under which everybody sees who flies.
        self.app = f"{person} (cockpit {next(_numbers)})" if person else f"cockpit {next(_numbers)}"
        self._hands: Hands | None = None
        self._outbox: asyncio.Queue[Json] = asyncio.Queue(MAX_WAITING)
        self._jobs: set[asyncio.Task[None]] = set()
        self._asking = asyncio.Lock()  # what waits for the proxy is done one after the other
        self._goto: asyncio.Task[None] | None = None
        self._steering = False  # by sticks: the newest set-point is a velocity of this page
        self._silence: asyncio.TimerHandle | None = None
        self._authority: tuple[str, str | None, int | None, Place | None] | None = None  # as told last
        self._takeover = Asking(self._say)
        self._last = ""  # what was ordered last
        self._orders = 0  # how many there were
        self._told_of = 0  # the order of which a refusal was told
        self._awaited: tuple[str, frozenset[FlightState], int] | None = None  # what is done in which states, from when
        self._complained = ("", 0.0)  # about sticks: why, and when
        self._do: dict[type[AnyOrder], Callable[[Any], None]] = {
            Take: lambda order: self._begin(order.do, self._take(order.priority, order.ask)),
            Release: lambda order: self._begin(order.do, self._release()),
            Answer: lambda order: self._begin(order.do, self._answer(order)),
            TakeOff: lambda order: self._command(order.do, lambda hands: hands.takeoff(wait=False), _UP),
            HoverHere: lambda order: self._command(order.do, lambda hands: hands.hover()),
            LandHere: lambda order: self._command(order.do, lambda hands: hands.land(wait=False), _DOWN),
            Reset: lambda order: self._command(order.do, lambda hands: hands.reset_emergency()),
            Stop: lambda order: self._begin(order.do, self._stop(), wait=False),
            Fly: self._fly,
            GoTo: self._go_to,
            Write: lambda order: self._begin(order.do, self._write(order)),
            Alive: lambda order: self._say({"type": "pong", "n": order.n}),
        }

    async def run(self) -> None:
        """Serve the page until it is gone, then leave the vehicle in a safe state."""
        look = self._look
        writing = asyncio.create_task(self._write_out())
        self._station.pilot_came()
        self._station.beat.join(look)
        try:
            while True:
                message = await self._socket.receive()
                if message["type"] == "websocket.disconnect":
                    break
                self._take_in(message.get("text") or message.get("bytes") or "")
        except WebSocketDisconnect:
            pass
        finally:
            self._station.beat.leave(look)
            self._let_go()
            writing.cancel()
            await asyncio.shield(self._leave())

    # What the page says ----------------------------------------------------------------------------------------

    def _take_in(self, text: str | bytes) -> None:
        try:
            order = decode_order(text)
        except DecodeError as error:
            self._refuse("", str(error))
            return
        self._rearm()
        if not isinstance(order, Alive | Answer):
            self._last = order.do
            self._orders += 1
        try:
            self._do[type(order)](order)
        except SkyloopError as error:
            self._refuse(order.do, str(error))

    def _command(self, do: str, act: Callable[[Hands], bool], until: frozenset[FlightState] = frozenset()) -> None:
        """What is one command; it ends whatever the page flew before. Done when sent, or when the vehicle is in one of
        the states. Raises what the drone raises."""
        hands = self._held()
        self._end_flight()
        if not act(hands):
            raise LinkError(f"{do} was not sent: the link to the proxy is {hands.link.application}")
        if until:
            self._awaited = do, until, hands.proxy_ns + _SETTLED_NS
        else:
            self._say({"type": "done", "do": do})

    def _fly(self, order: Fly) -> None:
        try:
            hands = self._held()
            self._end_flight()
            hands.velocity(forward=order.forward, left=order.left, up=order.up, yaw_rate=order.yaw_rate)
        except SkyloopError as error:
            now_s = asyncio.get_running_loop().time()
            before, at_s = self._complained
            if str(error) != before or now_s - at_s > _SAY_AGAIN_S:
                self._complained = str(error), now_s
                self._refuse(order.do, str(error))
        else:
            self._steering = True
            self._rearm()

    def _go_to(self, order: GoTo) -> None:
        hands = self._held()
        problem = lacking(hands.feedback())
        if problem:
            raise RefusedError(f"it can't be flown to a place: {problem}")
        if not hands.feedback().state.airborne:
            raise RefusedError("it can't be flown to a place: it is not in the air, take off first")
        goal = Waypoint(order.x, order.y, order.z, order.yaw)
        self._end_flight()
        self._station.goals[self.app] = goal
        self._goto = self._job(self._follow(hands, goal))
        self._rearm()

    async def _stop(self) -> None:
        self._end_flight()
        try:
            hands = self._hands or await self._station.stopper()
        except SkyloopError as error:
            raise LinkError(f"the emergency stop was not sent: {error}") from error
        if not hands.emergency_stop():
            raise LinkError(
                f"the emergency stop was not sent: the link to the proxy is {hands.link.application}; it still is if "
                "the link is back within half a second"
            )
        self._say({"type": "done", "do": "stop"})

    async def _take(self, priority: int, ask: bool) -> None:
        hands = self._hands
        if hands is None:
            hands = self._hands = await self._station.open_hands(self.app)
            loop = asyncio.get_running_loop()
            hands.on_event(lambda event: call_soon(loop, self._hear, event), inline=True)
        self._takeover.join(ask=ask)
        try:
            await asyncio.to_thread(hands.take, priority, ask=ask)
        except SkyloopError as error:
            if hands.authority.state == "none":
                await self._drop_hands()
            if isinstance(error, AuthorityError) and error.code == "busy":
                raise AuthorityError(self._busy(priority), code="busy") from error
            raise
        self._say({"type": "done", "do": "take"})
        self._look()

    async def _answer(self, order: Answer) -> None:
        await self._takeover.answer(order, self._held())
        self._say({"type": "done", "do": order.do})

    async def _release(self) -> None:
        self._hover()
        await self._drop_hands()
        self._say({"type": "done", "do": "release"})
        self._look()

    async def _drop_hands(self) -> None:
        """Without the authority a page needs no connection of its own."""
        hands, self._hands = self._hands, None
        if hands is not None:
            await self._station.close_hands(hands)

    async def _write(self, order: Write) -> None:
        hands = self._held()

        def write() -> Any:
            hands.config[order.name] = order.value
            return hands.config[order.name]

        value = await asyncio.to_thread(write)
        self._say({"type": "done", "do": order.do, "name": order.name, "value": value})

    async def _follow(self, hands: Hands, goal: Waypoint) -> None:
        """Fly to a place. Ends there, with the first thing that goes wrong, and with the page's next order."""
        try:
            while not reached(goal, hands.feedback(max_age_s=1.0)):
                hands.command(velocity_to(goal, hands.feedback()))
                await asyncio.sleep(GOTO_PERIOD_S)
            hands.hover()
            self._say({"type": "done", "do": "goto"})
        except SkyloopError as error:
            self._refuse("goto", str(error))
            self._hover_if_held(hands)
        finally:
            if self._goto is asyncio.current_task():
                self._goto = None
                self._station.goals.pop(self.app, None)

    def _busy(self, priority: int) -> str:
        try:
            feedback = self._station.drone.feedback()
        except LinkError:
            return "another application has control"
        held = "" if feedback.owner_priority is None else f" with priority {feedback.owner_priority}"
        return (
            f"{feedback.owner or 'another application'} has control{held}, and {priority} is no higher: "
            "a lower number is a higher priority"
        )

    def _held(self) -> Hands:
        """The hands with the authority. Raises :class:`AuthorityError`."""
        hands = self._hands
        if hands is None or hands.authority.state == "none":
            raise AuthorityError("take control first", code="no_authority")
        if hands.authority.state != "held":
            raise AuthorityError(f"{hands.authority.holder or 'another application'} has control", code="no_authority")
        return hands

    # The dead-man ----------------------------------------------------------------------------------------------

    def _rearm(self) -> None:
        """The page has just been heard."""
        if self._silence is not None:
            self._silence.cancel()
            self._silence = None
        if self._steering or self._goto is not None:
            self._silence = asyncio.get_running_loop().call_later(SILENT_S, self._silent)

    def _silent(self) -> None:
        self._silence = None
        if self._steering or self._goto is not None:
            self._hover()
            self._refuse(self._last, f"the page was silent for {SILENT_S:g} s: the vehicle hovers")

    def _end_flight(self) -> None:
        """What the page flew before is over."""
        self._steering = False
        self._awaited = None
        if self._goto is not None:
            self._goto.cancel()
            self._goto = None
        self._station.goals.pop(self.app, None)

    def _hover(self) -> None:
        """Hover if this page has the vehicle under way. A take-off or landing under way ends safely by itself."""
        flies = self._steering or self._goto is not None
        self._end_flight()
        hands = self._hands
        if hands is not None and (flies or hands.flies):
            self._hover_if_held(hands)

    def _hover_if_held(self, hands: Hands) -> None:
        try:
            if hands.authority.state == "held":
                hands.hover()
        except SkyloopError:
            pass  # somebody else has it, or the link is lost: then the proxy sees to it

    # The end ---------------------------------------------------------------------------------------------------

    def _let_go(self) -> None:
        """The page is gone: hover at once."""
        if self._silence is not None:
            self._silence.cancel()
            self._silence = None
        self._hover()

    async def _leave(self) -> None:
        """Wait for what is under way, and give the authority back."""
        await asyncio.gather(*self._jobs, return_exceptions=True)
        self._hover()  # what was taken, or begun, only just now
        await self._drop_hands()
        await self._station.pilot_went()

    # What the page is told -------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Tell who has the authority, what this page is asked, and what is done, if that is news."""
        self._tell_authority()
        hands = self._hands
        if self._awaited is not None and hands is not None:
            do, states, from_ns = self._awaited
            with suppress(LinkError):
                feedback = hands.feedback()
                if feedback.captured_ns >= from_ns and feedback.state in states:
                    self._awaited = None
                    self._say({"type": "done", "do": do})

    def _tell_authority(self) -> None:
        hands, drone = self._hands, self._station.drone
        state = "none" if hands is None else hands.authority.state
        try:
            feedback = drone.feedback()
            holder, priority = feedback.owner, feedback.owner_priority
        except LinkError:
            holder, priority = None, None
        mine = state == "held"
        lost = drone.link.application in (LinkState.LOST, LinkState.CLOSED)
        if lost or (holder == self.app and not mine):  # from before
            holder, priority = None, None
        if mine and hands is not None:  # known here first
            holder, priority = self.app, hands.authority.priority
        place = self._takeover.look(hands)
        if (state, holder, priority, place) != self._authority:
            self._authority = state, holder, priority, place
            if not mine:
                self._end_flight()
            told = {"type": "authority", "state": state, "holder": holder, "priority": priority, "mine": mine}
            self._say(told | {"line": None if place is None else place.told(monotonic_ns())})

    def _hear(self, event: Event) -> None:
        """The proxy refused what this page commanded, or somebody asks for control or answers."""
        hands = self._hands
        if hands is None:
            return
        self._takeover.hear(event, hands)
        ours = event.kind is EventKind.COMMAND_REFUSED and event.app == self.app
        if not ours or self._told_of == self._orders:
            return  # its repeats are refused too, which is no news
        self._told_of = self._orders
        self._awaited = None
        self._refuse(self._last, event.text)
        if self._last == TakeOff().do:
            with suppress(SkyloopError):
                hands.idle()  # or it would take off, to everybody's surprise, once it can

    def _refuse(self, do: str, why: str) -> None:
        self._say({"type": "refused", "do": do, "why": why})

    def _begin(self, do: str, work: Coroutine[Any, Any, None], *, wait: bool = True) -> None:
        """Do what takes a moment; one after the other, unless it can't ``wait``."""
        self._job(self._work(do, work, wait))

    def _job(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        job = asyncio.create_task(work)
        self._jobs.add(job)
        job.add_done_callback(self._jobs.discard)
        return job

    async def _work(self, do: str, work: Coroutine[Any, Any, None], wait: bool) -> None:
        try:
            if wait:
                async with self._asking:
                    await work
            else:
                await work
        except SkyloopError as error:
            self._refuse(do, str(error))

    def _say(self, message: Json) -> None:
        with suppress(asyncio.QueueFull):
            self._outbox.put_nowait(message)

    async def _write_out(self) -> None:
        with suppress(WebSocketDisconnect):  # the receiving side sees it too
            while True:
                await self._socket.send_text(encode_json(await self._outbox.get()).decode())
