"""One worker of a processor: takes its share of the frames, calls the user's class, and publishes what that returns."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from skyloop.client import Drone, Frame
from skyloop.client.channels import checked_age, checked_name
from skyloop.client.frame import Arrival
from skyloop.errors import UsageError
from skyloop.extend import join_processor
from skyloop.messages import Severity
from skyloop.messages.log import MAX_TEXT
from skyloop.processing.frames import Frames
from skyloop.processing.output import Output
from skyloop.processing.status import Status, Tally

_LOOK_S: Final = 0.1  #: how often run() checks whether to end while no frame comes
_REPORT_EVERY_S: Final = 1.0  #: exceptions of the user's code are reported at most this often


@dataclass(frozen=True, slots=True)
class Settings:
    """How a processor is run.

    Raises:
        UsageError: If a name, an age or a limit is out of range.
    """

    name: str  #: name of the processor and of its results
    code: str  #: identifies the code that runs, the same for all workers
    camera: str | None = None  #: name of the camera; None: the vehicle's first
    shared: bool = True  #: each frame goes to one worker; if False, each worker gets all
    max_age_s: float | None = 1.0  #: older frames are left out when their turn comes; None: none are
    max_fps: float | None = None  #: most frames a second for this worker; None: all
    stuck_s: float = 2.0  #: a call of ``process`` that takes longer gives this worker's share to the others

    def __post_init__(self) -> None:
        checked_name(self.name)
        checked_age(self.max_age_s)
        for what, value in (("max_fps", self.max_fps), ("stuck_s", self.stuck_s)):
            if value is not None and not (isinstance(value, int | float) and 0.0 < value < math.inf):
                raise UsageError(f"{what} is {value!r} and must be a number above 0")


class Worker:
    """Runs a processor on a drone's frames: ``Worker(drone, Detector(), settings).run()``.

    Exceptions of ``process`` and results that can't be sent are counted and reported through ``drone.log`` and
    ``tell``; the worker goes on with the next frame.
    """

    def __init__(
        self, drone: Drone, processor: Any, settings: Settings, tell: Callable[[str], None] = lambda _: None
    ) -> None:
        """Join the processor's workers; no frame is taken before :meth:`run`.

        Args:
            drone: Where frames come from and results go to.
            processor: Has a method ``process(frame)``, called on the thread of :meth:`run`.
            settings: How it is run.
            tell: Called with each report, a text for people, on the thread of :meth:`run`.

        Raises:
            NameTakenError: If another application runs other code under this name.
            SkyloopError: Whatever else :func:`skyloop.extend.join_processor` raises.
        """
        self.settings = settings
        self._drone = drone
        self._process = processor.process
        self._report = tell
        self._clock = time.monotonic_ns
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
        """Process frames until :meth:`stop` or the drone's end, then leave the processor's workers.

        Args:
            seconds: For how long at most [s]; None: no limit.

        Raises:
            NameTakenError: If other code took over the name meanwhile, as it can while the proxy is away.
            RefusedError: If the proxy refuses this worker for another reason.
        """
        end_s = math.inf if seconds is None else time.monotonic() + seconds
        try:
            with self._frames as frames:
                while not self._over(end_s):
                    arrival = frames.wait(_LOOK_S)
                    if arrival is not None:
                        self._work(arrival)
                    del arrival  # returns its memory to the proxy while this waits for the next one
        finally:
            self.membership.close()

    def stop(self) -> None:
        """End :meth:`run` after the call that is under way. Any thread."""
        self._stopped.set()

    @property
    def status(self) -> Status:
        """Present statistics. Any thread."""
        membership = self.membership
        return self._tally.status(membership.processor, membership.camera, membership.share, self._frames.dropped)

    def _over(self, end_s: float) -> bool:
        refused = self.membership.refused
        if refused is not None:
            raise refused
        return self._stopped.is_set() or self._drone.closed or time.monotonic() >= end_s

    def _work(self, arrival: Arrival) -> None:
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
        except Exception as error:  # noqa: BLE001  (the user's code may raise anything)
            self._failed(error)
            return
        finally:
            stuck = not self._ready()
            self._busy_since_s = None
            if stuck:
                self.membership.renew()  # the proxy gives its share back
        self._publish(frame, found, time.monotonic() - began_s)

    def _ready(self) -> bool:
        """Whether it can take frames: not while a call of ``process`` takes longer than ``stuck_s``."""
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
        if not self._reported_refusal:  # further results are most likely of the same type
            self._reported_refusal = True
            self._emit(f"{self.settings.name}: {error}. Further ones are counted and not reported.")

    def _failed(self, error: Exception) -> None:
        self._tally.errors += 1
        now_s = time.monotonic()
        if now_s - self._reported_s < _REPORT_EVERY_S:
            return
        self._reported_s = now_s
        inner = error.__traceback__.tb_next if error.__traceback__ is not None else None  # without our own line
        lines = "".join(traceback.format_exception(type(error), error, inner))
        self._emit(f"{self.settings.name} failed ({self._tally.errors} times so far):\n{lines.rstrip()}")

    def _emit(self, text: str) -> None:
        self._report(text)
        self._drone.log.text(text[-MAX_TEXT:], name=self.settings.name, severity=Severity.ERROR)
