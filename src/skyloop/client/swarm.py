"""Connect, command and await several drones together, with a policy for failures."""

from __future__ import annotations

import fnmatch
import logging
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import copy_context
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Literal, Self, TypeVar, Unpack, get_args

import numpy as np

from skyloop.child_process import interrupt_deferred
from skyloop.client.actions import above_zero, checked, number, position_action, return_action
from skyloop.client.authority import AuthorityStatus, TakeoverWay
from skyloop.client.commands import GivenUpError, cancelled
from skyloop.client.connect import ConnectOptions, connect, explains_moved_options, running_names
from skyloop.client.drone import Drone, by_name
from skyloop.client.monitoring import DEPTH, Distribution, distribution
from skyloop.client.telemetry import Wanted, as_predicate
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
from skyloop.messages import (
    AnyAction,
    Attitude,
    Feedback,
    Hover,
    Idle,
    Land,
    LinkState,
    Position,
    ResetEmergency,
    Velocity,
)

T = TypeVar("T")
R = TypeVar("R")
OnError = Literal["continue", "raise", "stop", "land"]
Target = str | Mapping[str, str]
Missing = Literal["raise", "skip"]

_WILD: Final = frozenset("*?[")  #: characters that turn a name into a pattern
_THERE: Final = frozenset({LinkState.UP, LinkState.DEGRADED})
_ROUNDING_S: Final = 1e-6  #: tolerance for the rounding errors of a sum of periods
_log = logging.getLogger("skyloop")


@dataclass(frozen=True, slots=True)
class Tick:
    """One iteration of :meth:`Swarm.ticks`."""

    number: int  #: number of the tick, counted from 0
    elapsed_s: float  #: time since the first tick [s]
    late_s: float  #: delay after the tick was due [s]


@explains_moved_options
def swarm(
    *targets: Target, on_error: OnError = "continue", missing: Missing = "raise", **options: Unpack[ConnectOptions]
) -> Swarm:
    """Connect to several drones at the same time, and return once all of them are connected.

    Args:
        *targets: Names of running proxies, patterns such as ``"drone*"`` for running proxies, addresses of vehicles
            such as ``"sim://?seed=1"`` (named ``sim1``, ``sim2``, …), or mappings from a name of your choice to either,
            ``{"left": "sim://?seed=1"}``.
        on_error: What the other drones do when one fails; see :class:`Swarm`.
        missing: How to handle drones that can't be connected: ``"raise"`` fails the call, ``"skip"`` leaves them out
            as long as at least one drone connects.
        **options: As for :func:`skyloop.connect`, for each drone.

    Returns:
        The swarm, a context manager.

    Raises:
        SwarmError: If drones can't be connected, with the reason for each; the others are closed.
        UnknownNameError: If a pattern matches no running proxy.
        UsageError: If a drone is named twice, no drone is named, or ``on_error`` or ``missing`` is unknown.
    """
    if missing not in ("raise", "skip"):
        raise UsageError(f'missing is {missing!r} and must be "raise" or "skip"')
    check_policy(on_error)
    chosen = choose(targets, lambda: running_names(options.get("network")))

    def join(target: str) -> Callable[[], Drone]:
        return lambda: connect(target, **options)

    drones, errors = in_parallel({name: join(target) for name, target in chosen.items()})
    if errors and (missing == "raise" or not drones):
        end_flights(drones)
        raise SwarmError("connecting", errors, len(chosen))
    return Swarm(drones, on_error=on_error, missing=errors)


def choose(targets: Iterable[Target], running: Callable[[], Iterable[str]]) -> dict[str, str]:
    """Return the targets by name, in the given order. Pure. See :func:`swarm` for the targets and the errors.

    ``running`` returns the names of the running proxies; it is called only if a target is a pattern.
    """
    chosen: dict[str, str] = {}
    counts: dict[str, int] = {}
    for target in targets:
        for name, address in _named(target, running, counts):
            if name in chosen:
                raise UsageError(f"{name!r} is named twice: each drone can be in a swarm only once")
            chosen[name] = address
    if not chosen:
        raise UsageError('a swarm needs at least one drone: swarm("alpha", "bravo"), or a pattern, swarm("drone*")')
    return chosen


def _named(target: Target, running: Callable[[], Iterable[str]], counts: dict[str, int]) -> Iterable[tuple[str, str]]:
    if isinstance(target, Mapping):
        for name, address in target.items():
            if not isinstance(name, str) or not name or not isinstance(address, str) or not address:
                raise UsageError(f"{name!r}: {address!r} is not a drone: expected a name and a target")
        return list(target.items())
    if not isinstance(target, str) or not target:
        raise UsageError(f"{target!r} is neither the name of a proxy, a pattern, nor a vehicle's address")
    if "://" in target:
        scheme = target.partition("://")[0]
        counts[scheme] = counts.get(scheme, 0) + 1
        return [(f"{scheme}{counts[scheme]}", target)]
    if _WILD.isdisjoint(target):
        return [(target, target)]
    known = sorted(running())
    found = fnmatch.filter(known, target)
    if not found:
        raise UnknownNameError("running proxy", target, known)
    return [(name, name) for name in found]


def check_policy(on_error: str) -> None:
    """Raise :class:`UsageError` for an unknown value of ``on_error``."""
    if on_error not in get_args(OnError):
        raise UsageError(f"on_error is {on_error!r} and must be one of {', '.join(map(repr, get_args(OnError)))}")


class Swarm:
    """Drones by name, in a fixed order; :func:`skyloop.swarm` returns it. A context manager for one thread at a time.

    ``drones["alpha"]`` is one :class:`Drone`; iterating over the swarm yields all of them. A command goes to all
    *active* drones. If it fails for some drones, the others still get it, and ``on_error`` decides what happens next:

    - ``"continue"``: failed drones hover and are set aside, the others continue. :attr:`errors` lists those set aside;
      a drone taken over by another application rejoins once its authority is given back, the others through
      :meth:`readmit`. :class:`SwarmError` is raised when none is left, and at the end of the block.
    - ``"raise"``: :class:`SwarmError` is raised, the others keep their commands.
    - ``"stop"``: the others hover, then :class:`SwarmError` is raised.
    - ``"land"``: the others land, then :class:`SwarmError` is raised.

    A drone whose link is lost receives no commands until the link is restored. Failing to send a command counts as a
    failure unless ``on_error`` is ``"continue"``. At the end of the block, all drones land at the same time (or hover,
    depending on ``on_exit``), including drones that were set aside, even if some of them fail.

    Commands return a dict that maps each name to the result of the same command of :class:`Drone`. Methods that
    command, read or wait raise :class:`SwarmError` depending on ``on_error``, :class:`UsageError` for numbers that are
    not finite, and :class:`ClosedError` after the swarm was closed.
    """

    def __init__(
        self,
        drones: Mapping[str, Drone],
        *,
        on_error: OnError = "continue",
        missing: Mapping[str, Exception] | None = None,
    ) -> None:
        """Take over connected drones, given by name, and close them at the end; see :func:`skyloop.swarm`.

        ``missing`` contains the drones that could not be connected, with the reasons. Raises :class:`UsageError` if
        there are no drones or ``on_error`` is unknown.
        """
        check_policy(on_error)
        if not drones:
            raise UsageError("a swarm needs at least one drone")
        self.on_error = on_error
        self.missing = dict(missing or {})
        self._drones = dict(drones)
        self._aside: dict[str, Exception] = {}
        self._closed = False
        self._spreads_ns = array("q")

    # Members ---------------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all drones, including drones that were set aside."""
        return tuple(self._drones)

    @property
    def active(self) -> dict[str, Drone]:
        """The drones that receive commands, by name. Reading this readmits drones that have regained the authority."""
        for name, error in list(self._aside.items()):
            if isinstance(error, AuthorityError) and self._drones[name].authority.state == "held":
                del self._aside[name]
                _log.info("%s is given back to the swarm", name)
        return {name: drone for name, drone in self._drones.items() if name not in self._aside}

    @property
    def errors(self) -> dict[str, Exception]:
        """Reasons, by name, why drones do not take part: they were set aside, or were never connected."""
        return {**self.missing, **self._aside}

    def readmit(self, *names: str) -> None:
        """Reactivate drones that were set aside.

        Args:
            *names: Names of the drones; if none are given, all drones.

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names.
        """
        for name in names or list(self._aside):
            self[name]  # raises for an unknown name
            self._aside.pop(name, None)

    def items(self) -> list[tuple[str, Drone]]:
        """Return the (name, drone) pairs of all drones, including drones that were set aside."""
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

    def takeoff(self, *, wait: bool = True, timeout_s: float = 15.0) -> None:
        """Make all active drones take off at the same time; see :meth:`Drone.takeoff`.

        Args:
            wait: Whether to wait until every drone hovers.
            timeout_s: Maximum time to wait [s].
        """
        self.each(lambda drone: drone.takeoff(wait=wait, timeout_s=timeout_s), "takeoff")

    def land(self, *, wait: bool = True, timeout_s: float = 20.0) -> None:
        """Land all active drones at the same time, each at its current position; see :meth:`Drone.land`.

        Args:
            wait: Whether to wait until every drone has landed.
            timeout_s: How long to wait [s].
        """
        self.each(lambda drone: drone.land(wait=wait, timeout_s=timeout_s), "land")

    def hover(self) -> dict[str, bool]:
        """Make all active drones stop and hold position.

        Drones flown by others are left alone; to take one of them back, call ``drones[name].hover()``.
        """
        return self.send(dict.fromkeys(self.active, Hover()))

    def idle(self) -> dict[str, bool]:
        """Keep the authority without changing what the vehicles do."""
        return self.command(Idle())

    @by_name
    def velocity(
        self, *, forward: float = 0.0, left: float = 0.0, up: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """Fly all active drones at the same velocity, given in each drone's own levelled body axes.

        Args:
            forward: Velocity along x, forward [m/s].
            left: Velocity along y, to the left [m/s].
            up: Velocity along z, up [m/s].
            yaw_rate: Yaw rate, counter-clockwise seen from above [rad/s].
        """
        return self.command(
            Velocity(number("forward", forward), number("left", left), number("up", up), number("yaw_rate", yaw_rate))
        )

    @by_name
    def attitude(
        self, *, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0
    ) -> dict[str, bool]:
        """Make all active drones hold the same attitude; see :meth:`Drone.attitude`.

        Args:
            roll: Roll [rad]; right side down is positive.
            pitch: Pitch [rad]; nose down is positive.
            climb: Vertical velocity, up positive [m/s].
            yaw_rate: Counter-clockwise seen from above [rad/s].
        """
        return self.command(
            Attitude(number("roll", roll), number("pitch", pitch), number("climb", climb), number("yaw_rate", yaw_rate))
        )

    def go_to(
        self,
        places: Mapping[str, Sequence[float]],
        *,
        speed: float | None = None,
        wait: bool = True,
        timeout_s: float = 60.0,
        tolerance_m: float = 0.2,
    ) -> None:
        """Fly each drone straight to its own position, all of them at the same time; see :meth:`Drone.go_to`.

        Nothing keeps the drones apart during the flight; use :class:`skyloop.control.formation_flight.Formation` to
        plan safe paths. Drones that were set aside are skipped.

        Args:
            places: Positions by name: x, y, z in the drone's world axes [m], optionally followed by the yaw [rad].
            speed: Maximum speed [m/s]; None: as fast as the limits allow.
            wait: Whether to wait until every drone has arrived, rather than only send the commands.
            timeout_s: How long to wait [s].
            tolerance_m: Maximum distance from the position on arrival [m].

        Raises:
            UnknownNameError: If a name is not that of a drone of the swarm; nothing is sent in that case.
            UsageError: If a position is invalid; nothing is sent in that case.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
        """
        self._check_open()
        wanted = {name: _place(name, place, speed) for name, place in places.items()}
        near_m = above_zero("tolerance_m", tolerance_m)
        for name in wanted:
            self[name]

        def job(drone: Drone, to: Position) -> Callable[[], None]:
            return lambda: drone.go_to(
                x=to.x, y=to.y, z=to.z, yaw=to.yaw, speed=speed, wait=wait, timeout_s=timeout_s, tolerance_m=near_m
            )

        jobs = {name: job(drone, wanted[name]) for name, drone in self.active.items() if name in wanted}
        _, errors = in_parallel(jobs)
        self.fail("go_to", errors)

    def return_to_start(
        self, height_m: float | None = None, *, land: bool | None = None, wait: bool = True, timeout_s: float = 180.0
    ) -> None:
        """Fly all active drones back to where they took off, at the same time; see :meth:`Drone.return_to_start`.

        Nothing keeps the drones apart during the flight.

        Args:
            height_m: Minimum height above the start during the flight [m]; None: each drone's ``return.height``.
            land: Whether to land at the start instead of hovering above it; None: each drone's ``return.land``.
            wait: Whether to wait until every drone has landed or hovers above its start.
            timeout_s: How long to wait [s].

        Raises:
            UsageError: If an argument is invalid; nothing is sent in that case.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
        """
        return_action(height_m, land)
        self.each(
            lambda drone: drone.return_to_start(height_m, land=land, wait=wait, timeout_s=timeout_s), "return_to_start"
        )

    def reset_emergency(self) -> dict[str, bool]:
        """Make all active drones leave the emergency state while on the ground."""
        return self.command(ResetEmergency())

    def emergency_stop(self) -> dict[str, bool]:
        """Cut the motors of all drones immediately, including drones that were set aside: they fall.

        Raises:
            SwarmError: If the command could not be sent to some drones, regardless of ``on_error``.
        """
        sent, errors = _try_all(self._drones, lambda drone: drone.emergency_stop())
        errors |= {name: _not_sent(self._drones[name]) for name, handed in sent.items() if not handed}
        if errors:
            raise SwarmError("emergency_stop", errors, len(self))
        return sent

    def command(self, action: AnyAction) -> dict[str, bool]:
        """Make ``action`` the newest set-point of all active drones; see :meth:`send`."""
        return self.send(dict.fromkeys(self.active, action))

    def send(self, actions: Mapping[str, AnyAction]) -> dict[str, bool]:
        """Make each action the newest set-point of its drone, and send all of them at the same time.

        Drones that are set aside are skipped. A hover doesn't take a drone from someone else (see :meth:`hover`).

        Args:
            actions: Actions by drone name.

        Returns:
            For each name, True if the command was handed to the transport.

        Raises:
            UnknownNameError: If no drone of the swarm has one of the names; nothing is sent in that case.
            UsageError: If an action can't be commanded or has a number that is not finite; nothing is sent.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
        """
        self._check_open()
        for name, action in actions.items():
            self[name]
            checked(action)
        active = self.active
        ready = {name: active[name] for name in actions if name in active}
        # Wait at most a few milliseconds until every drone can send a set-point, and then send them all together.
        open_ns = max((drone._commands.schedule.open_ns for drone in ready.values()), default=0)
        time.sleep(max(0, open_ns - time.monotonic_ns()) / 1e9)
        stamps: list[int] = []

        def hand_over(name: str) -> bool:
            action, commands = actions[name], ready[name]._commands
            if type(action) is Hover:  # a hover of the swarm must not take a drone from its safety pilot
                handed = commands.command(action, automatic=type(commands.newest) is not Land)
            else:
                handed = ready[name].command(action)
            if handed:
                stamps.append(time.monotonic_ns())
            return handed

        sent, errors = _try_all({name: name for name in ready}, hand_over)
        if len(stamps) > 1:
            self._spreads_ns.append(stamps[-1] - stamps[0])
            del self._spreads_ns[:-DEPTH]
        if self.on_error != "continue":
            errors |= {name: _not_sent(ready[name]) for name, handed in sent.items() if not handed}
        self.fail(", ".join(sorted({action.name for action in actions.values()})), errors)
        return sent

    def each(self, function: Callable[[Drone], T], what: str = "") -> dict[str, T]:
        """Call ``function`` with each active drone in a separate thread, and wait for all calls.

        Args:
            function: If it raises :class:`SkyloopError`, its drone fails; other exceptions are re-raised.
            what: Name of the action for error messages; if empty, the function's name is used.

        Returns:
            The results of the calls, by drone name.
        """
        self._check_open()

        def job(drone: Drone) -> Callable[[], T]:
            return lambda: function(drone)

        results, errors = in_parallel({name: job(drone) for name, drone in self.active.items()})
        self.fail(what or getattr(function, "__name__", "each"), errors)
        return results

    def request_authority(
        self,
        priority: int | None = None,
        *,
        wait_s: float = 0.0,
        for_s: float | None = None,
        takeover: TakeoverWay = "now",
        stay: bool = False,
    ) -> dict[str, AuthorityStatus]:
        """Request the authority over all active drones; return the status of each, by name.

        The arguments are those of :meth:`Drone.request_authority`.
        """
        return self.each(
            lambda drone: drone.request_authority(priority, wait_s=wait_s, for_s=for_s, takeover=takeover, stay=stay),
            "request_authority",
        )

    def release_authority(self) -> None:
        """Release the authority over all active drones."""
        self.each(lambda drone: drone.release_authority(), "release_authority")

    # Reading ---------------------------------------------------------------------------------------------------

    def feedback(self, *, max_age_s: float | None = None) -> dict[str, Feedback]:
        """Return the newest feedback of each active drone, by name.

        Args:
            max_age_s: Maximum age since capture [s]; a drone whose feedback is older has failed.
        """
        self._check_open()
        found, errors = _try_all(self.active, lambda drone: drone.feedback(max_age_s=max_age_s))
        self.fail("feedback", errors)
        return found

    def wait_all(self, wanted: Wanted, timeout_s: float = 10.0) -> dict[str, Feedback]:
        """Wait until all active drones meet a condition *at the same time*.

        A drone whose link is lost does not meet the condition. Drones that don't meet it in time have failed.

        Args:
            wanted: A flight state or its name, several of them, or a function that tests feedback.
            timeout_s: How long to wait [s].

        Returns:
            The feedback of the drones that meet the condition, by name.

        Raises:
            UnknownNameError: If no flight state has this name.
            SwarmError: Depending on ``on_error``.
            ClosedError: If the swarm was closed.
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
            now, missed = _try_all({name: waiting[name] for name in met}, lambda drone: _is(drone, predicate))
            errors |= missed
            if last or all(now.values()):
                break
        self.fail(f"waiting for {what}", errors)
        return {name: feedback for name, feedback in met.items() if name not in errors}

    def ticks(self, rate_hz: float = 20.0, seconds: float | None = None) -> Iterator[Tick]:
        """Yield at a steady rate with absolute deadlines, for a loop that commands all drones.

        Ends when the swarm is closed. If an iteration takes longer than a period, the schedule restarts at the end of
        that iteration. When the loop ends, whether by time, a ``break``, an exception or Ctrl-C, any drone that still
        flies a velocity or attitude sent by the loop hovers immediately, because no newer command would follow.

        Args:
            rate_hz: Ticks per second, 0.1 to 200.
            seconds: Duration [s]; None: until the loop is left.

        Raises:
            UsageError: If ``rate_hz`` is out of range; the first iteration raises it.
        """
        if not 0.1 <= rate_hz <= 200.0:
            raise UsageError(f"rate_hz is {rate_hz!r} and must be from 0.1 to 200 ticks a second")
        period_s = 1.0 / rate_hz
        begun_s = due_s = time.monotonic()
        count = 0
        try:
            while not self._closed and (seconds is None or due_s - begun_s < seconds - _ROUNDING_S):
                time.sleep(max(0.0, due_s - time.monotonic()))
                late_s = max(0.0, time.monotonic() - due_s)
                yield Tick(count, due_s - begun_s, late_s)
                count += 1
                due_s = max(due_s + period_s, time.monotonic())
        finally:  # after a break or an exception in the loop, Python closes this generator and runs this immediately
            for drone in self:
                if isinstance(drone._commands.newest, Velocity | Attitude):
                    drone._piloting.let_go("the loop that flew it has ended")

    @property
    def spread(self) -> Distribution | None:
        """Times between the first and the last command of each :meth:`send` [s], over the last 1024; None if none."""
        return distribution(np.frombuffer(bytes(self._spreads_ns), np.int64))

    # Failures ------------------------------------------------------------------------------------------------------

    def fail(self, what: str, errors: Mapping[str, Exception]) -> None:
        """Apply ``on_error`` after a failure of some drones. Does nothing if ``errors`` is empty.

        The swarm's own commands call this method; programs that build on a swarm may call it, too.

        Args:
            what: Name of the failed action, for the error message.
            errors: The exceptions, by drone name.

        Raises:
            SwarmError: Depending on ``on_error``.
        """
        if not errors:
            return
        for name, error in errors.items():
            _log.warning("%s of %s failed: %s", what, name, error)
        if self.on_error == "continue":
            self._aside.update(errors)
            for name in errors:
                self._drones[name]._piloting.let_go(f"{what} failed")
            if self.active:
                return
            errors = dict(self._aside)
        others = {name: drone for name, drone in self._drones.items() if name not in errors}
        if self.on_error == "stop":
            for drone in others.values():
                drone._piloting.let_go(f"{what} of another drone failed")
        elif self.on_error == "land":
            reason = f"{what} of another drone failed"
            errors = {**errors, **_problems(others, lambda drone: drone._piloting.bring_down(reason))}
        raise SwarmError(what, errors, len(self))

    # The end ---------------------------------------------------------------------------------------------------

    def _leave(self) -> dict[str, Exception]:
        """End the block: land all flying drones at the same time, then close. Return the errors by name. Idempotent."""
        if self._closed:
            return {}
        self._closed = True
        for drone in self._drones.values():
            if not drone.closed:
                drone._commands.bar()  # bar all drones before the first of them lands
        return end_flights(self._drones)

    def close(self) -> None:
        """End all connections. Does not land the drones. Idempotent."""
        self._closed = True
        with interrupt_deferred():
            in_parallel({name: drone.close for name, drone in self._drones.items()})

    def __enter__(self) -> Self:
        self._check_open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.active  # noqa: B018  (readmits drones that were given back)
        errors = dict(self._aside) | self._leave()
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


def _try_all(items: Mapping[str, T], function: Callable[[T], R]) -> tuple[dict[str, R], dict[str, Exception]]:
    """Call ``function`` for each item in turn; return its results and its :class:`SkyloopError`, by name.

    Any other exception is raised only after the function was called for every item.
    """
    results: dict[str, R] = {}
    raised: dict[str, Exception] = {}
    for name, item in items.items():
        try:
            results[name] = function(item)
        except Exception as error:  # noqa: BLE001  (the others get their turn first)
            raised[name] = error
    return results, _expected(raised)


def _expected(raised: Mapping[str, BaseException]) -> dict[str, Exception]:
    """Return the exceptions if all of them are Skyloop's own; otherwise raise the first other exception."""
    errors: dict[str, Exception] = {}
    for name, error in raised.items():
        if not isinstance(error, SkyloopError):
            raise error
        errors[name] = error
    return errors


def _place(name: str, numbers: Sequence[float], speed: float | None) -> Position:
    if not 3 <= len(numbers) <= 4:
        raise UsageError(
            f"the position of {name} is {numbers!r:.60} and must be x, y, z [m], with or without yaw [rad]"
        )
    x, y, z, yaw = (*numbers, None)[:4]
    return position_action(x, y, z, yaw, speed)


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


def end_flights(drones: Mapping[str, Drone]) -> dict[str, Exception]:
    """End the flights of all drones at the same time and close the drones; return the errors by name.

    Ctrl-C stops waiting for the landings, but each drone is still commanded to land, and lands without this program.
    """
    return _problems(drones, lambda drone: drone._piloting.end_flight())


def _problems(drones: Mapping[str, Drone], end: Callable[[Drone], SkyloopError | None]) -> dict[str, Exception]:
    """Land all drones, or end all flights, at the same time; return the errors by drone name."""

    def job(drone: Drone) -> Callable[[], SkyloopError | None]:
        def ended() -> SkyloopError | None:
            try:
                return end(drone)
            except GivenUpError:  # no caller waits for the result any longer
                return None

        return ended

    with interrupt_deferred() as interrupted:
        ended, errors = in_parallel({name: job(drone) for name, drone in drones.items()}, interrupted)
    return errors | {name: problem for name, problem in ended.items() if problem is not None}


def _not_sent(drone: Drone) -> LinkError:
    link = drone.link
    return LinkError(f"the command was not sent: the link is {link.application.value} ({link.reason})")


def in_parallel(
    jobs: Mapping[str, Callable[[], T]], interrupted: threading.Event | None = None
) -> tuple[dict[str, T], dict[str, Exception]]:
    """Run all jobs at the same time, each in its own thread, and wait until all of them have ended.

    The threads are daemons. If no thread can be started for a job, the job runs on the calling thread. An interrupt, or
    setting ``interrupted``, stops the jobs from waiting for commands (see :data:`skyloop.client.commands.cancelled`).
    Their other work ends normally.

    Returns:
        The result of each job, and the :class:`SkyloopError` that each job raised, both by name. Any other exception is
        re-raised on the calling thread after all jobs have ended.
    """
    results: dict[str, T] = {}
    raised: dict[str, BaseException] = {}
    interrupted, outside = interrupted or threading.Event(), cancelled.get()

    def work(name: str, job: Callable[[], T]) -> None:
        cancelled.set(lambda: interrupted.is_set() or outside())
        try:
            results[name] = job()
        except BaseException as error:  # noqa: BLE001  (raised below, on the caller's thread)
            raised[name] = error

    threads: list[threading.Thread] = []
    left: list[str] = []
    for name, job in jobs.items():
        thread = threading.Thread(target=work, args=(name, job), name=f"skyloop-swarm-{name}", daemon=True)
        try:
            thread.start()
        except RuntimeError:  # no thread is available, but the drone must still land
            left.append(name)
        else:
            threads.append(thread)
    try:
        for name in left:
            copy_context().run(work, name, jobs[name])
            if not isinstance(raised.get(name), Exception | None):
                raise raised[name]  # Ctrl-C on this thread: don't start any more jobs
        for thread in threads:
            thread.join()
    except BaseException:  # after Ctrl-C, a take-off must not be executed later
        interrupted.set()
        raise
    errors = _expected({name: raised[name] for name in jobs if name in raised})
    return {name: results[name] for name in jobs if name in results}, errors
