"""Several drones flown as one: commands to all, waiting for all, and what is done when one of them fails."""

from __future__ import annotations

import logging
import time
from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Literal, Self, TypeVar, get_args

import numpy as np

from skyloop.client.authority import AuthorityStatus
from skyloop.client.drone import Drone
from skyloop.client.flying import checked, number
from skyloop.client.parallel import in_parallel
from skyloop.client.reading import Wanted, as_predicate
from skyloop.client.statistics import DEPTH, Distribution, distribution
from skyloop.errors import (
    AuthorityError,
    ClosedError,
    LinkError,
    NoAnswerError,
    SkyloopError,
    SwarmError,
    UnknownNameError,
    UsageError,
)
from skyloop.messages import AnyAction, Attitude, Feedback, Hover, Idle, LinkState, ResetEmergency, Velocity

T = TypeVar("T")
R = TypeVar("R")
OnError = Literal["continue", "raise", "stop", "land"]

_THERE: Final = frozenset({LinkState.UP, LinkState.DEGRADED})
_ROUNDING_S: Final = 1e-6
_log = logging.getLogger("skyloop")


@dataclass(frozen=True, slots=True)
class Tick:
    """One beat of :meth:`Swarm.ticks`."""

    number: int  #: from 0
    elapsed_s: float  #: since the first
    late_s: float  #: how much later than it was due


class Swarm:
    """Drones by name, in a fixed order; made by :func:`skyloop.swarm`. A context manager; for one thread at a time.

    ``drones["alpha"]`` is one :class:`Drone`, iterating gives all. A command goes to all that are *active*. What fails
    at some never keeps the others from getting it; ``on_error`` says what follows:

    - ``"continue"``: those that failed are told to hover and are set aside, the others go on. Set aside are those in
      :attr:`errors`; one that somebody took over comes back by itself when it is given back, the others with
      :meth:`readmit`. :class:`SwarmError` is raised when none is left, and at the end of the block.
    - ``"raise"``: :class:`SwarmError` is raised, the others do what they were told.
    - ``"stop"``: the others hover, then :class:`SwarmError` is raised.
    - ``"land"``: the others land, then :class:`SwarmError` is raised.

    A drone whose link is lost gets nothing, and takes part again when the link is back; with any ``on_error`` but
    ``"continue"`` a command that could not be sent is a failure. At the end of the block all land at the same time
    (or hover, with ``on_exit``), those set aside included, each whatever happens to the others.
    """

    def __init__(
        self,
        drones: Mapping[str, Drone],
        *,
        on_error: OnError = "continue",
        missing: Mapping[str, Exception] | None = None,
    ) -> None:
        """``missing``: drones that were wanted and could not be connected to, and why."""
        self.check_policy(on_error)
        if not drones:
            raise UsageError("a swarm needs at least one drone")
        self.on_error = on_error
        self.missing = dict(missing or {})
        self._drones = dict(drones)
        self._aside: dict[str, Exception] = {}
        self._closed = False
        self._spreads_ns = array("q")

    @staticmethod
    def check_policy(on_error: str) -> None:
        """Raise :class:`UsageError` for what is no ``on_error``."""
        if on_error not in get_args(OnError):
            raise UsageError(f"on_error is {on_error!r} and must be one of {', '.join(map(repr, get_args(OnError)))}")

    # Who is in it ----------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Of all drones, those set aside included."""
        return tuple(self._drones)

    @property
    def active(self) -> dict[str, Drone]:
        """Those that commands go to, by name."""
        for name, error in list(self._aside.items()):
            if isinstance(error, AuthorityError) and self._drones[name].authority.state == "held":
                del self._aside[name]
                _log.info("%s is given back to the swarm", name)
        return {name: drone for name, drone in self._drones.items() if name not in self._aside}

    @property
    def errors(self) -> dict[str, Exception]:
        """Why drones are not with the others: those set aside, and those that were never connected to, by name."""
        return {**self.missing, **self._aside}

    def readmit(self, *names: str) -> None:
        """Take drones that were set aside back among the active ones (default: all)."""
        for name in names or list(self._aside):
            self[name]  # raises for an unknown name
            self._aside.pop(name, None)

    def items(self) -> list[tuple[str, Drone]]:
        """(name, drone) of all."""
        return list(self._drones.items())

    def __getitem__(self, name: str) -> Drone:
        drone = self._drones.get(name)
        if drone is None:
            raise UnknownNameError("drone in this swarm", name, self._drones)
        return drone

    def __iter__(self) -> Iterator[Drone]:
        return iter(self._drones.values())

    def __len__(self) -> int:
        return len(self._drones)

    def __contains__(self, name: object) -> bool:
        return name in self._drones

    def __repr__(self) -> str:
        aside = f", set aside: {', '.join(self._aside)}" if self._aside else ""
        return f"<Swarm {', '.join(self._drones)}{aside}>"

    # Commands --------------------------------------------------------------------------------------------------

    def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> dict[str, bool]:
        """All take off at the same time; waits until each hovers. Results by name, as :meth:`Drone.takeoff` says."""
        return self.each(lambda drone: drone.takeoff(wait=wait, timeout_s=timeout_s), "takeoff")

    def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> dict[str, bool]:
        """All land where they are; waits until each has landed."""
        return self.each(lambda drone: drone.land(wait=wait, timeout_s=timeout_s), "land")

    def hover(self) -> dict[str, bool]:
        """Stop and hold the place."""
        return self.command(Hover())

    def idle(self) -> dict[str, bool]:
        """Want nothing: keeps the authority and leaves the vehicles as they are."""
        return self.command(Idle())

    def velocity(
        self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """The same velocity for all, each in its own body's levelled axes [m/s], turning counter-clockwise [rad/s]."""
        return self.command(
            Velocity(number("forward", forward), number("left", left), number("up", up), number("yaw_rate", yaw_rate))
        )

    def attitude(
        self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """The same attitude for all; see :meth:`Drone.attitude`."""
        return self.command(
            Attitude(number("roll", roll), number("pitch", pitch), number("climb", climb), number("yaw_rate", yaw_rate))
        )

    def reset_emergency(self) -> dict[str, bool]:
        """Leave the emergency state, on the ground."""
        return self.command(ResetEmergency())

    def emergency_stop(self) -> dict[str, bool]:
        """Cut the motors of all at once, those set aside included: they fall. :class:`SwarmError` if some did not."""
        sent, errors = _try_all(self._drones, lambda drone: drone.emergency_stop())
        errors |= {name: _not_sent(self._drones[name]) for name, handed in sent.items() if not handed}
        if errors:
            raise SwarmError("emergency_stop", errors, len(self))
        return sent

    def command(self, action: AnyAction) -> dict[str, bool]:
        """Make any action the newest set-point of all active drones, sent at one tick."""
        return self.send(dict.fromkeys(self.active, action))

    def send(self, actions: Mapping[str, AnyAction]) -> dict[str, bool]:
        """Make each action the newest set-point of the drone of its name, all sent at one tick.

        A drone that is set aside is left out. Returns by name whether it was handed to the link now. How far apart the
        first and the last one left is measured: :attr:`spread`. Raises :class:`UnknownNameError` and
        :class:`UsageError` before anything is sent.
        """
        self._check_open()
        for name, action in actions.items():
            self[name]
            checked(action)
        active = self.active
        ready = {name: active[name] for name in actions if name in active}
        _wait_open(ready)
        stamps: list[int] = []

        def hand_over(name: str) -> bool:
            handed = ready[name].command(actions[name])
            if handed:
                stamps.append(time.monotonic_ns())
            return handed

        sent, errors = _try_all({name: name for name in ready}, hand_over)
        if len(stamps) > 1:
            self._note_spread(stamps[-1] - stamps[0])
        if self.on_error != "continue":
            errors |= {name: _not_sent(ready[name]) for name, handed in sent.items() if not handed}
        self.fail(_what(actions), errors)
        return sent

    def each(self, function: Callable[[Drone], T], what: str = "") -> dict[str, T]:
        """Call a function with each active drone, each on a thread of its own; what it returned, by name.

        A :class:`SkyloopError` that it raises is that drone's failure, called ``what`` in the report; anything else
        comes out here.
        """
        self._check_open()

        def job(drone: Drone) -> Callable[[], T]:
            return lambda: function(drone)

        results, errors = in_parallel({name: job(drone) for name, drone in self.active.items()})
        self.fail(what or getattr(function, "__name__", "each"), errors)
        return results

    def request_authority(self, priority: int | None = None, **options: Any) -> dict[str, AuthorityStatus]:
        """Ask for the right to command all; options are those of :meth:`Drone.request_authority`."""
        return self.each(lambda drone: drone.request_authority(priority, **options), "request_authority")

    def release_authority(self) -> None:
        """Give the right to command all back."""
        self.each(lambda drone: drone.release_authority(), "release_authority")

    # Reading ---------------------------------------------------------------------------------------------------

    def feedback(self, *, max_age_s: float | None = None) -> dict[str, Feedback]:
        """The newest feedback of each active drone. One whose feedback is older than ``max_age_s`` has failed."""
        self._check_open()
        found, errors = _try_all(self.active, lambda drone: drone.feedback(max_age_s=max_age_s))
        self.fail("feedback", errors)
        return found

    def wait_all(self, wanted: Wanted, timeout_s: float = 10.0) -> dict[str, Feedback]:
        """Wait until all active drones are as wanted *at the same time*: a flight state, several, or a predicate.

        A drone whose link is lost is not as wanted, whatever it told last. Those that are not as wanted in time have
        failed, and do not hold up the others longer. Returns the feedback of the others.
        """
        self._check_open()
        predicate, what = as_predicate(wanted)
        drones = self.active
        errors: dict[str, Exception] = {}
        deadline = time.monotonic() + timeout_s
        while True:
            last = time.monotonic() >= deadline
            waiting = {name: drone for name, drone in drones.items() if name not in errors}
            met, missed = _try_all(waiting, lambda drone: _wait(drone, predicate, what, deadline, timeout_s))
            errors |= missed
            if last or all(_is(waiting[name], predicate) for name in met):
                break
        self.fail(f"waiting for {what}", errors)
        return met

    def ticks(self, rate_hz: float = 20.0, seconds: float | None = None) -> Iterator[Tick]:
        """A steady beat on absolute deadlines for a loop that commands all, for ``seconds`` or until it is left.

        A loop that takes longer than a period makes the beat start anew; ``late_s`` of each tick tells.
        """
        if not 0.1 <= rate_hz <= 200.0:
            raise UsageError(f"rate_hz is {rate_hz!r} and must be from 0.1 to 200 ticks a second")
        period_s = 1.0 / rate_hz
        begun_s = due_s = time.monotonic()
        count = 0
        while not self._closed and (seconds is None or due_s - begun_s < seconds - _ROUNDING_S):
            time.sleep(max(0.0, due_s - time.monotonic()))
            late_s = max(0.0, time.monotonic() - due_s)
            yield Tick(count, due_s - begun_s, late_s)
            count += 1
            due_s = max(due_s + period_s, time.monotonic())

    @property
    def spread(self) -> Distribution | None:
        """How far apart the first and the last set-point of one tick left this process [s]; None before any."""
        return distribution(np.frombuffer(bytes(self._spreads_ns), np.int64))

    # Failures ------------------------------------------------------------------------------------------------------

    def fail(self, what: str, errors: Mapping[str, Exception]) -> None:
        """Some have failed at ``what``: do to them and to the others what ``on_error`` says, and raise if it says so.

        For whoever builds on a swarm; the swarm's own commands call it.
        """
        if not errors:
            return
        for name, error in errors.items():
            _log.warning("%s of %s failed: %s", what, name, error)
        if self.on_error == "continue":
            self._aside.update(errors)
            for name in errors:
                _halt(self._drones[name])
            if self.active:
                return
            errors = dict(self._aside)
        others = {name: drone for name, drone in self._drones.items() if name not in errors}
        if self.on_error == "stop":
            for drone in others.values():
                _halt(drone)
        elif self.on_error == "land":
            _, more = in_parallel({name: drone.land for name, drone in others.items()})
            errors = {**errors, **more}
        raise SwarmError(what, errors, len(self))

    # The end ---------------------------------------------------------------------------------------------------

    def leave(self) -> dict[str, Exception]:
        """What the end of the block does: land what flies, all at the same time, and close. What failed, by name."""
        if self._closed:
            return {}
        self._closed = True
        left, errors = in_parallel({name: drone.leave for name, drone in self._drones.items()})
        return errors | {name: problem for name, problem in left.items() if problem is not None}

    def close(self) -> None:
        """End all connections. Does not land. Idempotent."""
        self._closed = True
        in_parallel({name: drone.close for name, drone in self._drones.items()})

    def __enter__(self) -> Self:
        self._check_open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        aside = self._still_aside()
        errors = aside | self.leave()
        if not errors:
            return
        report = SwarmError("the flight", errors, len(self))
        if error is None:
            raise report
        error.add_note(str(report))

    # Inside ----------------------------------------------------------------------------------------------------

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedError("this swarm was closed: connect again")

    def _still_aside(self) -> dict[str, Exception]:
        self.active  # noqa: B018  (takes those back that were given back)
        return dict(self._aside)

    def _note_spread(self, spread_ns: int) -> None:
        self._spreads_ns.append(spread_ns)
        if len(self._spreads_ns) > DEPTH:
            del self._spreads_ns[0]


def _try_all(items: Mapping[str, T], function: Callable[[T], R]) -> tuple[dict[str, R], dict[str, Exception]]:
    """One after the other on this thread: what each returned, and what each raised, by name."""
    results: dict[str, R] = {}
    errors: dict[str, Exception] = {}
    for name, item in items.items():
        try:
            results[name] = function(item)
        except SkyloopError as error:
            errors[name] = error
    return results, errors


def _wait_open(drones: Mapping[str, Drone]) -> None:
    """Wait, a few milliseconds at most, until each takes a new set-point at once: else some would leave later."""
    open_ns = max((drone.open_ns for drone in drones.values()), default=0)
    time.sleep(max(0, open_ns - time.monotonic_ns()) / 1e9)


def _wait(
    drone: Drone, predicate: Callable[[Feedback], bool], what: str, deadline: float, timeout_s: float
) -> Feedback:
    def as_wanted(feedback: Feedback) -> bool:
        return drone.link.application in _THERE and predicate(feedback)

    try:
        return drone.wait(as_wanted, max(0.0, deadline - time.monotonic()))
    except NoAnswerError:
        link = drone.link
        lost = f", and its link is {link.application.value}" if link.application not in _THERE else ""
        state = drone.feedback().state.value
        raise NoAnswerError(f"the vehicle was not {what} within {timeout_s:g} s: it is {state}{lost}") from None


def _is(drone: Drone, predicate: Callable[[Feedback], bool]) -> bool:
    return drone.link.application in _THERE and predicate(drone.feedback())


def _halt(drone: Drone) -> None:
    """Hover, if it is ours and in the air; else want nothing, so that a take-off that failed is not done later."""
    with suppress(SkyloopError):
        if drone.authority.state == "held":
            drone.hover() if drone.feedback().state.airborne else drone.idle()


def _not_sent(drone: Drone) -> LinkError:
    link = drone.link
    return LinkError(f"the command was not sent: the link is {link.application.value} ({link.reason})")


def _what(actions: Mapping[str, AnyAction]) -> str:
    return ", ".join(sorted({action.name for action in actions.values()}))
