"""Test drivers with a sink that stores their reports, and with checks of samples and parameter values."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns
from skyloop.drivers.vehicle_session import VehicleEvent
from skyloop.messages import (
    Encoding,
    EventKind,
    Feedback,
    Intrinsics,
    LinkState,
    Parameter,
    ParameterType,
    Severity,
    Value,
)
from skyloop.messages.fields import CHANNELS


@dataclass(frozen=True, slots=True)
class SeenFrame:
    """The arguments of one call of :meth:`skyloop.drivers.base.Sink.frame`."""

    camera: str
    #: A copy of shape (height, width, 3), (height, width) or, for JPEG, (bytes,); empty if malformed or not stored.
    pixels: NDArray[np.uint8]
    captured_ns: int
    arrived_ns: int  #: time of the call, on this host's monotonic clock
    width: int
    height: int
    encoding: Encoding
    intrinsics: Intrinsics | None


@dataclass(frozen=True, slots=True)
class SeenPicture:
    """The arguments of one call of :meth:`skyloop.drivers.base.Sink.stream`."""

    camera: str
    data: bytes
    captured_ns: int
    width: int
    height: int
    key: bool
    intrinsics: Intrinsics | None


class RecordingSink:
    """A :class:`skyloop.drivers.base.Sink` that stores recent samples, recent frames and all link states.

    ``problems`` describes violations of the contract of :class:`skyloop.drivers.base.Sink`. Thread-safe.

    Args:
        watch: Names of the cameras whose frames are wanted; None: all cameras.
        keep: How many feedback samples, frames, encoded frames and events to store; at most 64 frames keep pixels.
        keep_pixels: Whether to store a copy of the pixels of each frame.
        record: Whether encoded frames of all cameras are wanted.
    """

    def __init__(
        self, *, watch: set[str] | None = None, keep: int = 512, keep_pixels: bool = True, record: bool = False
    ) -> None:
        self.watch = watch
        self.record = record
        self.pictures: deque[SeenPicture] = deque(maxlen=keep)
        self.feedbacks: deque[Feedback] = deque(maxlen=keep)
        self.frames: deque[SeenFrame] = deque(maxlen=keep if not keep_pixels else min(keep, 64))
        self.links: list[tuple[LinkState, str]] = []
        self.remedy = ""  #: the remedy reported along with the newest link state
        self.events: deque[VehicleEvent] = deque(maxlen=keep)
        self.problems: list[str] = []
        self.calls = 0
        self.feedback_count = 0
        self.frame_counts: Counter[str] = Counter()
        self._keep_pixels = keep_pixels
        self._newest_ns: dict[str, int] = {}
        self._changed = threading.Condition()

    # Called by the driver ------------------------------------------------------------------------------------------

    def feedback(self, feedback: Feedback) -> None:
        """Store a sample; record a problem if its time lies in the future or goes backwards."""
        now_ns = monotonic_ns()
        with self._changed:
            self._check_time("feedback", feedback.captured_ns, now_ns)
            self.feedbacks.append(feedback)
            self.feedback_count += 1
            self._notify()

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
        """Store a frame; record a problem if its time or its pixels violate the contract."""
        now_ns = monotonic_ns()
        with self._changed:
            self._check_time(f"frame of {camera}", captured_ns, now_ns)
            shaped = self._shaped(camera, pixels, width, height, encoding)
            seen = SeenFrame(camera, shaped, captured_ns, now_ns, width, height, encoding, intrinsics)
            self.frames.append(seen)
            self.frame_counts[camera] += 1
            self._notify()

    def wants(self, camera: str) -> bool:
        """Return whether ``watch`` contains the camera or is None."""
        return self.watch is None or camera in self.watch

    def wanted_fps(self, camera: str) -> float:
        """Return infinity for a camera whose frames are wanted, and 0 for any other camera."""
        return math.inf if self.wants(camera) else 0.0

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
        """Store an encoded frame; record a problem if it isn't in Annex B format, or if the first isn't a key frame."""
        now_ns = monotonic_ns()
        with self._changed:
            self._check_time(f"encoded frame of {camera}", captured_ns, now_ns)
            if not key and all(seen.camera != camera for seen in self.pictures):
                self.problems.append(f"encoded frame of {camera}: the first one is not a key picture")
            if not data.startswith((b"\0\0\1", b"\0\0\0\1")):
                self.problems.append(f"encoded frame of {camera}: not H.264 in Annex B form")
            self.pictures.append(SeenPicture(camera, data, captured_ns, width, height, key, intrinsics))
            self._notify()

    def wants_stream(self, camera: str) -> bool:  # noqa: ARG002  (all cameras or none)
        return self.record

    def link(self, state: LinkState, reason: str = "", remedy: str = "") -> None:
        with self._changed:
            self.links.append((LinkState(state), reason))
            self.remedy = remedy
            self._notify()

    def event(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: Value) -> None:
        with self._changed:
            self.events.append(VehicleEvent(EventKind(kind), text, Severity(severity), data))
            self._notify()

    # Called by the test --------------------------------------------------------------------------------------------

    @property
    def newest(self) -> Feedback | None:
        """The newest feedback; None before the first sample arrives."""
        return self.feedbacks[-1] if self.feedbacks else None

    @property
    def link_state(self) -> LinkState | None:
        """The newest state of the link; None before the first report."""
        return self.links[-1][0] if self.links else None

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until a condition holds; return False if it does not hold within ``timeout_s`` [s].

        ``condition`` is called after each call by the driver, while the sink's lock is held.
        """
        end = time.monotonic() + timeout_s
        with self._changed:
            while not condition():
                left = end - time.monotonic()
                if left <= 0 or not self._changed.wait(left):
                    return condition()
        return True

    def _notify(self) -> None:
        self.calls += 1
        self._changed.notify_all()

    def _check_time(self, what: str, captured_ns: int, now_ns: int) -> None:
        if type(captured_ns) is not int:
            self.problems.append(f"{what}: captured_ns is a {type(captured_ns).__name__} and must be an int")
            return
        if captured_ns > now_ns:
            self.problems.append(f"{what}: captured {(captured_ns - now_ns) / 1e6:.1f} ms in the future")
        before_ns = self._newest_ns.get(what)
        if before_ns is not None and captured_ns < before_ns:
            self.problems.append(f"{what}: captured {(before_ns - captured_ns) / 1e6:.1f} ms before the previous one")
        self._newest_ns[what] = captured_ns

    def _shaped(
        self, camera: str, pixels: NDArray[np.uint8], width: int, height: int, encoding: Encoding
    ) -> NDArray[np.uint8]:
        empty = np.zeros(0, np.uint8)
        if not isinstance(pixels, np.ndarray) or pixels.dtype != np.uint8 or not pixels.flags.c_contiguous:
            self.problems.append(f"frame of {camera}: pixels must be a C-contiguous array of uint8")
            return empty
        channels = CHANNELS.get(encoding)
        if channels is None:
            if bytes(pixels.reshape(-1)[:2]) != b"\xff\xd8":
                self.problems.append(f"frame of {camera}: not a JPEG file")
            return pixels.copy() if self._keep_pixels else empty
        if pixels.size != height * width * channels:
            self.problems.append(f"frame of {camera}: {pixels.size} bytes for {width}×{height}×{channels}")
            return empty
        if not self._keep_pixels:
            return empty
        return pixels.reshape((height, width, 3) if channels == 3 else (height, width)).copy()


#: Plausible range of each number in feedback; a number outside its range most likely has the wrong unit.
PLAUSIBLE: dict[str, tuple[float, float]] = {
    "battery": (0.0, 1.0),
    "battery_v": (0.0, 60.0),
    "roll_rad": (-math.pi, math.pi),
    "pitch_rad": (-math.pi, math.pi),
    "yaw_rad": (-math.pi - 1e-9, math.pi + 1e-9),
    "altitude_m": (-50.0, 500.0),
    "velocity_m_s": (-60.0, 60.0),
    "angular_velocity_rad_s": (-50.0, 50.0),
    "acceleration_m_s2": (-500.0, 500.0),
    "position_m": (-1e5, 1e5),
}


def implausible(feedback: Feedback) -> list[str]:
    """Describe the numbers in a sample that are not finite, or so large that they must have the wrong unit."""
    problems = []
    for name, (low, high) in PLAUSIBLE.items():
        value = getattr(feedback, name)
        numbers = value if isinstance(value, tuple) else () if value is None else (value,)
        if isinstance(value, tuple) and len(value) != 3:
            problems.append(f"{name} has {len(value)} numbers and must have 3")
        for number in numbers:
            if isinstance(number, bool) or not isinstance(number, (int, float)):
                problems.append(f"{name} is a {type(number).__name__} and must be a float")
            elif not math.isfinite(number):
                problems.append(f"{name} is {number} and must be finite, or None if unknown")
            elif not low <= number <= high:
                problems.append(f"{name} is {number:g}, outside {low:g} to {high:g}: is it in SI units?")
    return problems


_TYPES: Final[dict[ParameterType, tuple[type, ...]]] = {
    ParameterType.BOOL: (bool,),
    ParameterType.INT: (int,),
    ParameterType.FLOAT: (float, int),
    ParameterType.TEXT: (str,),
    ParameterType.VECTOR: (tuple,),
}


def mismatch(parameter: Parameter, value: Value) -> str:
    """Return why a value does not fit a parameter's type, choices or range, worded as a predicate; empty if it does."""
    expected = _TYPES[parameter.type]
    if not isinstance(value, expected) or (isinstance(value, bool) and bool not in expected):
        return f"is not of type {parameter.type}"
    if parameter.choices and value not in parameter.choices:
        return f"is not one of {parameter.choices}"
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        if isinstance(number, (str, bool)):
            continue
        if not math.isfinite(number):
            return "is not finite"
        if parameter.minimum is not None and number < parameter.minimum:
            return f"is below {parameter.minimum:g}"
        if parameter.maximum is not None and number > parameter.maximum:
            return f"is above {parameter.maximum:g}"
    return ""


def another_value(parameter: Parameter) -> Value:
    """Return an allowed value other than the current one; the current value if there is no other."""
    value = parameter.value
    if parameter.choices:
        return next((choice for choice in parameter.choices if choice != value), value)
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return value
    if isinstance(value, tuple):
        return tuple(_another_number(number, parameter) for number in value)
    other = _another_number(value, parameter)
    return int(other) if parameter.type is ParameterType.INT else other


def _another_number(value: float, parameter: Parameter) -> float:
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None:
        if parameter.type is ParameterType.INT:  # use the next integer: a vehicle may accept only part of a wide range
            return value + 1 if value < high else value - 1
        return (value + low + high) / 3
    if high is not None:
        return min(high, value - 1)
    return value + 1


def same(one: Value, other: Value) -> bool:
    """Return whether two values are equal; numbers may differ by 1e-5 (relative) or 1e-6 (absolute)."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, (int, float)) and isinstance(other, (int, float)):
        return math.isclose(one, other, rel_tol=1e-5, abs_tol=1e-6)
    return one == other
