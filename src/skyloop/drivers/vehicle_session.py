"""Provide what all vehicle sessions share: the link's state and its reasons, pending events, the emergency stop.

Pure except for :func:`serial_trouble`, which inspects the device of the port.
"""

from __future__ import annotations

import errno
import os
import socket
import stat
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum, auto
from pathlib import Path
from typing import ClassVar, Final, TypeAlias

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.base import Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import DriverError
from skyloop.messages import AnyAction, EventKind, Idle, Land, LinkState, Parameter, ParameterType, Severity, Value

REPORT_AGAIN_NS: Final = nanoseconds(2.0)  #: minimum time between two reported reasons while nothing is received
_BUSY: Final = (errno.EBUSY, errno.EAGAIN)  # error numbers if another program has locked the port
_PORTS: Final = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "ttyAMA*", "cu.usb*")  # patterns of port names below /dev
_MAX_LISTED_PORTS: Final = 4  # maximum number of ports that a message lists

SinkCallback: TypeAlias = Callable[[Sink], None]


@dataclass(frozen=True, slots=True)
class OwnLimit:
    """A limit that a driver keeps itself: an option in the vehicle's address, and a parameter."""

    name: str  #: name of the parameter, ``limits.`` and the option's name
    usual: float  #: default value
    low: float
    high: float
    unit: str
    text: str

    @property
    def option(self) -> str:
        """Name of the option."""
        return self.name.partition(".")[2]

    def given(self, uri: VehicleUri) -> float:
        """Return the value in an address; raise :class:`UsageError` if it is out of range."""
        return uri.number(self.option, self.usual, minimum=self.low, maximum=self.high)

    def parameter(self, value: float) -> Parameter:
        """Return the parameter with its current value."""
        kind, text = ParameterType.FLOAT, self.text
        return Parameter(self.name, kind, value, self.unit, self.low, self.high, self.usual, description=text)


def deliver(sink: Sink, pending: Iterable[SinkCallback]) -> None:
    """Pass the pending callbacks of a session to a sink."""
    for publish in pending:
        publish(sink)


@dataclass(frozen=True, slots=True)
class LinkTimeouts:
    """Times without data [ns] after which a vehicle's link counts as degraded or lost."""

    degraded_ns: int
    lost_ns: int
    first_data_ns: int  #: time after opening before a vehicle that has sent no data is reported as lost


@dataclass(frozen=True, slots=True)
class VehicleEvent:
    """A session's event for the sink; its fields are the arguments of :meth:`skyloop.drivers.base.Sink.event`."""

    kind: EventKind
    text: str
    severity: Severity = Severity.INFO
    data: dict[str, Value] = field(default_factory=dict)


def message(text: str, reason: str, severity: Severity = Severity.INFO, **data: Value) -> VehicleEvent:
    """Return an event that contains a message from the vehicle itself."""
    return VehicleEvent(EventKind.VEHICLE_MESSAGE, text, severity, {"reason": reason, **data})


class PacketOrder(Enum):
    """How a packet's number relates to earlier numbers."""

    NEW = auto()
    LATE = auto()  #: packets with higher numbers arrived earlier
    RESTARTED = auto()  #: the vehicle has restarted and counts from the beginning again


RESTART_RUN: Final = 5  #: number of packets with low, increasing numbers that prove a restart
RESTART_SPAN_NS: Final = nanoseconds(0.02)  #: minimum time from first to last, to rule out a single burst


class RestartWatch:
    """Distinguishes a restart of the vehicle from late packets by the packets' increasing numbers. Pure.

    Packets whose numbers lag by at most ``tolerance`` are accepted. Numbers wrap around to 0 at ``wrap``; 0: never.
    """

    def __init__(self, tolerance: int = 0, wrap: int = 0) -> None:
        self._tolerance, self._wrap = tolerance, wrap
        self._newest: int | None = None
        self._behind: tuple[int, int, int] | None = None  # last low number, how many there were, arrival of the first

    def forget(self) -> None:
        """Accept the next packet as new, because nothing has been received from the vehicle for a while."""
        self._newest = self._behind = None

    def update(self, number: int, now_ns: int) -> PacketOrder:
        """Classify a packet that has just arrived, by its number."""
        step = 0 if self._newest is None else self._step(self._newest, number)
        if step >= -self._tolerance:
            self._newest, self._behind = number if step >= 0 else self._newest, None
            return PacketOrder.NEW
        last, count, since_ns = self._behind or (number, 0, now_ns)
        if self._step(last, number) < 0:
            count, since_ns = 0, now_ns
        self._behind = number, count + 1, since_ns
        if count + 1 < RESTART_RUN or now_ns - since_ns < RESTART_SPAN_NS:
            return PacketOrder.LATE
        self._newest, self._behind = number, None
        return PacketOrder.RESTARTED

    def _step(self, before: int, number: int) -> int:
        step = number - before
        # Numbers that wrap jump by nearly the whole range. A smaller jump back is a late packet or a restart.
        if abs(step) < 0.99 * self._wrap or not self._wrap:
            return step
        return step + self._wrap if step < 0 else step - self._wrap


#: If nothing is received, a request is kept (or keeps being sent) for this long after its last repeat. Applications
#: repeat what they still want; without this limit, an old request could interfere with another application's flight.
KEPT_NS: Final = nanoseconds(3.0)


class VehicleSession(ABC):
    """The protocol between one opened driver and its vehicle. Not thread-safe.

    The time is an argument, and bytes go in and out. Calls to the proxy's sink are collected as callbacks. The caller
    runs them without holding any lock. A subclass for a kind of vehicle sets ``_received_ns`` on each valid packet, and
    calls :meth:`_check_silence` on each poll.
    """

    TIMEOUTS: ClassVar[LinkTimeouts]

    def __init__(self, now_ns: int) -> None:
        self.due_ns = now_ns  #: time at which there is next something to send
        self.link_state: LinkState | None = None  #: last state reported
        self._pending: list[SinkCallback] = []
        self._opened_ns = now_ns
        self._received_ns: int | None = None  # when data last arrived; None: not since the link was opened or lost
        self._unreachable = ""
        self._remedy = ""  # what to do if the vehicle is unreachable
        self._reported_reason = ""
        self._reported_ns = now_ns
        self._landing_ns: int | None = None  # time of the last landing request or, if later, of the last data

    @property
    def is_receiving(self) -> bool:
        """Whether data is arriving from the vehicle, or was arriving until a moment ago."""
        return self._received_ns is not None

    @abstractmethod
    def command(self, action: AnyAction, now_ns: int) -> AnyAction:
        """Accept an action; return the action applied within the limits. Raises DriverError on failure."""

    @abstractmethod
    def close(self) -> None:
        """End the session; callers that wait for an answer get a failure."""

    def unreachable(self, reason: str) -> None:
        """Record why the vehicle can't be reached: no program listens, there is no route, or the connection failed."""
        self._unreachable, self._remedy = reason, ""

    def failed(self, error: OSError) -> None:
        """Record an error of a socket or a port, with a remedy for the user."""
        trouble = self._trouble(error)
        self._unreachable, self._remedy = trouble.reason, trouble.remedy

    def connected(self) -> None:  # noqa: B027  most connections need nothing
        """Handle a new connection; data from older connections no longer arrives."""

    def broken(self, error: OSError, now_ns: int) -> None:
        """Handle an open connection that accepts no more data: the vehicle counts as lost even if it still sends."""
        self.failed(error)
        self.due_ns = now_ns
        if self._received_ns is not None:
            self._lose(f"the connection failed: {self._unreachable}", now_ns)

    def drain(self) -> list[SinkCallback]:
        """Remove and return the callbacks for the sink, in order."""
        for event in self._new_events():
            self._publish_event(event)
        pending, self._pending = self._pending, []
        return pending

    def _new_events(self) -> Iterable[VehicleEvent]:
        """Return the events specific to this kind of vehicle that were added since the last call."""
        return ()

    @abstractmethod
    def _describe_silence(self, since: str, why: str) -> str:
        """Return the text to display while nothing is received.

        ``since`` (the duration) and ``why`` (the host's reason) are phrases that start with a space. Both may be empty.
        """

    def _advice(self) -> str:
        """Return an instruction to display to the user while nothing is received although nothing has failed."""
        return "check the vehicle's power, and host and port in the address"

    def _trouble(self, error: OSError) -> LinkTrouble:
        return trouble_of(error, self._advice())

    @abstractmethod
    def _lose(self, reason: str, now_ns: int, /) -> None:
        """Discard all state of the lost vehicle; its next packet is treated as the first."""

    def _keep(self, action: AnyAction, now_ns: int) -> None:
        """Record an accepted action; while nothing is received, a landing is remembered for a limited time."""
        if not isinstance(action, Idle):
            self._landing_ns = now_ns if isinstance(action, Land) else None

    def _forget_landing(self) -> bool:
        """Cancel a pending landing; return whether there was one."""
        return False

    def _check_landing(self, now_ns: int) -> None:
        if self._landing_ns is None:
            return
        if self._received_ns is not None:
            self._landing_ns = now_ns
        elif now_ns - self._landing_ns >= KEPT_NS:
            self._landing_ns = None
            if self._forget_landing():
                text = (
                    f"the landing was abandoned: the vehicle was silent for {seconds(KEPT_NS):g} s since the "
                    "last request: land it again when it is back"
                )
                self._publish_event(message(text, "landing_given_up", Severity.ERROR))

    def _check_silence(self, now_ns: int) -> None:
        self._check_landing(now_ns)
        patience = self.TIMEOUTS
        if self._received_ns is None:
            if self.link_state is LinkState.CONNECTING and now_ns - self._opened_ns >= patience.first_data_ns:
                self._reported_ns = now_ns
                self._set_link_state(LinkState.LOST, self._silence_text())
            elif self._unreachable != self._reported_reason and now_ns - self._reported_ns >= REPORT_AGAIN_NS:
                self._reported_ns = now_ns
                self._report_link(LinkState.LOST, self._silence_text())
            return
        silent_ns = now_ns - self._received_ns
        if silent_ns >= patience.lost_ns:
            self._lose(self._silence_text(silent_ns), now_ns)
        elif silent_ns >= patience.degraded_ns and self.link_state is LinkState.UP:
            self._set_link_state(LinkState.DEGRADED, self._silence_text(silent_ns))

    def _silence_seen_ns(self, latest_ns: int) -> int:
        """Return when :meth:`_check_silence` must be called next, which is never later than ``latest_ns``."""
        if self._received_ns is None:
            return latest_ns
        patience = self.TIMEOUTS.degraded_ns if self.link_state is LinkState.UP else self.TIMEOUTS.lost_ns
        return min(latest_ns, self._received_ns + patience)

    def _silence_text(self, silent_ns: int | None = None) -> str:
        since = f" for {seconds(silent_ns):.2g} s" if silent_ns is not None else ""
        return self._describe_silence(since, f" ({self._unreachable})" if self._unreachable else "")

    def _set_link_state(self, state: LinkState, reason: str = "") -> None:
        if state is not self.link_state:
            self._report_link(state, reason)

    def _report_link(self, state: LinkState, reason: str) -> None:
        self.link_state, self._reported_reason = state, self._unreachable
        remedy = ""
        if state in (LinkState.CONNECTING, LinkState.LOST):
            remedy = (self._remedy if self._unreachable else "") or self._advice()
        self._pending.append(lambda sink: sink.link(state, reason, remedy))

    def _publish_event(self, event: VehicleEvent) -> None:
        self._pending.append(lambda sink: sink.event(event.kind, event.text, event.severity, **event.data))


@dataclass(frozen=True, slots=True)
class LinkTrouble:
    """Why a vehicle can't be reached."""

    reason: str  #: what failed; may be empty
    remedy: str = ""  #: an instruction for the user; may be empty


def trouble_of(error: OSError, advice: str) -> LinkTrouble:
    """Describe a socket's error."""
    if isinstance(error, socket.gaierror):
        remedy = "correct the name in the address, or join a network where it is known"
        return LinkTrouble(f"its name is unknown: {error.strerror}", remedy)
    reason = error.strerror or str(error) or type(error).__name__
    if error.errno == errno.EADDRINUSE:
        return LinkTrouble(reason, "end the other program that uses this port, or give another one in the address")
    return LinkTrouble(reason, advice)


def serial_trouble(error: OSError, port: str, advice: str, devices: Path = Path("/dev")) -> LinkTrouble:
    """Describe why a serial port can't be opened or has disappeared, and list the other ports in ``devices``."""
    if sys.platform == "win32":
        return _windows_trouble(error, port, advice)
    path = Path(port)
    try:
        status = path.stat()
    except PermissionError:
        return LinkTrouble(f"{port} can't be accessed", f"let this user enter {path.parent}")
    except OSError:
        there = sorted(str(found) for pattern in _PORTS for found in devices.glob(pattern))
        return _no_port(port, there)
    if not stat.S_ISCHR(status.st_mode):
        return LinkTrouble(f"{port} is not a serial port", "correct the port in the address")
    if not os.access(path, os.R_OK | os.W_OK):
        return LinkTrouble(
            f"this user may not open {port} (mode {stat.S_IMODE(status.st_mode):04o})", _permission(port, status)
        )
    if error.errno in _BUSY:
        return _busy(port)
    return LinkTrouble(error.strerror or str(error) or type(error).__name__, advice)


def _windows_trouble(error: OSError, port: str, advice: str) -> LinkTrouble:
    from serial.tools.list_ports import comports  # from pyserial, which raised the error

    there = sorted(str(found.device) for found in comports())
    if port not in there:
        return _no_port(port, there)
    # There, ports are always opened for exclusive use. pyserial's error has no number, but quotes the system's error.
    return _busy(port) if "PermissionError" in str(error) else LinkTrouble(str(error), advice)


def _no_port(port: str, there: list[str]) -> LinkTrouble:
    known = f"; available ports: {', '.join(there[:_MAX_LISTED_PORTS])}" if there else ""
    return LinkTrouble(f"there is no {port}", f"plug the vehicle in, or correct the port in the address{known}")


def _busy(port: str) -> LinkTrouble:
    return LinkTrouble(f"another program uses {port}", "end it (a ground station, ModemManager, another proxy)")


def _permission(port: str, status: os.stat_result) -> str:
    if not status.st_mode & stat.S_IRGRP or not status.st_mode & stat.S_IWGRP or status.st_gid == 0:
        return f"add a udev rule that lets this user open {port}"
    group = str(status.st_gid)
    if sys.platform != "win32":
        import grp

        with suppress(KeyError):
            group = grp.getgrgid(status.st_gid).gr_name
    return f"join the group {group}: sudo usermod -a -G {group} $USER, then log in again"


PACE_NS: Final = nanoseconds(0.1)  #: interval between repeats of the stop
GIVE_UP_NS: Final = nanoseconds(10.0)  #: a stop not confirmed by the vehicle this long after the press is abandoned
AGAIN_NS: Final = nanoseconds(0.3)  #: pause after which a request counts as a new press rather than a repeat
SETTLE_NS: Final = nanoseconds(0.5)  #: reports that arrive sooner than this after the press may be older than it


class MotorStop:
    """One emergency stop, for any driver, from the press until it is reset or abandoned.

    A driver knows how to detect that the motors are off, and which bytes stop them. This class decides everything else.
    While the stop is :attr:`active`, the driver sends and obeys nothing else. The stop is sent immediately, whether or
    not the vehicle is sending data, and then every 0.1 s until the vehicle confirms it. Until then, the reported state
    is the vehicle's own. If the vehicle has not confirmed the stop 10 s after the press, the stop is abandoned: it must
    not be sent minutes later, and the vehicle must be free to land. Not thread-safe.
    """

    def __init__(self, give_up: Callable[[VehicleEvent], None]) -> None:
        self._give_up = give_up
        self._begun_ns: int | None = None  # time of the first press
        self._pressed_ns = 0  # time of the newest press, without repeats
        self._asked_ns = 0  # time of the newest press or repeat
        self._sent_ns: int | None = None
        self._shown = self._was_shown = False

    @property
    def active(self) -> bool:
        """Whether the stop was pressed and has been neither reset nor abandoned since then."""
        return self._begun_ns is not None

    @property
    def shown(self) -> bool:
        """Whether the stop is active and the vehicle's last report says motors off; the state is then ``EMERGENCY``."""
        return self.active and self._shown

    def press(self, now_ns: int) -> None:
        """Stop the motors, or continue to stop them. Each press restarts the time limit."""
        if self._begun_ns is None:
            self._begun_ns, self._sent_ns, self._shown, self._was_shown = now_ns, None, False, False
            self._pressed_ns = now_ns
        elif now_ns - self._asked_ns >= AGAIN_NS:
            self._pressed_ns = now_ns
        self._asked_ns = now_ns

    def settled(self, seen_ns: int) -> bool:
        """Return whether a report received at ``seen_ns`` must have been sent after the press."""
        return self._begun_ns is not None and seen_ns - self._begun_ns >= SETTLE_NS

    def step(self, shown: bool | None, now_ns: int) -> bool:
        """Advance an active stop; return whether to send it now. Must be called at every tick, even without telemetry.

        ``shown``: whether the vehicle reports that its motors are off; None if there is no new report.
        """
        if self._begun_ns is None:
            return False
        if shown is not None:
            self._shown = shown
            self._was_shown |= shown
        if self._shown:
            return False
        if now_ns - self._pressed_ns >= GIVE_UP_NS:
            self._end_unshown()
            return False
        if self._sent_ns is not None and now_ns - self._sent_ns < PACE_NS:
            return False
        self._sent_ns = now_ns
        return True

    def reset(self) -> None:
        """Allow the motors to run again. Does nothing if no stop is active.

        Raises :class:`DriverError` if the vehicle has not confirmed the stop, which is then still being sent.
        """
        if self.active and not self.shown:
            raise DriverError("the motors still run, or are still armed: the stop is not confirmed yet")
        self._begun_ns = None

    def _end_unshown(self) -> None:
        self._begun_ns = None
        if self._was_shown:
            text = "the emergency stop is over: someone else reset the vehicle or started its motors again"
        else:
            text = (
                f"the emergency stop has ended: the vehicle has not confirmed it for {seconds(GIVE_UP_NS):g} s, and "
                "may still be flying: land it, or stop it again"
            )
        self._give_up(message(text, "stop_given_up", Severity.ERROR))
