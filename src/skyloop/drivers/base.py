"""Define the contract between the proxy and a vehicle's driver. ``docs/drivers.md`` explains how to write one.

A driver implements the native protocol of one vehicle family and knows nothing about networks, applications or
authority. It converts units and axes: everything above it uses SI units and the body axes x forward, y left, z up. Its
class is registered in the entry-point group ``skyloop.drivers``; the name of the entry is its URI scheme.
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

    Any thread may call any method; all methods return quickly and never raise. Every ``captured_ns`` is a time on this
    host's ``time.monotonic_ns``.
    """

    def feedback(self, feedback: Feedback) -> None:
        """Publish the vehicle's newest state.

        Args:
            feedback: The state; the driver fills in the vehicle's block of fields. The proxy's fields (``seq``,
                ``published_ns``, ``lease``, ``owner``, …) stay at their defaults. Unknown numbers are None, never NaN.
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
        """Publish a complete frame.

        Args:
            camera: Name of a camera in :meth:`Driver.capabilities`.
            pixels: C-contiguous uint8 array; the driver may reuse it after the call. Raw encodings need exactly
                ``height * width * channels`` bytes; a JPEG is one file.
            captured_ns: Time of capture, on this host's monotonic clock.
            width: Width of the image [px].
            height: Height of the image [px].
            encoding: Encoding of ``pixels``.
            intrinsics: Intrinsics for this image size; None if unknown.
        """

    def wants(self, camera: str) -> bool:
        """Return whether anything currently uses this camera's frames. If not, the driver need not decode them."""

    def wanted_fps(self, camera: str) -> float:
        """Return the highest rate at which any consumer currently uses this camera's frames [frames/s].

        0 means that no consumer uses them; infinity means that all frames are used. If frames are expensive, a driver
        may skip frames beyond this rate.
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
        """Publish a frame as the vehicle encoded it, for a camera whose ``CameraInfo`` announces ``stream="h264"``.

        The size, time and intrinsics are those of the decoded frame. While anything uses frames, the driver also passes
        the decoded frame to :meth:`frame`.

        Args:
            camera: A name from :meth:`Driver.capabilities`.
            data: One undamaged H.264 access unit in Annex B format. The stream must have no B-frames. Key frames
                include SPS and PPS. Any other frame must continue the frame passed before it. After a gap, or after a
                period without receivers, start with a key frame.
            captured_ns: When the frame was captured, on this host's monotonic clock.
            width: Width [px].
            height: Height [px].
            key: Whether decoding can start with this frame.
            intrinsics: Intrinsics for this size; None if unknown.
        """

    def wants_stream(self, camera: str) -> bool:
        """Return whether anything currently receives this camera's encoded frames."""

    def link(self, state: LinkState, reason: str = "", remedy: str = "") -> None:
        """Report a new state of the vehicle link, or a new reason for its current state.

        Args:
            state: UP once the vehicle answers.
            reason: What the link is waiting for, and the last failure. Shown to every client.
            remedy: What the user can do about it, as an instruction ("join its Wi-Fi network"). All clients see it.
        """

    def event(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: Value) -> None:
        """Emit an event.

        Args:
            kind: Kind of the event.
            text: Human-readable text.
            severity: Severity, for display and filters.
            **data: Data for programs.
        """


class ServedLink(Protocol):
    """A vehicle link served by a host; one thread of the host may serve the links of several vehicles."""

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when :meth:`serve` must be called."""

    def serve(self, *, readable: bool) -> int | None:
        """Do all pending work; never wait. Errors raised here have already been reported; the host retries later.

        Args:
            readable: Whether :meth:`fileno` is readable; if not, the previously returned deadline has passed.

        Returns:
            Deadline of the next call, on the monotonic clock [ns]; None: call :meth:`end` instead.
        """

    def end(self) -> None:
        """Release the link's resources."""


AHEAD_NS: Final = nanoseconds(0.05)  #: maximum lead of a pose's time: the accuracy of two hosts' clock offset


@dataclass(frozen=True, slots=True)
class ExternalPose:
    """A vehicle's pose measured from outside, for example by motion capture.

    Raises :class:`UsageError` if a number is not finite, if a standard deviation is negative, or if the quaternion's
    length differs from 1 by more than 0.001.
    """

    position_m: Vector  #: position of the body's origin in world axes, x east, y north, z up [m]
    quaternion: tuple[float, float, float, float]  #: rotation (x, y, z, w) from body (forward, left, up) to world axes
    captured_ns: int  #: time of the measurement, on this host's monotonic clock
    position_std_m: float | None = None  #: standard deviation of the position [m], 0 or more; None if unknown
    attitude_std_rad: float | None = None  #: standard deviation of the orientation [rad], 0 or more; None if unknown

    def __post_init__(self) -> None:
        check_pose(self.position_m, self.quaternion, self.position_std_m, self.attitude_std_rad)

    def bounded(self, now_ns: int) -> ExternalPose:
        """Return the pose with its time limited to the present, which drivers require.

        Raises :class:`DriverError` if the time is more than 50 ms ahead: the clock behind it is wrong.
        """
        ahead_ns = self.captured_ns - now_ns
        if ahead_ns > AHEAD_NS:
            raise DriverError(f"the pose is stamped {seconds(ahead_ns):.2g} s ahead of our clock, more than 0.05 s")
        return self if ahead_ns <= 0 else replace(self, captured_ns=now_ns)


class Driver(ABC):
    """Base class for drivers. Owns the life cycle; subclasses implement the abstract methods and, to fly, ``_apply``.

    No I/O happens before :meth:`open`. Times passed to the sink are times of ``time.monotonic_ns`` on this host.
    ``_open(sink)`` starts threads without waiting, ``_close()`` joins them and clears all set-points, and
    ``_apply(action)`` implements :meth:`apply`. This class owns the attributes ``uri`` and ``_sink``.

    Args:
        uri: Address of the vehicle, including its options.

    Attributes:
        shared: Whether others may also fly the vehicle. If so, a vehicle found in the air is theirs and is left alone.
        parameters_without_authority: Names of parameters that any pilot may write because they don't affect a flight.
        serve_link: Set by a host before :meth:`open` if one of its threads serves several vehicles; None: the driver
            uses its own thread.

    Raises:
        UsageError: If a subclass does not know an option; see :func:`reject_unknown_options`.
    """

    shared = True
    parameters_without_authority: frozenset[str] = frozenset()
    serve_link: Callable[[ServedLink], None] | None = None

    def __init__(self, uri: VehicleUri) -> None:
        """Store the address. Subclasses read their options here and do no I/O."""
        self.uri = uri
        self.__lock = threading.Lock()  # name-mangled because subclasses may have their own _lock
        self._sink: Sink | None = None

    # Abilities ------------------------------------------------------------------------------------------------

    @abstractmethod
    def capabilities(self) -> Capabilities:
        """Return the vehicle's capabilities.

        May be called before :meth:`open`. Where possible, the proxy emulates missing actions in software.
        """

    def parameters(self) -> list[Parameter]:
        """Return the vehicle's own parameters that are known so far, with their current values.

        Names are dotted and in lower case. May be called before the vehicle has answered.
        """
        return []

    def set_parameter(self, name: str, value: Value) -> Value:  # noqa: ARG002
        """Write one parameter and return its new value.

        Called on the proxy's request thread; may take up to a second.

        Args:
            name: Name of a parameter in :meth:`parameters`.
            value: The value; its type and range have been checked against :meth:`parameters`.

        Returns:
            The new value, which the vehicle may have rounded.

        Raises:
            ParameterError: If the vehicle refuses the value; the message gives the reason.
        """
        raise ParameterError(f"{name} cannot be written", code=Refusal.READ_ONLY)

    # Life cycle ------------------------------------------------------------------------------------------------

    def open(self, sink: Sink) -> None:
        """Start communicating with the vehicle. Returns immediately; the sink receives the state of the link.

        An unreachable vehicle is not an error: the driver keeps trying.

        Args:
            sink: Receives everything that the vehicle reports, until :meth:`close` returns.

        Raises:
            UsageError: If the driver is already open, or if another error occurred that a retry can't fix.
            MissingExtraError: If a package that the driver needs is not installed.
        """
        with self.__lock:
            if self._sink is not None:
                raise UsageError(f"{self.uri} is already open")
            self._sink = sink
        try:
            self._open(sink)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop threads and release resources. Idempotent.

        Does not land the vehicle; the proxy has already done so. After this returns, the sink is no longer called.
        """
        with self.__lock:
            was_open, self._sink = self._sink is not None, None
        if was_open:
            self._close()

    # Flying ----------------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, *, new: bool = True) -> AnyAction:
        """Execute an action until the next call.

        Must not block for more than a few milliseconds. The proxy makes one call at a time, only with actions listed in
        :meth:`capabilities`, and only with finite numbers.

        Args:
            action: A set-point or a one-time action. Without telemetry, a take-off is refused rather than postponed.
            new: Whether this is a new request from an application. If not, the library repeats or continues an earlier
                request, which must not take the vehicle back from another controller.

        Returns:
            The action as limited by the vehicle.

        Raises:
            DriverError: If the vehicle can't execute the action; the message is shown to users.
        """
        return self._apply(action) if new else self._repeat(action)

    def check(self, action: AnyAction) -> None:  # noqa: B027  most vehicles refuse nothing
        """Refuse a request to the software autopilot that the vehicle would certainly not follow.

        Called before the software autopilot starts an action that the vehicle itself does not support. For example, a
        vehicle that can't be armed refuses the take-off. Returns immediately.

        Args:
            action: Take-off, hover, land, velocity or position.

        Raises:
            DriverError: If the vehicle would not follow the request; the message is shown to users.
        """

    def left_to(self) -> str:
        """Return what others have made the vehicle do since the driver's last command, such as ``RTL``.

        Override this if the vehicle reports such changes. The proxy calls this several times a second. A vehicle that
        someone else flies is left alone until a new action takes it over. Thread-safe; returns immediately.

        Returns:
            The driver's name for what they did; empty if they did nothing.
        """
        return ""

    def failsafe(self, action: Hover | Land) -> bool:
        """Apply an action while no pilot commands the vehicle. Never raises.

        The driver reports a failure as an event, and the proxy retries.

        Args:
            action: A hover or a landing.

        Returns:
            Whether the driver accepted the action.
        """
        sink = self._sink
        try:
            self._alone(action)
        except Exception as error:  # noqa: BLE001  a failsafe must return whatever the driver's code does
            if sink is not None:
                sink.event(EventKind.DRIVER_ERROR, f"failsafe {action.name} failed: {error!r}", Severity.ERROR)
            return False
        return True

    # Abilities of some vehicles --------------------------------------------------------------------------------------

    def external_pose(self, pose: ExternalPose) -> None:  # noqa: ARG002
        """Send the vehicle its own pose as measured by motion capture, for flight without GPS.

        Thread-safe; returns at once.

        Args:
            pose: Position and orientation of the vehicle in world axes.

        Raises:
            UnsupportedError: If the vehicle does not accept external poses.
            DriverError: If the pose can't be sent now.
        """
        raise UnsupportedError(f"{self.uri.scheme}:// does not accept external poses")

    def checkup(self) -> list[Diagnostic]:
        """Return findings about the vehicle and its settings that need attention before a flight.

        ``skyloop doctor`` and ``drone.preflight()`` show them. Called on any thread while the driver is open; must not
        wait.
        """
        return []

    # To be implemented by drivers -------------------------------------------------------------------------------------

    @abstractmethod
    def _open(self, sink: Sink) -> None: ...

    @abstractmethod
    def _close(self) -> None: ...

    def _apply(self, action: AnyAction) -> AnyAction:
        raise UsageError(f"{self.uri.scheme} does not support {action.name}")

    def _repeat(self, action: AnyAction) -> AnyAction:
        """Apply a repeated action; see :meth:`apply`. Override this if someone else may also fly the vehicle."""
        return self._apply(action)

    def _alone(self, action: Hover | Land) -> AnyAction:
        """Apply a failsafe's action; see :meth:`failsafe`. Override this if it must differ from a pilot's action."""
        return self._apply(action)


def reject_unknown_options(uri: VehicleUri, known: set[str]) -> None:
    """Raise :class:`UnknownNameError` for the first option of the URI that is not in ``known``."""
    for name in uri.options:
        if name not in known:
            raise UnknownNameError(f"option of {uri.scheme}://", name, known)


def checked_value(parameter: Parameter, value: Value) -> Value:
    """Check a new value for a scalar parameter and return it; the value for a float parameter is converted to float.

    Raises:
        ParameterError: If the value has the wrong type, is out of range, or is not one of the choices.
    """
    name, kind = parameter.name, parameter.type
    if kind in (ParameterType.FLOAT, ParameterType.INT) and not parameter.choices:
        whole = kind is ParameterType.INT
        if isinstance(value, bool) or not isinstance(value, int | float) or (whole and value % 1):
            raise ParameterError(f"{name} takes a {'whole ' * whole}number, not {value!r:.60}", code=Refusal.WRONG_TYPE)
        low = -sys.float_info.max if parameter.minimum is None else parameter.minimum
        high = sys.float_info.max if parameter.maximum is None else parameter.maximum
        if not low <= value <= high:  # also rejects NaN, infinities and huge ints
            raise ParameterError(f"{name} must be from {low:g} to {high:g}, not {value!r}", code=Refusal.OUT_OF_RANGE)
        return value if whole else float(value)
    if type(value) is not type(parameter.value):
        raise ParameterError(f"{name} takes a {kind.value}, not {value!r:.60}", code=Refusal.WRONG_TYPE)
    if parameter.choices and value not in parameter.choices:
        names = [str(choice) for choice in parameter.choices]
        raise ParameterError(str(UnknownNameError(name, str(value), names)), code=Refusal.OUT_OF_RANGE)
    return value
