"""Frames of a motion capture system from a child process, which is restarted when it dies."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, BinaryIO, Final, cast

import msgspec

from skyloop.child_process import ChildProcess, RestartingChild
from skyloop.errors import LinkError, MissingExtraError, UnsupportedError
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.motion_capture.address import System
from skyloop.motion_capture.worker import MISSING, RawFrame, read

if TYPE_CHECKING:
    from collections.abc import Iterable

    from skyloop.client import Drone
    from skyloop.messages import Feedback


class TruthSource:
    """Observes the proxies of simulated drones, and reads the true poses from their native telemetry."""

    def __init__(self, proxies: Iterable[str], take: Callable[[RawFrame], None]) -> None:
        """Initialise without connecting.

        Args:
            proxies: Names of the drones' proxies.
            take: Called with each frame, on the thread that receives feedback.
        """
        self._proxies = tuple(proxies)
        self._take = take
        self._open = ExitStack()

    def start(self, timeout_s: float) -> None:
        """Connect to all proxies.

        Args:
            timeout_s: How long to wait for each.

        Raises:
            UnsupportedError: A vehicle does not report its true pose.
            SkyloopError: As of :func:`skyloop.connect`.
        """
        from skyloop.client import connect

        with ExitStack() as opening:
            for name in self._proxies:
                drone = opening.enter_context(
                    connect(name, access="observe", name="skyloop mocap", timeout_s=timeout_s)
                )
                if true_pose(drone.feedback()) is None:
                    raise UnsupportedError(f"{name} reports no true pose: start it with truth=1, as sim://?truth=1")
                opening.enter_context(drone.on_feedback(self._taking(name, drone), inline=True))
            self._open = opening.pop_all()

    def close(self) -> None:
        """Disconnect from all. Idempotent."""
        self._open.close()

    def _taking(self, name: str, drone: Drone) -> Callable[[Feedback], None]:
        def take(feedback: Feedback) -> None:
            pose = true_pose(feedback)
            if pose is not None:
                self._take(RawFrame(feedback.captured_ns - drone.clock_offset_ns, {name: pose}))

        return take


def true_pose(
    feedback: Feedback,
) -> tuple[tuple[float, float, float], tuple[float, float, float, float]] | None:
    """Return position [m] and quaternion (x, y, z, w) from the simulator's native telemetry; None without them."""
    native = feedback.native or {}
    try:
        x, y, z, roll, pitch, yaw = (
            float(native[f"truth.{name}"])  # type: ignore[arg-type]
            for name in ("x", "y", "z", "roll", "pitch", "yaw")
        )
    except (KeyError, TypeError, ValueError):
        return None
    return (x, y, z), quaternion_from_euler(roll, pitch, yaw)


#: Not ``-m``: the package imports the worker's module, of which Python would warn in each child.
WORKER: Final = (
    sys.executable,
    "-c",
    "import sys; from skyloop.motion_capture.worker import main; sys.exit(main(*sys.argv[1:]))",
)
AGAIN_S: Final = 0.5  #: pause before a child that ended is restarted
SILENT_S: Final = 3.0  #: a child that sends nothing for so long is killed: its system may have been restarted
FIRST_S: Final = 10.0  #: the same before its first frame


class ChildSource:
    """Runs :mod:`skyloop.motion_capture.worker` for a system and passes each frame on, on its own thread.

    A child that ends or falls silent is replaced until :meth:`close`.
    """

    def __init__(
        self,
        system: System,
        take: Callable[[RawFrame], None],
        trouble: Callable[[str], None],
        *,
        command: tuple[str, ...] = WORKER,
    ) -> None:
        """Initialise without starting the child.

        Args:
            system: The system to connect to.
            take: Called with each frame, on the reading thread.
            trouble: Called with a description when the child fails, on one of its threads.
            command: The child's command line, before kind and settings.
        """
        self._system = system
        self._take = take
        self._trouble = trouble
        self._received_s = 0.0
        self._first = threading.Event()
        self._failed: Exception | None = None
        self._last_words = ""  # the end of the last child's standard error
        settings = msgspec.json.encode(system.configuration).decode()
        self._runner = RestartingChild(
            [*command, system.kind, settings],
            name="skyloop-mocap",
            read=self._read,
            ended=self._child_ended,
            started=self._child_started,
            silent=lambda: time.monotonic() - self._received_s > SILENT_S,  # its native code would wait for ever
            keep_errors=True,
        )

    @property
    def pid(self) -> int | None:
        """Process id of the child; None before the first."""
        return None if self._runner.child is None else self._runner.child.pid

    def start(self, timeout_s: float) -> None:
        """Start the child, and wait for the first frame.

        Args:
            timeout_s: How long to wait.

        Raises:
            LinkError: No frame came within that time.
            MissingExtraError: The ``motioncapture`` package is not installed.
        """
        self._runner.start()
        if not self._first.wait(timeout_s) or self._failed is not None:
            failed, last_words = self._failed, self._last_words
            self.close()
            raise failed or LinkError(f"{self._system.address} sent no frame within {timeout_s:g} s{last_words}")

    def close(self) -> None:
        """End the child. Idempotent."""
        child = self._runner.request_stop()
        if child is not None:
            child.kill()  # the native code does not read its standard input
        self._runner.stop()

    # --- threads ---

    def _child_started(self, _child: ChildProcess) -> None:
        self._received_s = time.monotonic() + FIRST_S - SILENT_S

    def _read(self, child: ChildProcess) -> None:
        try:
            while (frame := read(cast(BinaryIO, child.stdout))) is not None:
                self._received_s = time.monotonic()
                self._first.set()
                self._take(frame)
        except msgspec.DecodeError as error:
            self._trouble(f"{self._system.address}: {error}")
        finally:
            child.kill()

    def _child_ended(self, child: ChildProcess | None, ending: str) -> float | None:
        words = ending if child is None else child.last_words
        self._last_words = f": {words}" if words else ""
        if child is not None and child.code == MISSING:
            self._failed = MissingExtraError(f"{self._system.kind} motion capture", "mocap", cause=words)
            self._first.set()
            return None
        if not self._runner.stopping:
            self._trouble(f"no data from {self._system.address}{self._last_words}; trying again")
        return AGAIN_S
