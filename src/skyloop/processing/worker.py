"""A processor's class, loaded from a module or file, and the worker that runs it on its share of a drone's frames."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import math
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Final, Self

import msgspec

from skyloop.client import Drone, Frame
from skyloop.client.channels import Mailbox, checked_age, checked_name
from skyloop.client.frame import ReceivedFrame
from skyloop.client.publishing import Membership
from skyloop.client.video import VideoChannel
from skyloop.clock import NS_PER_S, Clock, monotonic_ns
from skyloop.control.loading import load_module
from skyloop.errors import FileFormatError, UnknownNameError, UsageError
from skyloop.extend import join_processor, video_channel
from skyloop.messages import ProcessorShare, Severity
from skyloop.messages.relayed import MAX_LOG_TEXT, Shape

_WANTED: Final = "a class with a method process(self, frame)"
_DIGITS: Final = 16  #: number of hexadecimal digits kept of the code's SHA-256


@dataclass(frozen=True, slots=True)
class Code:
    """A processor's class, with an identifier that distinguishes it from other code of the same name."""

    kind: type[Any]
    mark: str  #: name of the class and a hash of the file that defines it

    @classmethod
    def of(cls, kind: type[Any]) -> Code:
        """Return the code of a class.

        Raises:
            UsageError: The class has no plain method ``process(self, frame)``.
        """
        _check(kind)
        digits = hashlib.sha256(_source(kind)).hexdigest()[:_DIGITS]
        return cls(kind, f"{kind.__qualname__[:100]} {digits}")

    @property
    def name(self) -> str:
        """Default name of the processor: the name of the class in lower case."""
        return self.kind.__name__.lower()[:64]

    def make(self) -> Any:
        """Create an instance.

        Raises:
            UsageError: The class needs arguments.
        """
        try:
            inspect.signature(self.kind).bind()
        except TypeError as error:
            name = self.kind.__name__
            raise UsageError(f"{name} can't be made as {name}(): {error}; give its arguments default values") from None
        return self.kind()


def load_processor(target: str) -> Code:
    """Load a processor's class.

    Args:
        target: ``module:Class``, ``file.py:Class``, or ``file.py`` if it has only one processor. The current directory
            is searched for modules too.

    Raises:
        UsageError: ``target`` names no processor, there is no such module, or the class is not a processor.
        UnknownNameError: There is no such class.
        FileFormatError: Loading fails, or the file contains no processor.
    """
    place, colon, class_name = target.rpartition(":")
    if not colon:
        place, class_name = target, ""
    if place.endswith(".py"):
        module = load_module(Path(place), _WANTED)
    elif colon and place:
        module = _import(place)
    else:
        raise UsageError(f"{target!r} is not a processor: give module:Class, file.py:Class or file.py")
    return Code.of(_choose(module, class_name, place))


def _import(name: str) -> ModuleType:
    if "" not in sys.path and str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and (name == error.name or name.startswith(f"{error.name}.")):
            raise UsageError(
                f"there is no module {name} here or on Python's path: give module:Class, or file.py:Class"
            ) from None
        raise FileFormatError(f"module {name}: {error}") from error
    except Exception as error:
        raise FileFormatError(f"module {name}: {type(error).__name__}: {error}") from error


def _choose(module: ModuleType, class_name: str, place: str) -> type[Any]:
    """Return the class with the given name; if no name is given, return the only class with a method ``process``."""
    found = {
        name: value
        for name, value in vars(module).items()
        if inspect.isclass(value) and callable(getattr(value, "process", None))
    }
    if class_name:
        named = getattr(module, class_name, None)
        if inspect.isclass(named):
            return named
        raise UnknownNameError(f"processor in {place}", class_name, found)
    own = {name: value for name, value in found.items() if value.__module__ == module.__name__} or found
    if not own:
        raise FileFormatError(f"{place} has no processor: write {_WANTED}")
    if len(own) > 1:
        raise UsageError(f"{place} has several processors ({', '.join(sorted(own))}): choose one with {place}:CLASS")
    return next(iter(own.values()))


def _check(kind: type[Any]) -> None:
    process = getattr(kind, "process", None)
    if not callable(process):
        raise UsageError(f"{kind.__name__} is not a processor: it has no method process(self, frame)")
    if inspect.iscoroutinefunction(process):
        raise UsageError(f"{kind.__name__}.process must be a plain function, not a coroutine")
    try:
        inspect.signature(process).bind(None, None)
    except TypeError as error:
        raise UsageError(f"{kind.__name__}.process must take one frame, as process(self, frame): {error}") from None


def _source(kind: type[Any]) -> bytes:
    """Return the source file of a class or, if there is none (as in a notebook), its compiled code."""
    try:
        return Path(inspect.getsourcefile(kind) or "").read_bytes()
    except (TypeError, OSError):
        code = getattr(kind.process, "__code__", None)
        return b"" if code is None else code.co_code + repr(code.co_names).encode()


_POLL_S: Final = 0.1  #: interval at which run() checks whether to end while no frame arrives
_REPORT_EVERY_S: Final = 1.0  #: minimum interval between reports of exceptions in the user's code
_KEPT: Final = 1024  #: number of recent results and frames kept for computing rates and ages
#: Fields summed over several workers.
_SUMS: Final = ("frames", "results", "dropped", "stale", "errors", "refused", "unsent", "frames_hz", "results_hz")


class Output:
    """A value, with shapes to draw over the frame for viewers: ``return Output(boxes, [Polyline(…)])``."""

    __slots__ = ("shapes", "value")

    def __init__(self, value: Any, shapes: Iterable[Shape] = ()) -> None:
        """Combine a result with shapes to draw.

        Args:
            value: The result; None to publish nothing.
            shapes: Shapes in the frame's pixels.
        """
        self.value = value
        self.shapes = tuple(shapes)


@dataclass(frozen=True, slots=True)
class Settings:
    """Options for running a processor.

    Raises:
        UsageError: A name, an age or a limit is out of range.
    """

    name: str  #: name of the processor and of its results
    code: str  #: identifier of the code, the same for all workers
    camera: str | None = None  #: name of the camera; None for the vehicle's first camera
    shared: bool = True  #: whether each frame goes to only one worker rather than to all of them
    max_age_s: float | None = 1.0  #: maximum age of a frame when its turn comes; None for no limit
    max_fps: float | None = None  #: frame rate limit of this worker; None for no limit
    stuck_s: float = 2.0  #: duration of a ``process`` call after which this worker's frames go to the others

    def __post_init__(self) -> None:
        checked_name(self.name)
        checked_age(self.max_age_s)
        for what, value in (("max_fps", self.max_fps), ("stuck_s", self.stuck_s)):
            if value is not None and not (isinstance(value, int | float) and 0.0 < value < math.inf):
                raise UsageError(f"{what} is {value!r} and must be a number above 0")


class Worker:
    """Runs a processor on a drone's frames: ``Worker(drone, Detector(), settings).run()``.

    Exceptions in ``process`` and results that can't be sent are counted and reported through ``drone.log`` and
    ``tell``. The worker then continues with the next frame.
    """

    def __init__(
        self, drone: Drone, processor: Any, settings: Settings, tell: Callable[[str], None] = lambda _: None
    ) -> None:
        """Join the processor's workers. Frames are processed only in :meth:`run`.

        Args:
            drone: Source of the frames, and destination of the results.
            processor: Object with a method ``process(frame)``, called on the thread of :meth:`run`.
            settings: Options for the run.
            tell: Called on the thread of :meth:`run` with each report, a human-readable text.

        Raises:
            NameTakenError: Another application is running different code under this name.
            SkyloopError: Any other error from :func:`skyloop.extend.join_processor`.
        """
        self.settings = settings
        self._drone = drone
        self._process = processor.process
        self._report = tell
        self._clock = monotonic_ns
        self._tally = Tally(self._clock)
        self._stopped = threading.Event()
        self._busy_since_s: float | None = None
        self._reported_s = -math.inf
        self._reported_refusal = False
        self.membership = join_processor(
            drone, settings.name, code=settings.code, camera=settings.camera, shared=settings.shared
        )
        self.membership.ready = self._ready
        self._frames = Frames(drone, self.membership, self._tally.came, max_fps=settings.max_fps)

    def run(self, seconds: float | None = None) -> None:
        """Process frames until :meth:`stop` is called or the drone closes, then unregister as a worker.

        Args:
            seconds: Maximum duration [s]; None for no limit.

        Raises:
            NameTakenError: Different code took the name in the meantime, which can happen while the proxy is away.
            RefusedError: The proxy refuses this worker for a different reason.
        """
        end_s = math.inf if seconds is None else time.monotonic() + seconds
        try:
            with self._frames as frames:
                while not self._over(end_s):
                    arrival = frames.wait(_POLL_S)
                    if arrival is not None:
                        self._work(arrival)
                    del arrival  # frees its memory for the proxy while this thread waits for the next frame
        finally:
            self.membership.close()

    def stop(self) -> None:
        """End :meth:`run` after the current call. Can be called from any thread."""
        self._stopped.set()

    @property
    def status(self) -> Status:
        """Current statistics. Can be read from any thread."""
        membership = self.membership
        return self._tally.status(membership.processor, membership.camera, membership.share, self._frames.dropped)

    def _over(self, end_s: float) -> bool:
        refused = self.membership.refused
        if refused is not None:
            raise refused
        return self._stopped.is_set() or self._drone.closed or time.monotonic() >= end_s

    def _work(self, arrival: ReceivedFrame) -> None:
        limit_s = self.settings.max_age_s
        if limit_s is not None and arrival.age_s > limit_s:
            self._tally.stale += 1
            return
        frame = self._frames.picture(arrival)
        if frame is None:
            return
        began_s = self._busy_since_s = time.monotonic()
        try:
            found = self._process(frame)
        except Exception as error:  # noqa: BLE001  (user code may raise anything)
            self._failed(error)
            return
        finally:
            stuck = not self._ready()
            self._busy_since_s = None
            if stuck:
                self.membership.renew()  # asks the proxy for a new share
        self._publish(frame, found, time.monotonic() - began_s)

    def _ready(self) -> bool:
        """Return whether the worker can take frames: false once a ``process`` call takes longer than ``stuck_s``."""
        since_s = self._busy_since_s
        return since_s is None or time.monotonic() - since_s < self.settings.stuck_s

    def _publish(self, frame: Frame, found: Any, took_s: float) -> None:
        output = found if isinstance(found, Output) else Output(found)
        try:
            if output.shapes:
                self._drone.annotate(frame, output.shapes, source=self.settings.name)
            if output.value is None:
                return
            sent = self.membership.publish(frame, output.value, took_s)
        except UsageError as error:
            self._refused(error)
            return
        if sent:
            self._tally.made(frame.age_s, took_s)
        else:
            self._tally.unsent += 1

    def _refused(self, error: UsageError) -> None:
        self._tally.refused += 1
        if not self._reported_refusal:  # later results are likely to have the same type
            self._reported_refusal = True
            self._emit(f"{self.settings.name}: {error}. Further ones are counted but not reported.")

    def _failed(self, error: Exception) -> None:
        self._tally.errors += 1
        now_s = time.monotonic()
        if now_s - self._reported_s < _REPORT_EVERY_S:
            return
        self._reported_s = now_s
        inner = error.__traceback__.tb_next if error.__traceback__ is not None else None  # skip our own line
        lines = "".join(traceback.format_exception(type(error), error, inner))
        self._emit(f"{self.settings.name} failed ({self._tally.errors} times so far):\n{lines.rstrip()}")

    def _emit(self, text: str) -> None:
        self._report(text)
        self._drone.log.text(text[-MAX_LOG_TEXT:], name=self.settings.name, severity=Severity.ERROR)


class Frames:
    """The newest unprocessed frame in a worker's share. A context manager that is subscribed while open.

    It requests only the frames in that share, even when the share changes, so no other frames travel over a network.
    """

    def __init__(
        self, drone: Drone, membership: Membership, came: Callable[[], None], *, max_fps: float | None = None
    ) -> None:
        """Prepare to subscribe; ``came`` is called on the receiving thread for each frame in the membership's share."""
        self._drone = drone
        self._membership = membership
        self._came = came
        self._max_fps = max_fps
        self._usual = video_channel(drone, membership.camera)
        self._channel: VideoChannel | None = None  # the current subscription
        self._buffer: Mailbox[ReceivedFrame] = Mailbox()
        self._sink = self._arrived
        self._lock = threading.Lock()  # guards the change of channels

    def __enter__(self) -> Self:
        self._membership.changed = self._follow
        if self._membership.share is not None:
            self._follow(self._membership.share)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._membership.changed = None
        self._turn_to(None)

    @property
    def dropped(self) -> int:
        """Number of frames in the share that were replaced by newer ones."""
        return self._buffer.dropped

    def wait(self, timeout_s: float) -> ReceivedFrame | None:
        """Return the newest frame, or None if none arrives within ``timeout_s`` [s]."""
        return self._buffer.wait(timeout_s)

    def picture(self, arrival: ReceivedFrame) -> Frame | None:
        """Decode the frame; return None if decoding fails (the frame's channel counts failures)."""
        return (self._channel or self._usual).picture(arrival)

    # On the receiving thread, except while entering --------------------------------------------------------------

    def _follow(self, share: ProcessorShare) -> None:
        part, fps = (share.part, share.parts), self._max_fps
        self._turn_to(video_channel(self._drone, share.camera, max_fps=fps, part=part) if share.parts else None)

    def _turn_to(self, channel: VideoChannel | None) -> None:
        with self._lock:
            before, self._channel = self._channel, channel
            if channel is before:
                return
            if channel is not None:
                already = self._buffer.dropped
                channel.add(self._sink, lambda: self._buffer.dropped - already)
            if before is not None:
                before.remove(self._sink)

    def _arrived(self, arrival: ReceivedFrame) -> None:
        share = self._membership.share  # the frame may belong to an earlier share
        if share is not None and share.parts and arrival.header.seq % share.parts == share.part:
            self._came()
            self._buffer.put(arrival)


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """Statistics of one worker, or of several workers of one processor combined.

    Counts are totals since the start; rates and ages cover the last second.
    """

    processor: str
    camera: str
    processes: int = 1  #: number of workers that these statistics cover
    part: int = 0  #: index of this worker's share of the frames; 0 if the statistics cover several workers
    parts: int = 0  #: number of shares, 0 if there are none; in statistics of several workers, workers with a share
    workers: int = 0  #: number of workers of this processor and camera that are known to the proxy
    frames: int = 0  #: number of frames in the worker's part
    results: int = 0
    dropped: int = 0  #: number of frames replaced by newer ones before the worker was ready
    stale: int = 0  #: number of frames that were too old when their turn came
    errors: int = 0  #: number of ``process`` calls that raised an exception
    refused: int = 0  #: number of results that can't be sent
    unsent: int = 0  #: number of results that the transport did not accept
    frames_hz: float = 0.0
    results_hz: float = 0.0
    age_s: float | None = None  #: median time between a frame's capture and its result
    age_max_s: float | None = None
    took_s: float | None = None  #: median duration of ``process``

    def __str__(self) -> str:
        share = f"part {self.part + 1} of {self.parts}" if self.parts else "no part now"
        if self.processes > 1:
            share = f"{self.parts} of {self.processes} processes working"
        age = "–" if self.age_s is None or self.age_max_s is None else f"{_ms(self.age_s)} (max {_ms(self.age_max_s)})"
        parts = [
            f"{self.processor} {self.camera}",
            share,
            f"{self.frames_hz:.1f} frames/s",
            f"{self.results_hz:.1f} results/s",
            f"age {age}",
            f"dropped {self.dropped}",
            f"too old {self.stale}",
            f"errors {self.errors}",
            *([f"unsendable {self.refused}"] if self.refused else []),
            *([f"unsent {self.unsent}"] if self.unsent else []),
        ]
        return "  ".join(parts)


def together(found: Iterable[Status]) -> Status | None:
    """Combine the statistics of several workers of one processor; None if there are none.

    Counts and rates are summed; ages are maxima.
    """
    each = list(found)
    if len(each) < 2:
        return each[0] if each else None
    ages = [one.age_s for one in each if one.age_s is not None]
    longest = [one.age_max_s for one in each if one.age_max_s is not None]
    sums = {name: sum(getattr(one, name) for one in each) for name in _SUMS}
    return Status(
        processor=each[0].processor,
        camera=each[0].camera,
        processes=len(each),
        parts=sum(one.parts > 0 for one in each),
        workers=max(one.workers for one in each),
        age_s=max(ages, default=None),
        age_max_s=max(longest, default=None),
        **sums,
    )


class Tally:
    """Counters of a worker. One thread counts frames and another counts results; any thread can read the counters."""

    def __init__(self, clock: Clock) -> None:
        self.frames = self.results = self.stale = self.errors = self.refused = self.unsent = 0
        self._clock = clock
        self._came: deque[int] = deque(maxlen=_KEPT)
        self._made: deque[tuple[int, float, float]] = deque(maxlen=_KEPT)  # time, age [s], duration [s]

    def came(self) -> None:
        """Count a frame assigned to this worker. Called on the receiving thread."""
        self.frames += 1
        self._came.append(self._clock())

    def made(self, age_s: float, took_s: float) -> None:
        """Count a published result, with the time since the frame's capture and the duration of ``process``."""
        self.results += 1
        self._made.append((self._clock(), age_s, took_s))

    def status(self, processor: str, camera: str, share: ProcessorShare | None, dropped: int) -> Status:
        """Return the current statistics; ``dropped`` frames were replaced by newer ones."""
        since_ns = self._clock() - NS_PER_S
        made = [one for one in self._made.copy() if one[0] > since_ns]
        ages, took = sorted(age for _, age, _ in made), sorted(took for _, _, took in made)
        return Status(
            processor=processor,
            camera=camera,
            part=share.part if share is not None else 0,
            parts=share.parts if share is not None else 0,
            workers=share.workers if share is not None else 0,
            frames=self.frames,
            results=self.results,
            dropped=dropped,
            stale=self.stale,
            errors=self.errors,
            refused=self.refused,
            unsent=self.unsent,
            frames_hz=float(sum(at_ns > since_ns for at_ns in self._came.copy())),
            results_hz=float(len(made)),
            age_s=ages[len(ages) // 2] if ages else None,
            age_max_s=ages[-1] if ages else None,
            took_s=took[len(took) // 2] if took else None,
        )


def _ms(value: float) -> str:
    return f"{value * 1e3:.0f} ms"
