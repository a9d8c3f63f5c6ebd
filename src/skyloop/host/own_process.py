"""A vehicle whose proxy runs in a separate process. The process is restarted when it dies.

The process runs ``python -m skyloop.host.own_process NAME`` and receives its settings when it starts. The process ends
with its host, immediately and without a landing, just like a proxy inside the host's process. Each line of its standard
output is a status for the host, in JSON.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from skyloop.child_process import ChildProcess, RestartingChild, handed_over
from skyloop.drivers.registry import make_driver
from skyloop.errors import RefusedError, SkyloopError
from skyloop.host.fleet import VehicleSettings, decoder_of_handed, encode_handed
from skyloop.host.vehicle import Condition, HostedVehicle, VehicleStatus, network_of, reason_of, row_of
from skyloop.proxy import Proxy
from skyloop.proxy.serve import run
from skyloop.transport.base import TransportServer
from skyloop.transport.local import LocalServer

STARTS_WITHIN_S: Final = 20.0  #: time limit for the first report
FIRST_PAUSE_S: Final = 0.5  #: pause before the first restart; it doubles each time the process dies
LONGEST_PAUSE_S: Final = 30.0  #: maximum length of the pause before a restart
#: Number of checks without a report, at four per second, after which the process is considered hung and killed. Checks
#: are counted rather than seconds, because the computer may have been suspended in the meantime.
SILENT_CHECKS: Final = 40
STARTING_CHECKS: Final = 80  #: the same limit for the time before the process has sent its first report
STEADY_S: Final = 60.0  #: a process that ran for this long before it died is restarted after the shortest pause
_POLL_S: Final = 0.05  # interval at which ``hurry`` is polled
_decoder: Final = msgspec.json.Decoder(VehicleStatus)
_log = logging.getLogger(__name__)
FAILED: Final = 1  #: exit status if the vehicle can't be served
STATUS_EVERY_S: Final = 0.25  #: interval between reports


def pause_s(deaths: int) -> float:
    """Return the pause before restarting a process that has died this many times in a row [s]."""
    return float(min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** min(deaths - 1, 20)))


class OwnProcessVehicle(HostedVehicle):
    """A vehicle with ``process = "own"``. Its driver can only harm its own process.

    ``announce`` is called with a line of text for users when the process dies and when it is restarted. ``command``
    starts the process. The vehicle's name is appended to the command, and the vehicle's settings are passed separately.
    """

    def __init__(
        self,
        settings: VehicleSettings,
        announce: Callable[[str], None],
        command: tuple[str, ...] = (sys.executable, "-m", "skyloop.host.own_process"),
    ) -> None:
        super().__init__(settings)
        self._announce = announce
        self._changed = threading.Condition()  # guards all of the following attributes
        self._reported: VehicleStatus | None = None  # the status that the current process reported
        self._silent_checks = 0  # number of checks since the process last sent a report
        self._deaths = 0  # number of deaths in a row
        self._runner = RestartingChild(
            [*command, settings.name],
            handed=encode_handed(settings).decode(),
            name=f"skyloop-{settings.name}-process",
            read=self._read,
            ended=self._ended,
            started=self._started,
            silent=self._is_silent,
        )

    def start(self) -> None:
        self.condition = Condition.STARTING
        self._runner.start()
        with self._changed:
            self._changed.wait_for(lambda: self.condition is not Condition.STARTING, STARTS_WITHIN_S)
            served, why = self.condition is Condition.RUNNING, self.failed
        if not served:
            self._runner.stop(0.0, 1.0)
            raise RefusedError(why or f"its process reported nothing within {STARTS_WITHIN_S:g} s", code="failed")

    def _started(self, _child: ChildProcess) -> None:
        with self._changed:
            self._reported, self._silent_checks = None, 0

    def _read(self, child: ChildProcess) -> None:
        for line in child.stdout:
            try:
                status = _decoder.decode(line)
            except msgspec.DecodeError:  # a line that a driver printed
                _log.info("%s: %s", self.settings.name, line.decode(errors="replace").rstrip())
                continue
            with self._changed:
                if self._runner.child is not child:
                    return
                again = self._reported is None and self.condition is Condition.RESTARTING
                self._reported, self._silent_checks = status, 0
                serves = status.condition is Condition.RUNNING
                if serves and self.condition is not Condition.RUNNING and not self._runner.stopping:
                    self.condition, self.started_s = Condition.RUNNING, time.monotonic()
                self._changed.notify_all()
            if again and serves:
                self._announce(f"vehicle of {self.settings.name}: running again, process {child.pid}")

    def _is_silent(self) -> bool:
        """Return whether the process has stopped sending reports although no one asked it to end."""
        with self._changed:
            self._silent_checks += 1
            most = STARTING_CHECKS if self._reported is None else SILENT_CHECKS
            silent = self._silent_checks >= most and not self._runner.stopping
        if silent:
            _log.error("the process of %s has stopped reporting: killing it", self.settings.name)
        return silent

    def _ended(self, child: ChildProcess | None, ending: str) -> float | None:
        """Record that a process has ended; return the pause before starting the next one."""
        with self._changed:
            reported = self._reported
            self.failed = (reported.failed if reported is not None else "") or f"its process {ending}"
            first = self.condition is Condition.STARTING
            stops = first or self._runner.stopping
            self.condition = Condition.FAILED if first else Condition.STOPPED if stops else Condition.RESTARTING
            steady = self.started_s + STEADY_S < time.monotonic() and reported is not None
            self._deaths = 1 if steady else self._deaths + 1
            self._changed.notify_all()
        if stops:
            return None
        pause, number = pause_s(self._deaths), "" if child is None else f" (pid {child.pid})"
        self._announce(f"vehicle of {self.settings.name}: {self.failed}{number}; restarting in {pause:g} s")
        return pause

    def status(self) -> VehicleStatus:
        with self._changed:
            reported = self._reported
            row = msgspec.structs.replace(self.row(), restarts=self._runner.restarts)
        if self.condition is not Condition.RUNNING or reported is None:
            return row
        return msgspec.structs.replace(
            reported, condition=self.condition, failed=row.failed, restarts=row.restarts, uptime_s=row.uptime_s
        )

    def end(
        self,
        within_s: float,
        reason: str,  # noqa: ARG002  (its process has its own)
        hurry: Callable[[], bool] = lambda: False,
        *,
        unless_flying: bool = False,
    ) -> bool:
        """Ask the process to land the vehicle and end. The vehicle is not restarted."""
        asked = self._runner.stopping
        child = self._runner.request_stop()
        if child is not None and child.code is None:
            if not asked:
                child.terminate()
            deadline_s = time.monotonic() + within_s
            while (left_s := deadline_s - time.monotonic()) > 0 and child.code is None:
                if hurry():
                    child.part()  # end immediately, or land first if the vehicle would otherwise fall
                child.wait(min(left_s, _POLL_S))
            if unless_flying and child.code is None:
                return False
        self._runner.stop()
        if self.condition is not Condition.FAILED:
            self.condition = Condition.STOPPED
        return True


def serve(settings: VehicleSettings) -> None:
    """Serve one vehicle until SIGTERM (which lands it first) or until the host ends. Must run on the main thread."""
    network = network_of(settings)
    driver = make_driver(settings.address)
    end: TransportServer = LocalServer(settings.name, group=settings.group)
    if network is not None:
        from skyloop.network.server import beside

        end = beside(end, settings.name, network, str(driver.uri))
    proxy = Proxy(driver, end, name=settings.name)
    proxy.parameters.preset(settings.presets)
    keys = None if network is None or network.ring is None else network.ring.poll
    row = VehicleStatus(settings.name, str(settings.address), Condition.RUNNING, process="own", pid=os.getpid())
    began_s, reported_s = time.monotonic(), 0.0

    def report() -> Sequence[str]:
        """Report the proxy's status several times a second; return updates about the keys."""
        nonlocal reported_s
        now_s = time.monotonic()
        if now_s - reported_s >= STATUS_EVERY_S:
            reported_s = now_s
            _write(msgspec.structs.replace(row, uptime_s=now_s - began_s, **row_of(proxy)))
        return () if keys is None else keys()

    run([proxy], parent_fd=0, poll=report, records=True)


def _write(status: VehicleStatus) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(status) + b"\n")
    sys.stdout.buffer.flush()


def main() -> None:
    """Serve the vehicle whose settings were passed to this process."""
    settings = decoder_of_handed(VehicleSettings).decode(handed_over() or "")
    try:
        serve(settings)
    except SkyloopError as error:
        _write(VehicleStatus(settings.name, str(settings.address), Condition.FAILED, failed=reason_of(error)))
        sys.exit(FAILED)


if __name__ == "__main__":
    main()
