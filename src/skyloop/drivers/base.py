"""The contract between the proxy and a vehicle's driver. ``docs/drivers.md`` shows how to write one.

A driver speaks one vehicle family's native protocol and knows nothing of the network, of applications or of
authority. It converts units and axes at its edge. Its class is registered under the entry-point group
``skyloop.drivers`` with its URI scheme as the name.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.drivers.seams import ExternalPose, Remark
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import ParameterError, UnknownNameError, UnsupportedError, UsageError
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
    Refusal,
    Severity,
    Value,
)


class Sink(Protocol):
    """Where a driver puts what it hears. All methods may be called from any thread, return quickly, never raise."""

    def feedback(self, feedback: Feedback) -> None:
        """The vehicle's newest state. Fill the vehicle's block of :class:`Feedback`; leave the proxy's fields alone."""

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
        """A whole frame. ``pixels`` is C-contiguous uint8 and may be reused when the call returns.

        Raw encodings have exactly ``height * width * channels`` bytes; JPEG is one file.
        """

    def wants(self, camera: str) -> bool:
        """Whether anybody looks at this camera now: if not, a driver may save itself the work of decoding."""

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
        """A picture as the vehicle encoded it, of a camera whose ``CameraInfo`` announces ``stream="h264"``.

        ``data``: one access unit of H.264 in Annex B form, undamaged, with SPS and PPS if it is a key picture, and of
        a stream without B pictures. One that is no ``key`` follows the picture that was given last: after a gap, and
        after a while in which nobody wanted any, begin with a key. Size, intrinsics and time are those of the decoded
        frame, which is given to :meth:`frame` all the same while somebody wants that.
        """

    def wants_stream(self, camera: str) -> bool:
        """Whether anybody takes this camera's pictures as they come."""

    def link(self, state: LinkState, reason: str = "") -> None:
        """The hop to the vehicle changed. Call it with UP once the vehicle answers."""

    def event(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: Value) -> None:
        """Something happened that a person or a program may want to know."""


class Driver(ABC):
    """Base class of drivers: owns the life cycle; a driver writes ``_open``, ``_close`` and ``_apply``.

    No I/O happens before :meth:`open`. Times given to the sink are ``time.monotonic_ns`` of this host.
    """

    def __init__(self, uri: VehicleUri) -> None:
        """Reads the address and options from the URI. Raises :class:`UsageError` for options it does not know."""
        self.uri = uri
        self._lock = threading.Lock()
        self._sink: Sink | None = None

    # What it can do --------------------------------------------------------------------------------------------

    @abstractmethod
    def capabilities(self) -> Capabilities:
        """What the vehicle can do, told before it is opened. Actions not named are done in software if possible."""

    def parameters(self) -> list[Parameter]:
        """The vehicle's own parameters with their present values. Names are dotted and lower-case."""
        return []

    def set_parameter(self, name: str, value: Value) -> Value:  # noqa: ARG002
        """Write one parameter and return the value that is now in force.

        The type and range were checked against :meth:`parameters`. Called on the proxy's thread of requests, may take
        up to a second. Raises :class:`ParameterError` with the vehicle's own reason if it refuses.
        """
        raise ParameterError(f"{name} cannot be written", code=Refusal.READ_ONLY)

    # Life cycle ------------------------------------------------------------------------------------------------

    def open(self, sink: Sink) -> None:
        """Start to talk to the vehicle; returns at once, the link's state goes to the sink.

        A vehicle that is not there is no error: the driver goes on trying. Raises :class:`UsageError` or
        :class:`skyloop.errors.MissingExtraError` only for what trying again can't mend.
        """
        with self._lock:
            if self._sink is not None:
                raise UsageError(f"{self.uri} is open already")
            self._sink = sink
        try:
            self._open(sink)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop threads and give resources back. Idempotent. Does not land: the proxy does that before."""
        with self._lock:
            was_open, self._sink = self._sink is not None, None
        if was_open:
            self._close()

    # Flying ----------------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction) -> AnyAction:
        """Make the vehicle do it, until the next call; returns what was really applied (after the vehicle's limits).

        Only actions named in :meth:`capabilities` come here, with finite numbers; one call at a time; must not block
        longer than a few milliseconds. May raise :class:`skyloop.errors.DriverError`.
        """
        return self._apply(action)

    def failsafe(self, action: Hover | Land) -> bool:
        """Do this with nobody at the controls. Never raises: a failure is told as an event, and the proxy tries again.

        Returns whether the driver took it.
        """
        sink = self._sink
        try:
            self._apply(action)
        except Exception as error:  # noqa: BLE001  a failsafe must come back whatever the driver's code does
            if sink is not None:
                sink.event(EventKind.DRIVER_ERROR, f"failsafe {action.name} failed: {error!r}", Severity.ERROR)
            return False
        return True

    # What some vehicles can do besides ---------------------------------------------------------------------------

    def external_pose(self, pose: ExternalPose) -> None:  # noqa: ARG002
        """Tell the vehicle where motion capture saw it, for flight without GPS. Any thread; returns at once.

        Raises :class:`UnsupportedError` for a vehicle that takes none, :class:`skyloop.errors.DriverError` while it
        can't be told.
        """
        raise UnsupportedError(f"{self.uri.scheme}:// takes no poses from outside")

    def checkup(self) -> list[Remark]:
        """What of the vehicle's settings wants attention before flying, for ``skyloop doctor ADDRESS``. While open."""
        return []

    # To be written by a driver ---------------------------------------------------------------------------------

    @abstractmethod
    def _open(self, sink: Sink) -> None: ...

    @abstractmethod
    def _close(self) -> None: ...

    def _apply(self, action: AnyAction) -> AnyAction:
        raise UsageError(f"{self.uri.scheme} takes no {action.name}")


def reject_unknown_options(uri: VehicleUri, known: set[str]) -> None:
    """Raise :class:`UnknownNameError` for an option of the URI that is not in ``known``."""
    for name in uri.options:
        if name not in known:
            raise UnknownNameError(f"option of {uri.scheme}://", name, known)
