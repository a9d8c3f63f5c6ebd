"""The contract between the proxy and a vehicle's driver. ``docs/drivers.md`` shows how to write one.

A driver speaks the native protocol of one vehicle family and knows nothing about the network, applications or
authority. It converts units and axes at its edge: everything above it uses SI units and body axes x forward, y left, z
up. Its class is registered under the entry-point group ``skyloop.drivers`` with its URI scheme as the name.
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

    All methods may be called from any thread, return quickly and never raise. Every ``captured_ns`` is on the clock of
    ``time.monotonic_ns`` on this host.
    """

    def feedback(self, feedback: Feedback) -> None:
        """Publish the vehicle's newest state.

        Args:
            feedback: The state, with the vehicle's block of fields filled in. The proxy's fields (``seq``,
                ``published_ns``, ``lease``, ``owner``, …) keep their defaults. Unknown numbers are None, never NaN.
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
            camera: A name from :meth:`Driver.capabilities`.
            pixels: C-contiguous uint8 array, which may be reused after the call. Raw encodings have exactly
                ``height * width * channels`` bytes; JPEG is one file.
            captured_ns: When the frame was captured, on this host's monotonic clock.
            width: Width [px].
            height: Height [px].
            encoding: Encoding of ``pixels``.
            intrinsics: Intrinsics for this size; None if unknown.
        """

    def wants(self, camera: str) -> bool:
        """Return whether this camera's frames are currently used. If not, a driver need not decode them."""

    def wanted_fps(self, camera: str) -> float:
        """Return the highest rate, in frames per second, at which any consumer currently uses this camera's frames.

        0 means none, infinity means all. If frames are expensive, a driver may skip those beyond this rate.
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
        """Publish a frame as encoded by the vehicle, for a camera whose ``CameraInfo`` announces ``stream="h264"``.

        Size, time and intrinsics are the same as those of the decoded frame. While frames are in use, the decoded frame
        is also passed to :meth:`frame`.

        Args:
            camera: A name from :meth:`Driver.capabilities`.
            data: One undamaged H.264 access unit in Annex B format, from a stream without B-frames. Key frames
                include SPS and PPS. Any other frame must continue the one passed before it: after a gap, or after a
                period without receivers, start with a key frame.
            captured_ns: When the frame was captured, on this host's monotonic clock.
            width: Width [px].
            height: Height [px].
            key: Whether decoding can start with this frame.
            intrinsics: Intrinsics for this size; None if unknown.
        """

    def wants_stream(self, camera: str) -> bool:
        """Return whether anyone is currently receiving this camera's encoded frames."""

    def link(self, state: LinkState, reason: str = "", remedy: str = "") -> None:
        """Report a new state of the vehicle link, or a new reason for the current one.

        Args:
            state: UP once the vehicle answers.
            reason: What is being waited for, and the last failure. Shown to every client.
            remedy: What the user can do about it, as an instruction ("join its Wi-Fi network"). Shown to every client.
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
    """A vehicle link served by a host, whose thread may serve the links of several vehicles."""

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when :meth:`serve` must be called."""

    def serve(self, *, readable: bool) -> int | None:
        """Do all pending work without waiting. Errors raised have already been reported; the host retries later.

        Args:
            readable: Whether :meth:`fileno` is readable; if not, the deadline returned last has passed.

        Returns:
            Deadline of the next call, on the monotonic clock [ns]; None: call :meth:`end` instead.
        """

    def end(self) -> None:
        """Release the link's resources."""


AHEAD_NS: Final = nanoseconds(0.05)  #: how far in the future a pose may be: accuracy of two hosts' clock offset


@dataclass(frozen=True, slots=True)
class ExternalPose:
    """A vehicle's pose as measured from outside, for example by motion capture.

    Raises :class:`UsageError` if a number is not finite, a standard deviation is negative, or the quaternion's length
    differs from 1 by more than 0.001.
    """

    position_m: Vector  #: position of the body's origin in world axes, x east, y north, z up [m]
    quaternion: tuple[float, float, float, float]  #: rotation (x, y, z, w) from body (forward, left, up) to world axes
    captured_ns: int  #: time of the measurement, on this host's monotonic clock
    position_std_m: float | None = None  #: standard deviation of the position [m], 0 or more; None if unknown
    attitude_std_rad: float | None = None  #: standard deviation of the orientation [rad], 0 or more; None if unknown

    def __post_init__(self) -> None:
        check_pose(self.position_m, self.quaternion, self.position_std_m, self.attitude_std_rad)

    def bounded(self, now_ns: int) -> ExternalPose:
        """Return the pose with its timestamp limited to the present, as drivers require.

        Raises :class:`DriverError` if it is more than 50 ms ahead: the clock is wrong, and all later poses would look
        old.
        """
        ahead_ns = self.captured_ns - now_ns
        if ahead_ns > AHEAD_NS:
            raise DriverError(f"the pose is stamped {seconds(ahead_ns):.2g} s ahead of our clock, more than 0.05 s")
        return self if ahead_ns <= 0 else replace(self, captured_ns=now_ns)


class Driver(ABC):
    """Base class for drivers. Owns the life cycle; subclasses implement the abstract methods and, to fly, ``_apply``.

    No I/O happens before :meth:`open`. Times passed to the sink are from ``time.monotonic_ns`` on this host.
    ``_open(sink)`` starts threads and does not wait, ``_close()`` joins them and clears all set-points, and
    ``_apply(action)`` implements :meth:`apply`. The attributes ``uri`` and ``_sink`` belong to this class.

    Args:
        uri: The vehicle's address with its options.

    Attributes:
        shared: Whether others may also fly the vehicle. If so, a vehicle found in the air is considered theirs.
        parameters_without_authority: Names of parameters that any pilot may write, because they don't affect a flight.
        serve_link: Set by a host before :meth:`open`, for a thread that serves several vehicles; None: the driver has
            its own thread.

    Raises:
        UsageError: If a subclass does not know an option; see :func:`reject_unknown_options`.
    """

    shared = True
    parameters_without_authority: frozenset[str] = frozenset()
    serve_link: Callable[[ServedLink], None] | None = None

    def __init__(self, uri: VehicleUri) -> None:
        """Store the address. Subclasses read their options here, without I/O."""
        self.uri = uri
        self.__lock = threading.Lock()  # name-mangled, because subclasses may have a _lock of their own
        self._sink: Sink | None = None

    # Abilities ------------------------------------------------------------------------------------------------

    @abstractmethod
    def capabilities(self) -> Capabilities:
        """Return the vehicle's capabilities.

        May be called before :meth:`open`. The proxy emulates missing actions in software where possible.
        """

    def parameters(self) -> list[Parameter]:
        """Return the vehicle's own parameters, as far as they are known yet, with their current values.

        Names are dotted and lower-case. May be called before the vehicle has answered.
        """
        return []

    def set_parameter(self, name: str, value: Value) -> Value:  # noqa: ARG002
        """Write one parameter and return its new value.

        Called on the proxy's request thread; may take up to a second.

        Args:
            name: A name from :meth:`parameters`.
            value: The value; type and range have been checked against :meth:`parameters`.

        Returns:
            The value in force, which the vehicle may have rounded.

        Raises:
            ParameterError: If the vehicle refuses the value; the message gives its reason.
        """
        raise ParameterError(f"{name} cannot be written", code=Refusal.READ_ONLY)

    # Life cycle ------------------------------------------------------------------------------------------------

    def open(self, sink: Sink) -> None:
        """Start communicating with the vehicle. Returns at once; the state of the link is reported to the sink.

        An unreachable vehicle is not an error: the driver keeps trying.

        Args:
            sink: Receives everything that the vehicle reports, until :meth:`close` returns.

        Raises:
            UsageError: If the driver is already open, or another error occurred that a retry can't fix.
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

        Does not land the vehicle, because the proxy has already done so. The sink is not called after this returns.
        """
        with self.__lock:
            was_open, self._sink = self._sink is not None, None
        if was_open:
            self._close()

    # Flying ----------------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, *, new: bool = True) -> AnyAction:
        """Execute an action until the next call.

        Must not block for more than a few milliseconds. The proxy makes one call at a time, only with actions in
        :meth:`capabilities`, and with finite numbers.

        Args:
            action: A set-point or a one-time action. If there is no telemetry, a take-off is refused rather than
                postponed.
            new: Whether it is a new request from an application. If not, the library repeats or continues an earlier
                request, which must not take the vehicle back from another controller.

        Returns:
            The action as limited by the vehicle.

        Raises:
            DriverError: If the vehicle can't execute it; the message is shown to users.
        """
        return self._apply(action) if new else self._repeat(action)

    def check(self, action: AnyAction) -> None:  # noqa: B027  most vehicles refuse nothing
        """Refuse a request to the software autopilot that the vehicle would certainly not obey.

        Called before the software autopilot starts an action that the vehicle does not support itself. For example, a
        vehicle that can't be armed refuses the take-off. Returns at once.

        Args:
            action: Take-off, hover, land, velocity or position.

        Raises:
            DriverError: If the vehicle would not obey it; the message is shown to users.
        """

    def left_to(self) -> str:
        """Return what others have made the vehicle do since our last command, such as ``RTL``.

        Override this if the vehicle reports such changes. The proxy calls it several times a second. A vehicle flown
        by others is left alone until a new action takes it over. Thread-safe; returns at once.

        Returns:
            The driver's name for it; empty if others have done nothing.
        """
        return ""

    def failsafe(self, action: Hover | Land) -> bool:
        """Apply an action while no pilot is in command. Never raises.

        The driver reports a failure as an event, and the proxy retries.

        Args:
            action: Hover or land.

        Returns:
            Whether the driver accepted it.
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
        """Send the vehicle its own pose from motion capture, for flight without GPS.

        Thread-safe; returns at once.

        Args:
            pose: Position and orientation in world axes.

        Raises:
            UnsupportedError: If the vehicle does not accept external poses.
            DriverError: If the pose can't be sent at present.
        """
        raise UnsupportedError(f"{self.uri.scheme}:// does not accept external poses")

    def checkup(self) -> list[Diagnostic]:
        """Return findings about the vehicle and its settings that need attention before flying.

        ``skyloop doctor ADDRESS`` and ``drone.preflight()`` show them. Called while the driver is open, from any
        thread; returns at once.
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
        """Apply a repeat; see :meth:`apply`. Override this if others may fly the vehicle, too."""
        return self._apply(action)

    def _alone(self, action: Hover | Land) -> AnyAction:
        """Apply a failsafe's action; see :meth:`failsafe`. Override this if it must differ from a pilot's request."""
        return self._apply(action)


def reject_unknown_options(uri: VehicleUri, known: set[str]) -> None:
    """Raise :class:`UnknownNameError` for the first of the URI's options that is not in ``known``."""
    for name in uri.options:
        if name not in known:
            raise UnknownNameError(f"option of {uri.scheme}://", name, known)


def checked_value(parameter: Parameter, value: Value) -> Value:
    """Check a new value for a scalar parameter; return it, converted to float if the parameter is a float.

    Raises:
        ParameterError: If the value is of the wrong type, out of range, or not one of the choices.
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
