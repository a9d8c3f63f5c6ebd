"""The commands of a drone."""

from __future__ import annotations

import math
import numbers
import time
from collections.abc import Iterable
from typing import Final

from skyloop.client.authority import AuthorityStatus
from skyloop.client.handle import Handle
from skyloop.client.pilot import Pilot
from skyloop.client.takeover import TakeoverWay, authority_wish
from skyloop.errors import AuthorityError, ClosedError, NoAnswerError, RefusedError, UnsupportedError, UsageError
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    Attitude,
    Capabilities,
    EmergencyStop,
    Event,
    FlightState,
    Hover,
    Idle,
    Land,
    Refusal,
    ResetEmergency,
    Takeoff,
    Velocity,
)

_ACTIONS: Final = frozenset(ACTION_NAMES)
_UP: Final = frozenset({FlightState.HOVERING, FlightState.FLYING})
_DOWN: Final = frozenset({FlightState.LANDED})
_STALE_NS: Final = 100_000_000  #: feedback received so soon after a command may still be from before it


class Flying(Handle):
    """What flies the vehicle. Body axes: x forward, y left, z up; SI units and radians.

    Every command is the full desired state: it is sent at once and repeated by the library at a steady rate until
    the next one. Each returns True if it was handed to the link now and False if it could not be, because the link is
    down: then it goes out when link and authority are back, if it is younger than half a second by then. All raise
    :class:`AuthorityError` while the authority is with somebody else, :class:`UsageError` for what is no finite
    number, :class:`UnsupportedError` for a vehicle that can't fly, and :class:`ClosedError`.
    """

    _pilot: Pilot

    @property
    def capabilities(self) -> Capabilities:
        """What the vehicle can do."""
        welcome = self._reception.welcome
        return Capabilities("unknown") if welcome is None else welcome.capabilities

    @property
    def authority(self) -> AuthorityStatus:
        """This application's right to command, as of now."""
        return self._pilot.status

    def request_authority(
        self,
        priority: int | None = None,
        *,
        wait_s: float = 0.0,
        for_s: float | None = None,
        takeover: TakeoverWay = "now",
        stay: bool = False,
    ) -> AuthorityStatus:
        """Ask for the right to command, with a priority from 0 (highest) to 31; default: the one asked for before.

        A lower holder is pre-empted at once, or with ``takeover="ask"`` asked first and pre-empted when it grants or
        after the proxy's ``authority.ask_s``; with ``"ask"`` one that is not lower is asked too, and may say no. Behind
        others this waits in line for ``wait_s`` and then raises :class:`AuthorityError` naming the holder, or with
        ``stay`` stays in line and returns, with the place and the expected wait in the status. ``for_s``: for how long
        it is wanted, up to a day; when that time is over it goes to whoever wants it. Once held it is kept: after a
        lost link it is asked for again, and after a pre-emption it comes back when it is given back.
        """
        self._check_open()
        wish = authority_wish(self._pilot.status.priority if priority is None else priority, for_s, takeover)
        return self._pilot.request(wish, wait_s, stay=stay)

    def release_authority(self) -> None:
        """Give the right to command back, or leave the line."""
        self._check_open()
        self._pilot.release()

    # Commands --------------------------------------------------------------------------------------------------

    def command(self, action: AnyAction) -> bool:
        """Make any action the newest set-point."""
        return self._command(checked(action))

    @property
    def open_ns(self) -> int:
        """From when on a new set-point goes out at once, on this process's clock: a few milliseconds after the last."""
        return self._pilot.open_ns

    def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> bool:
        """Take off and hover; waits until it hovers. Raises :class:`NoAnswerError` with its state and why not."""
        return self._reach(Takeoff(), _UP, wait, timeout_s)

    def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> bool:
        """Land where it is; waits until it has landed. Raises :class:`NoAnswerError` with its state and why not.

        While it waits, a landing that a failsafe, a lost link or a lost lease has ended is asked for anew.
        """
        return self._reach(Land(), _DOWN, wait, timeout_s)

    def hover(self) -> bool:
        """Stop and hold the place."""
        return self._command(Hover())

    def idle(self) -> bool:
        """Want nothing: keeps the authority and leaves the vehicle as it is."""
        return self._command(Idle())

    def velocity(self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Fly with this velocity in the body's levelled axes [m/s], turning counter-clockwise [rad/s]."""
        return self._command(
            Velocity(number("forward", forward), number("left", left), number("up", up), number("yaw_rate", yaw_rate))
        )

    def attitude(self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0) -> bool:
        """Hold this attitude: ``roll`` right side down, ``pitch`` nose down [rad], ``climb`` up [m/s], ``yaw_rate``
        counter-clockwise [rad/s]. Positive pitch accelerates forward, positive roll to the right."""
        return self._command(
            Attitude(number("roll", roll), number("pitch", pitch), number("climb", climb), number("yaw_rate", yaw_rate))
        )

    def emergency_stop(self) -> bool:
        """Cut the motors at once: the vehicle falls. Needs no authority, only ``access="pilot"``."""
        return self._command(EmergencyStop())

    def reset_emergency(self) -> bool:
        """Leave the emergency state, on the ground."""
        return self._command(ResetEmergency())

    # Inside ----------------------------------------------------------------------------------------------------

    def _command(self, action: AnyAction) -> bool:
        if self._closed:
            self._check_open()
        welcome = self._reception.welcome
        if welcome is not None and not welcome.capabilities.actions:
            why_not = welcome.capabilities.why_not or "the vehicle takes no commands"
            raise UnsupportedError(f"{action.name} is not possible: {why_not}")
        return self._pilot.command(action)

    def _reach(self, action: AnyAction, states: Iterable[FlightState], wait: bool, timeout_s: float) -> bool:
        """Command it, and wait until feedback that is newer than the command shows one of the states."""
        reception, pilot = self._reception, self._pilot
        deadline = time.monotonic() + timeout_s
        asked_ns = reception.pace.clock()
        sent = self._command(action)
        seq = pilot.seq
        if not wait:
            return sent
        done: list[Exception | None] = []

        def look() -> bool:
            nonlocal seq
            newest = reception.newest
            if newest is not None and newest.state in states and reception.received_ns - asked_ns > _STALE_NS:
                done.append(None)
            else:
                problem = self._problem(action, seq)
                if problem is not None:
                    done.append(problem)
                elif type(action) is Land and (pilot.lapsed(action) or self._too_old(action, seq)):
                    # Nothing old is taken up again by itself, but who waits here still wants to be on the ground.
                    self._command(action)
                    seq = pilot.seq
            return bool(done)

        self._check_may_wait()
        if not reception.bell.wait_for(look, deadline - time.monotonic()):
            raise NoAnswerError(self._not_reached(action, timeout_s, asked_ns))
        if done[0] is not None:
            pilot.drop(action)  # what was refused now must not be done later, to everybody's surprise
            raise done[0]
        return sent

    def _problem(self, action: AnyAction, seq: int) -> Exception | None:
        """Why there is no use in waiting longer for what was commanded."""
        if self._closed:
            return ClosedError(f"this drone was closed while {action.name} was under way")
        status = self._pilot.status
        if status.state in ("queued", "preempted"):
            return AuthorityError(f"{action.name}: {status.holder or 'another application'} took over the authority")
        refusal = self._reception.refusal
        if refusal is None or not _concerns(refusal, seq):
            return None
        reason = refusal.data.get("reason")
        if reason == Refusal.UNSUPPORTED:
            return UnsupportedError(refusal.text)
        if reason == Refusal.WRONG_STATE:
            return RefusedError(refusal.text, code=str(reason))
        return None

    def _too_old(self, action: AnyAction, seq: int) -> bool:
        """Whether the proxy takes the newest command for one from before a failsafe or a new lease."""
        refusal = self._reception.refusal
        if refusal is None or refusal.data.get("reason") != Refusal.NOT_FRESH or not _concerns(refusal, seq):
            return False
        return self._pilot.is_newest(action)

    def _not_reached(self, action: AnyAction, timeout_s: float, asked_ns: int) -> str:
        newest, refusal = self._reception.newest, self._reception.refusal
        state = "in a state that is not known" if newest is None else newest.state.value
        text = f"{action.name} was not completed within {timeout_s:g} s: the vehicle is {state}"
        if self._reception.link.state.value not in ("up", "degraded"):
            return f"{text}, and the link is {self._reception.link.state.value} ({self._reception.link.reason})"
        if refusal is not None and refusal.at_ns >= asked_ns + self._reception.link.offset_ns:
            return f"{text}; {refusal.text}"
        return text


def _concerns(refusal: Event, seq: int) -> bool:
    """Whether a refusal is of the command with this number or of a later one."""
    refused = refusal.data.get("seq")
    return isinstance(refused, int) and refused >= seq


def checked(action: AnyAction) -> AnyAction:
    """The action, if it is one that can be commanded. Raises :class:`UsageError`."""
    if type(action) not in _ACTIONS:
        raise UsageError(f"a command is one of {', '.join(sorted(ACTION_NAMES.values()))}, not {action!r}")
    if not action.finite:
        raise UsageError(f"{action!r} has a number that is NaN or infinite")
    return action


def number(name: str, value: object) -> float:
    """A finite float. Raises :class:`UsageError` naming the argument."""
    if type(value) is not float and (isinstance(value, bool) or not isinstance(value, numbers.Real)):
        raise UsageError(f"{name} is {value!r:.60} and must be a number")
    number = float(value)
    if not math.isfinite(number):
        raise UsageError(f"{name} is {number} and must be finite")
    return number
