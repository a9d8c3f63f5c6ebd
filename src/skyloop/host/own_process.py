"""A vehicle whose proxy has a process of its own, which is started again when it dies."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable
from typing import Final

import msgspec

from skyloop.child_process import ChildProcess
from skyloop.errors import RefusedError
from skyloop.host.fleet import VehicleSettings
from skyloop.host.vehicle import Condition, HostedVehicle, VehicleStatus

STARTS_WITHIN_S: Final = 20.0
FIRST_PAUSE_S: Final = 0.5
LONGEST_PAUSE_S: Final = 30.0
SILENT_LOOKS: Final = 10  #: seconds without a report after which a process hangs as a whole, and is killed
STEADY_S: Final = 60.0  #: a process that ran for so long is started again after the first pause
_LOOK_S: Final = 1.0
_POLL_S: Final = 0.05
_decoder: Final = msgspec.json.Decoder(VehicleStatus)
_log = logging.getLogger(__name__)


def pause_s(deaths: int) -> float:
    """Return how long to wait before a process is started again that died so often in a row [s]."""
    return float(min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** min(deaths - 1, 20)))


class OwnProcessVehicle(HostedVehicle):
    """A vehicle with ``process = "own"``: whatever its driver does, it does to its own process only.

    Args:
        settings: Its settings.
        announce: Called with a line for people when its process dies and is started again.
        command: What starts the process; the settings follow.
    """

    def __init__(
        self,
        settings: VehicleSettings,
        announce: Callable[[str], None],
        command: tuple[str, ...] = (sys.executable, "-m", "skyloop.host.child"),
    ) -> None:
        super().__init__(settings)
        self._announce = announce
        self._command = command
        self._changed = threading.Condition()  # guards all below
        self._child: ChildProcess | None = None
        self._reported: VehicleStatus | None = None  # by the present process
        self._stopping = False
        self._deaths = 0  # in a row
        self._restarts = 0
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        self.condition = Condition.STARTING
        child = self._begin()
        if not self._serves(child):
            if self._reported is None:
                child.wait(1.0)
            why = self._reported.failed if self._reported is not None else f"its process {child.ending}"
            child.close(0.0, 1.0)
            raise RefusedError(why, code="failed")
        self._thread = threading.Thread(target=self._keep, name=f"skyloop-{self.settings.name}-process", daemon=True)
        self._thread.start()

    def _begin(self) -> ChildProcess:
        """Start a process and read what it reports."""
        arguments = msgspec.json.encode(self.settings).decode()
        child = ChildProcess([*self._command, arguments], keep_errors=False)
        with self._changed:
            self._child, self._reported = child, None
        threading.Thread(
            target=self._read, args=(child,), name=f"skyloop-{self.settings.name}-status", daemon=True
        ).start()
        return child

    def _read(self, child: ChildProcess) -> None:
        try:
            for line in child.stdout:
                status = self._parsed(line)
                if status is not None:
                    with self._changed:
                        if self._child is child:
                            self._reported = status
                            self._changed.notify_all()
        except ValueError:
            pass  # it was closed meanwhile
        child.wait()
        with self._changed:
            self._changed.notify_all()

    def _parsed(self, line: bytes) -> VehicleStatus | None:
        try:
            return _decoder.decode(line)
        except msgspec.DecodeError:  # a driver's own words
            _log.info("%s: %s", self.settings.name, line.decode(errors="replace").rstrip())
            return None

    def _keep(self) -> None:
        """Start the process again whenever it dies."""
        child = self._child
        while child is not None:
            began_s = time.monotonic()
            self._watch(child)
            with self._changed:
                if self._stopping:
                    return
                steady = time.monotonic() - began_s > STEADY_S
                self._deaths = 1 if steady else self._deaths + 1
                pause = pause_s(self._deaths)
                reported = self._reported
                own_words = reported.failed if reported is not None else ""
                self.failed = own_words or f"its process {child.ending}"
                self.condition = Condition.RESTARTING
            self._announce(
                f"vehicle of {self.settings.name}: {self.failed} (pid {child.pid}); it is started again in {pause:g} s"
            )
            child.close(0.0, 0.0)
            with self._changed:
                if self._changed.wait_for(lambda: self._stopping, pause):
                    return
                self._restarts += 1
            child = self._begin()
            if self._serves(child):
                self._announce(f"vehicle of {self.settings.name}: runs again, process {child.pid}")

    def _watch(self, child: ChildProcess) -> None:
        """Wait until a process has died; one that reports nothing any more is killed."""
        silent, known = 0, self._reported
        while child.wait(_LOOK_S) is None:
            with self._changed:
                silent = silent + 1 if self._reported is known and not self._stopping else 0
                known = self._reported
            if silent >= SILENT_LOOKS:
                _log.error("the process of %s reports nothing any more: it is killed", self.settings.name)
                child.kill()

    def _serves(self, child: ChildProcess) -> bool:
        """Wait for the first report of a process that was started; return whether it serves."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._reported is not None or child.code is not None or self._stopping, STARTS_WITHIN_S
            )
            reported = self._reported
            serves = reported is not None and reported.condition is Condition.RUNNING and not self._stopping
            if serves:
                self.condition, self.started_s = Condition.RUNNING, time.monotonic()
            return serves

    def status(self) -> VehicleStatus:
        with self._changed:
            child, reported = self._child, self._reported
            row = msgspec.structs.replace(self.row(), restarts=self._restarts)
        if child is None or self.condition is not Condition.RUNNING or reported is None:
            return row
        return msgspec.structs.replace(
            reported, condition=self.condition, failed=row.failed, restarts=row.restarts, uptime_s=row.uptime_s
        )

    def end(
        self,
        within_s: float,
        reason: str,  # noqa: ARG002  (its process knows one of its own)
        hurry: Callable[[], bool] = lambda: False,
        *,
        unless_flying: bool = False,
    ) -> bool:
        """Ask its process to land and to end. It is not started again."""
        with self._changed:
            asked, self._stopping = self._stopping, True
            child = self._child
            self._changed.notify_all()
        if child is not None and child.code is None:
            if not asked:
                child.terminate()
            deadline_s = time.monotonic() + within_s
            while (left_s := deadline_s - time.monotonic()) > 0 and not hurry() and child.code is None:
                child.wait(min(left_s, _POLL_S))
            if unless_flying and child.code is None:
                return False
        with self._changed:
            child, self._child = self._child, None
            if self.condition is not Condition.FAILED:
                self.condition = Condition.STOPPED
        if child is not None:
            child.close()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()
        return True
