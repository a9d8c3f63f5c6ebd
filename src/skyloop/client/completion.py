"""Waits until an action is done: commanded once, and judged by feedback and refusals that are newer than it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final

from skyloop.client.commands import CommandSender
from skyloop.client.connection import ProxyConnection
from skyloop.client.telemetry import ClientState
from skyloop.errors import AuthorityError, ClosedError, NoAnswerError, RefusedError, UnsupportedError
from skyloop.messages import (
    AnyAction,
    Event,
    Feedback,
    FlightState,
    Land,
    Position,
    Refusal,
    ReturnPhase,
    ReturnToStart,
)
from skyloop.messages.geometry import wrap_angle

AT_REST_M_S: Final = 0.3  #: a vehicle that is slower than this at its place has arrived
_STALE_NS: Final = 100_000_000  #: feedback received sooner after a command may be older than it
_TO_PLACES: Final = (Position, ReturnToStart)
#: Refusals of one packet, not of what was asked for: the next repeat is younger, and newer.
OF_ONE_PACKET: Final = (Refusal.STALE, Refusal.OUT_OF_SEQUENCE)


def is_there(target: Position, feedback: Feedback, tolerance_m: float, tolerance_rad: float) -> bool:
    """Return whether a vehicle is in the air at a place, and nearly at rest.

    Args:
        target: The place.
        feedback: The vehicle's; without a velocity it counts as at rest.
        tolerance_m: How far from it is near enough [m].
        tolerance_rad: The same of its yaw, if it has one [rad].
    """
    if feedback.position_m is None or math.dist(feedback.position_m, target.place) > tolerance_m:
        return False
    yaw = feedback.yaw_rad
    if target.yaw is not None and (yaw is None or abs(wrap_angle(target.yaw - yaw)) > tolerance_rad):
        return False
    flies = feedback.state.airborne or feedback.state is FlightState.UNKNOWN
    return flies and (feedback.velocity_m_s is None or math.hypot(*feedback.velocity_m_s) <= AT_REST_M_S)


class ReturnWatch:
    """Whether a return is over; called with each newest feedback."""

    def __init__(self) -> None:
        """Begin before it is commanded."""
        self._began = False

    def __call__(self, feedback: Feedback) -> bool:
        """Return whether the vehicle was on its way back, and has landed since or stays above its start."""
        phase = feedback.return_phase
        self._began |= phase is not ReturnPhase.NONE
        return self._began and (phase is ReturnPhase.ARRIVED or feedback.state is FlightState.LANDED)


class ActionWait:
    """One commanded action, and the wait for newer feedback that shows that it is done."""

    def __init__(
        self,
        action: AnyAction,
        is_done: Callable[[Feedback], bool],
        send: Callable[[AnyAction], object],
        closed: Callable[[], bool],
        commands: CommandSender,
        state: ClientState,
        connection: ProxyConnection,
    ) -> None:
        """Send the action.

        Args:
            action: The action.
            is_done: Whether feedback that is newer than the action shows it.
            send: Sends it, now and where it is commanded again.
            closed: Whether the drone was closed.
            commands: Tells what became of the command.
            state: Newest feedback and refusal.
            connection: State of the link.

        Raises:
            AuthorityError: As ``send`` does.
        """
        self._action = action
        self._is_done = is_done
        self._send = send
        self._closed = closed
        self._commands = commands
        self._state = state
        self._connection = connection
        self._asked_ns = state.scheduler.clock()
        self._problem: Exception | None = None
        self._seq = commands.seq + 1  # it may be sent a little later: what was refused before it does not concern it
        send(action)

    def wait(self, timeout_s: float, deadline_s: float) -> None:
        """Wait until the action is done.

        Args:
            timeout_s: What the caller gave [s], for the error.
            deadline_s: Until when, on ``time.monotonic``.

        Raises:
            NoAnswerError: If it is not done in time.
            ClosedError: If the drone is closed.
            AuthorityError: If another application takes over.
            UnsupportedError: If the vehicle does not support it.
            RefusedError: If the proxy refuses it in the present state.
        """
        if not self._state.notifier.wait_for(self._over, deadline_s - time.monotonic()):
            raise NoAnswerError(self._not_reached(timeout_s))
        if self._problem is not None:
            self._commands.drop(self._action)  # what was refused now must not be carried out later
            raise self._problem

    def _over(self) -> bool:
        """Whether it is done, or waiting longer can't help."""
        if type(self._action) is Position:  # a vehicle may be there and be refused to stay
            self._problem = self._why_not()
            if self._problem is not None:
                return True
        newest = self._state.newest
        new = self._state.received_ns - self._asked_ns > _STALE_NS
        if newest is not None and new and self._is_done(newest):
            return True
        self._problem = self._why_not()
        if self._problem is not None:
            return True
        if type(self._action) is Land and (self._commands.lapsed(self._action) or self._is_too_old()):
            # Old set-points are not sent again by themselves, but the caller still waits for this landing.
            self._seq = self._commands.seq + 1
            self._send(self._action)
        return False

    def _why_not(self) -> Exception | None:
        """Why waiting longer can't help; None if it can."""
        name = self._action.name
        if self._closed():
            return ClosedError(f"this drone was closed while {name} was under way")
        status = self._commands.status
        if status.state in ("queued", "preempted"):
            return AuthorityError(f"{name}: {status.holder or 'another application'} took over the authority")
        if type(self._action) in _TO_PLACES and self._commands.lapsed(self._action):
            return RefusedError(
                f"{name} was ended on the way, by a failsafe or a lost link: send the command again", code="not_fresh"
            )
        if type(self._action) in _TO_PLACES and status.state == "held" and not self._commands.is_newest(self._action):
            return RefusedError(f"{name} was ended on the way: another command took its place", code="replaced")
        refusal = self._state.refusal
        if refusal is None or not self._concerns(refusal):
            return None
        reason = refusal.data.get("reason")
        if type(self._action) in _TO_PLACES and reason not in OF_ONE_PACKET:
            unsupported = reason == Refusal.UNSUPPORTED
            return UnsupportedError(refusal.text) if unsupported else RefusedError(refusal.text, code=str(reason))
        if reason == Refusal.UNSUPPORTED:
            return UnsupportedError(refusal.text)
        if reason == Refusal.WRONG_STATE:
            return RefusedError(refusal.text, code=str(reason))
        return None

    def _is_too_old(self) -> bool:
        """Whether the proxy refused the newest command as older than a failsafe or a new lease."""
        refusal = self._state.refusal
        if refusal is None or refusal.data.get("reason") != Refusal.NOT_FRESH or not self._concerns(refusal):
            return False
        return self._commands.is_newest(self._action)

    def _concerns(self, refusal: Event) -> bool:
        """Whether a refusal is of the last command sent, or of a later one."""
        refused = refusal.data.get("seq")
        return isinstance(refused, int) and refused >= self._seq

    def _not_reached(self, timeout_s: float) -> str:
        newest, refusal, connection = self._state.newest, self._state.refusal, self._connection
        state = "in a state that is not known" if newest is None else newest.state.value
        text = f"{self._action.name} was not completed within {timeout_s:g} s: the vehicle is {state}"
        if connection.state.value not in ("up", "degraded"):
            return f"{text}, and the link is {connection.state.value} ({connection.reason})"
        if refusal is not None and refusal.at_ns >= self._asked_ns + connection.offset_ns:
            return f"{text}; {refusal.text}"
        return text
