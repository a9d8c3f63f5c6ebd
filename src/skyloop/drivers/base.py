"""The contract between the proxy and a vehicle's driver. ``docs/drivers.md`` shows how to write one.

A driver speaks one vehicle family's native protocol and knows nothing of the network, of applications or of
authority. It converts units and axes at its edge: above it are SI units and body axes x forward, y left, z up. Its
class is registered under the entry-point group ``skyloop.drivers`` with its URI scheme as the name.
"""

from __future__ import annotations

import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import DriverError, ParameterError, UnknownNameError, UnsupportedError, UsageError
from skyloop.messages import (
    AnyAction,
    Capabilities,
    Encoding,
    EventKind,
    Feedback,
    Hover,
    Intrinsics,
    Land,
    LinkState,
    Parameter,
    ParameterType,
    Refusal,
    Severity,
    Value,
    Vector,
)
from skyloop.messages.command import check_pose
from skyloop.messages.parameter import Diagnostic


class Sink(Protocol):
    """Receives a driver's feedback, frames, link states and events.

    All methods may be called from any thread, return quickly and never raise. Every ``captured_ns`` is
    ``time.monotonic_ns`` of this host.
    """

    def feedback(self, feedback: Feedback) -> None:
        """Publish the vehicle's newest state.

        Args:
            feedback: With the vehicle's block filled in. The proxy's fields (``seq``, ``published_ns``, ``lease``,
                ``owner`` and the like) keep their defaults. A number that is not known is None, never NaN.
        """

    def frame(
        self,
        camera: str,
        pixels: NDArray[np.uint8],
        captured_ns: int,
        *,
        width: int,
        height: int,
        encoding: Encoding = Encoding.BGR8,
        intrinsics: Intrinsics | None = None,
    ) -> None:
        """Publish a whole frame.

        Args:
            camera: A name that :meth:`Driver.capabilities` lists.
            pixels: C-contiguous uint8. Raw encodings have exactly ``height * width * channels`` bytes; JPEG is one
                file. May be reused when the call returns.
            captured_ns: When the frame was captured, on this host's monotonic clock.
            width: [px]
            height: [px]
            encoding: Of ``pixels``.
            intrinsics: For this size, None if they are not known.
        """

    def wants(self, camera: str) -> bool:
        """Return whether anybody uses this camera's frames now. If not, a driver may save itself the decoding."""

    def wanted_fps(self, camera: str) -> float:
        """Return how many of this camera's frames a second are used now, by whoever uses most of them.

        0: none; infinity: all. A driver for which a frame is expensive may leave out what exceeds it.
        """

    def stream(
        self,
        camera: str,
        data: bytes,
        captured_ns: int,
        *,
        width: int,
        height: int,
        key: bool,
        intrinsics: Intrinsics | None = None,
    ) -> None:
        """Publish a picture as the vehicle encoded it, of a camera whose ``CameraInfo`` announces ``stream="h264"``.

        Size, time and intrinsics are those of the decoded frame, which goes to :meth:`frame` as well while somebody
        wants that.

        Args:
            camera: A name that :meth:`Driver.capabilities` lists.
            data: One access unit of H.264 in Annex B form, undamaged, with SPS and PPS if it is a key picture, of a
                stream without B pictures. One that is no key picture follows the picture that was given last: begin
                with a key picture after a gap, and after a while in which nobody wanted any.
            captured_ns: When the picture was captured, on this host's monotonic clock.
            width: [px]
            height: [px]
            key: Whether decoding can begin with this picture.
            intrinsics: For this size, None if they are not known.
        """

    def wants_stream(self, camera: str) -> bool:
        """Return whether anybody receives this camera's encoded pictures now."""

    def link(self, state: LinkState, reason: str = "", remedy: str = "") -> None:
        """Report a new state of the vehicle link, or a new reason for the present one.

        Args:
            state: UP once the vehicle answers.
            reason: What is waited for, and what failed last. Shown to everybody.
            remedy: What a person can do about it, as an instruction ("join its Wi-Fi network"). Shown to everybody.
        """

    def event(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: Value) -> None:
        """Emit an event that a person or a program may want to know about.

        Args:
            kind: Of the event.
            text: For people.
            severity: For people and for filters.
            **data: For programs.
        """


class ServedLink(Protocol):
    """A link to a vehicle that a host serves on a thread of its own, together with those of other vehicles."""

    def fileno(self) -> int:
        """Return what becomes readable when :meth:`serve` is to be called."""

    def serve(self, *, readable: bool) -> int | None:
        """Do what there is to do, without waiting. What it raises is reported already; it is tried again after a pause.

        Args:
            readable: Whether :meth:`fileno` is; if not, only the time asks for it.

        Returns:
            When to call it again at the latest, on the monotonic clock [ns]; None: never, but :meth:`end` once.
        """

    def end(self) -> None:
        """Release its resources."""


AHEAD_NS: Final = nanoseconds(0.05)  #: a pose may be stamped so far ahead: two hosts' clocks are known no better


@dataclass(frozen=True, slots=True)
class ExternalPose:
    """Where something outside of the vehicle, such as motion capture, saw it.

    Args:
        position_m: Of the body's origin in world axes, x east, y north, z up [m].
        quaternion: (x, y, z, w), rotates body axes (x forward, y left, z up) to world axes.
        captured_ns: When it was measured, on this host's monotonic clock.
        position_std_m: Standard deviation of the position [m], 0 or more; None if it is not known.
        attitude_std_rad: Standard deviation of the orientation [rad], 0 or more; None if it is not known.

    Raises:
        UsageError: A number is not finite, a standard deviation is negative, or the quaternion's length differs from 1
            by more than 0.001.
    """

    position_m: Vector
    quaternion: tuple[float, float, float, float]
    captured_ns: int
    position_std_m: float | None = None
    attitude_std_rad: float | None = None

    def __post_init__(self) -> None:
        check_pose(self.position_m, self.quaternion, self.position_std_m, self.attitude_std_rad)

    def bounded(self, now_ns: int) -> ExternalPose:
        """Return the pose with a time that is not in the future; drivers take no other.

        Args:
            now_ns: The present time, on this host's monotonic clock.

        Raises:
            DriverError: It is stamped more than 50 ms ahead: a wrong clock, and all that follow would look old.
        """
        ahead_ns = self.captured_ns - now_ns
        if ahead_ns > AHEAD_NS:
            raise DriverError(f"a pose is stamped {seconds(ahead_ns):.2g} s ahead of this host's clock, at most 0.05 s")
        return self if ahead_ns <= 0 else replace(self, captured_ns=now_ns)


class Driver(ABC):
    """Base class of drivers: owns the life cycle; a subclass writes what is abstract and, if it flies, ``_apply``.

    No I/O happens before :meth:`open`. Times given to the sink are ``time.monotonic_ns`` of this host. ``_open(sink)``
    starts threads and waits for nothing, ``_close()`` joins them and forgets what was in force, and ``_apply(action)``
    does what :meth:`apply` says. The attributes ``uri`` and ``_sink`` are this class's own.

    Args:
        uri: The vehicle's address with its options.

    Attributes:
        shared: Whether others may fly the vehicle too. If so, one that is found in the air is theirs and left alone.
        parameters_without_authority: Names of parameters that any pilot may write: those that move nothing that flies.
        serve_link: Set by a host before :meth:`open`, for a thread that serves several vehicles; None: the driver has
            a thread of its own.

    Raises:
        UsageError: A subclass raises it for an option that it does not know; see :func:`reject_unknown_options`.
    """

    shared = True
    parameters_without_authority: frozenset[str] = frozenset()
    serve_link: Callable[[ServedLink], None] | None = None

    def __init__(self, uri: VehicleUri) -> None:
        """Store the address. A subclass reads its options here, and does no I/O."""
        self.uri = uri
        self.__lock = threading.Lock()  # of this class alone: a driver may well have a _lock of its own
        self._sink: Sink | None = None

    # What it can do --------------------------------------------------------------------------------------------

    @abstractmethod
    def capabilities(self) -> Capabilities:
        """Return what the vehicle can do.

        May be called before :meth:`open`. The proxy emulates actions that are not named in software where it can.
        """

    def parameters(self) -> list[Parameter]:
        """Return the vehicle's own parameters with their present values, those known so far.

        Names are dotted and lower-case. May be called before the vehicle has answered.
        """
        return []

    def set_parameter(self, name: str, value: Value) -> Value:  # noqa: ARG002
        """Write one parameter and return the value that is now in force.

        Called on the proxy's request thread; may take up to a second.

        Args:
            name: A name that :meth:`parameters` lists.
            value: Type and range were checked against :meth:`parameters`.

        Returns:
            The value in force, which a vehicle may have rounded.

        Raises:
            ParameterError: The vehicle refuses it; with the vehicle's own reason.
        """
        raise ParameterError(f"{name} cannot be written", code=Refusal.READ_ONLY)

    # Life cycle ------------------------------------------------------------------------------------------------

    def open(self, sink: Sink) -> None:
        """Start to talk to the vehicle. Returns at once; the state of the link goes to the sink.

        A vehicle that does not answer is no error: the driver keeps trying.

        Args:
            sink: Receives everything that the vehicle reports, until :meth:`close` returns.

        Raises:
            UsageError: The driver is open already, or for something else that trying again can't mend.
            MissingExtraError: A package that this vehicle needs is not installed.
        """
        with self.__lock:
            if self._sink is not None:
                raise UsageError(f"{self.uri} is open already")
            self._sink = sink
        try:
            self._open(sink)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop threads and release resources. Idempotent.

        Does not land the vehicle: the proxy does that before. The sink is not called after it returns.
        """
        with self.__lock:
            was_open, self._sink = self._sink is not None, None
        if was_open:
            self._close()

    # Flying ----------------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, *, new: bool = True) -> AnyAction:
        """Make the vehicle perform an action until the next call.

        Must not block longer than a few milliseconds. The proxy makes one call at a time, with actions that
        :meth:`capabilities` names and with finite numbers.

        Args:
            action: A set-point or a one-time action. A take-off without telemetry is refused, and not kept for
                later.
            new: Whether an application newly asked for it. If not, it is the library's repeat of an earlier request, or
                what became of one, and keeps in force what is in force: it never takes the vehicle back from somebody
                else.

        Returns:
            What was applied, after the vehicle's limits.

        Raises:
            DriverError: The vehicle can't do it; the text is shown to people.
        """
        return self._apply(action) if new else self._repeat(action)

    def check(self, action: AnyAction) -> None:  # noqa: B027  most vehicles refuse nothing
        """Refuse what the software autopilot is asked for, where the vehicle is sure not to do it.

        Called before the software autopilot begins with an action that the vehicle does not take itself; a vehicle that
        can't be armed refuses the take-off. Returns at once.

        Args:
            action: Take-off, hover, land, velocity or position.

        Raises:
            DriverError: The vehicle would not do it; the text is shown to people.
        """

    def left_to(self) -> str:
        """Return what others made of the vehicle since it was last commanded from here, such as ``RTL``.

        For vehicles that report it. The proxy asks several times a second and leaves alone what others fly; a new
        action takes the vehicle over and ends this. May be called from any thread; returns at once.

        Returns:
            The driver's word for it, empty if nothing was changed.
        """
        return ""

    def failsafe(self, action: Hover | Land) -> bool:
        """Apply an action while nobody is in command. Never raises.

        A failure is emitted as an event, and the proxy tries again.

        Args:
            action: Hover or land.

        Returns:
            Whether the driver accepted it.
        """
        sink = self._sink
        try:
            self._alone(action)
        except Exception as error:  # noqa: BLE001  a failsafe must come back whatever the driver's code does
            if sink is not None:
                sink.event(EventKind.DRIVER_ERROR, f"failsafe {action.name} failed: {error!r}", Severity.ERROR)
            return False
        return True

    # What some vehicles can do besides ---------------------------------------------------------------------------

    def external_pose(self, pose: ExternalPose) -> None:  # noqa: ARG002
        """Send the vehicle its pose as motion capture measured it, for flight without GPS.

        May be called from any thread; returns at once.

        Args:
            pose: Position and orientation in world axes.

        Raises:
            UnsupportedError: The vehicle accepts no poses from outside.
            DriverError: The pose can't be sent now.
        """
        raise UnsupportedError(f"{self.uri.scheme}:// takes no poses from outside")

    def checkup(self) -> list[Diagnostic]:
        """Return what about the vehicle and its settings needs attention before flying.

        ``skyloop doctor ADDRESS`` and ``drone.preflight()`` show it. Called while the driver is open, from any thread;
        returns at once.
        """
        return []

    # To be written by a driver ---------------------------------------------------------------------------------

    @abstractmethod
    def _open(self, sink: Sink) -> None: ...

    @abstractmethod
    def _close(self) -> None: ...

    def _apply(self, action: AnyAction) -> AnyAction:
        raise UsageError(f"{self.uri.scheme} takes no {action.name}")

    def _repeat(self, action: AnyAction) -> AnyAction:
        """Apply a repeat; see :meth:`apply`. Override it where somebody else may fly the vehicle too."""
        return self._apply(action)

    def _alone(self, action: Hover | Land) -> AnyAction:
        """Apply what a failsafe asks for; see :meth:`failsafe`. Override it where that differs from a pilot's wish."""
        return self._apply(action)


def reject_unknown_options(uri: VehicleUri, known: set[str]) -> None:
    """Raise an error for an option of the URI that the driver does not know.

    Args:
        uri: The vehicle's address.
        known: Every option that the driver reads.

    Raises:
        UnknownNameError: For the first option that is not in ``known``.
    """
    for name in uri.options:
        if name not in known:
            raise UnknownNameError(f"option of {uri.scheme}://", name, known)


def checked_value(parameter: Parameter, value: Value) -> Value:
    """Return a new value of a parameter that is no vector, as a float where it is one.

    Raises:
        ParameterError: It is of another type, out of range, or none of the choices.
    """
    name, kind = parameter.name, parameter.type
    if kind in (ParameterType.FLOAT, ParameterType.INT) and not parameter.choices:
        whole = kind is ParameterType.INT
        if isinstance(value, bool) or not isinstance(value, int | float) or (whole and value % 1):
            raise ParameterError(f"{name} takes a {'whole ' * whole}number, not {value!r:.60}", code=Refusal.WRONG_TYPE)
        low = -sys.float_info.max if parameter.minimum is None else parameter.minimum
        high = sys.float_info.max if parameter.maximum is None else parameter.maximum
        if not low <= value <= high:  # NaN, infinities and ints of any size, too
            raise ParameterError(f"{name} is from {low:g} to {high:g}, not {value!r}", code=Refusal.OUT_OF_RANGE)
        return value if whole else float(value)
    if type(value) is not type(parameter.value):
        raise ParameterError(f"{name} takes a {kind.value}, not {value!r:.60}", code=Refusal.WRONG_TYPE)
    if parameter.choices and value not in parameter.choices:
        names = [str(choice) for choice in parameter.choices]
        raise ParameterError(str(UnknownNameError(name, str(value), names)), code=Refusal.OUT_OF_RANGE)
    return value
