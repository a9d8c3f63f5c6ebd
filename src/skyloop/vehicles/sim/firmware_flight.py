"""A simulated drone flown by real firmware: the process, and the driver that treats it as a real vehicle."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import msgspec

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.drivers.base import Driver, ExternalPose, Sink
from skyloop.drivers.registry import make_driver
from skyloop.errors import DriverError, UnsupportedError
from skyloop.messages import (
    AnyAction,
    Capabilities,
    EventKind,
    Feedback,
    LinkState,
    Severity,
    Value,
)
from skyloop.messages.feedback import WAKING_UP
from skyloop.sim.host import Report, SimHost
from skyloop.sim.options import SimOptions
from skyloop.sim.parameters import InstrumentParameters
from skyloop.sim.rotor_dynamics import rotors_of
from skyloop.vehicles.sim.firmware import AutopilotKind
from skyloop.vehicles.sim.firmware.program import CoupledFirmware, FirmwareEvent, FirmwareEventKind
from skyloop.vehicles.sim.telemetry import native_of as truth_of
from skyloop.vehicles.sim.telemetry import truth_at

#: Addresses for drivers that are never opened. Any address works, because capabilities don't depend on it.
_SOMEWHERE: Final = {
    **dict.fromkeys((AutopilotKind.ARDUPILOT, AutopilotKind.PX4), "mavlink://udpin:127.0.0.1:14550"),
    AutopilotKind.BETAFLIGHT: "msp://tcp:127.0.0.1:5761",
    AutopilotKind.CRAZYFLIE: "crazyflie://udp:127.0.0.1",
}
_NAMES: Final = {
    AutopilotKind.ARDUPILOT: "ArduCopter",
    AutopilotKind.BETAFLIGHT: "Betaflight",
    AutopilotKind.CRAZYFLIE: "Crazyflie",
    AutopilotKind.PX4: "PX4",
}
_ERRORS: Final = (FirmwareEventKind.SILENT, FirmwareEventKind.DIED, FirmwareEventKind.FAILED)
_KEPT_REPORTS: Final = 64  # number of reports kept, to find the truth at the time of delayed feedback
_POSE_STD_M: Final = 0.001  # standard deviation reported for the true position
#: Maximum age of the firmware's reported state, which arrives over loopback. If the simulation runs slower than real
#: time, so does the firmware's clock; the driver trusts that clock and would report a greater age.
_OLDEST_NS: Final = nanoseconds(0.05)
_LINK_OFF: Final = "the simulated radio is switched off (parameter sim.link)"


class FirmwareFlight:
    """Starts one drone's firmware and relays its driver's reports, adding the simulation's truth."""

    def __init__(self, options: SimOptions, inner_options: str) -> None:
        assert options.autopilot is not None
        self.kind = AutopilotKind(options.autopilot)
        self._options = options
        self._inner_options = inner_options
        self._pattern = make_driver(self._address(_SOMEWHERE[self.kind]))  # raises an error for an unknown option
        self._lock = threading.Lock()  # held while opening or closing the inner driver
        self._sink: Sink | None = None
        self._host: SimHost | None = None
        self._drone = 0
        self._firmware: CoupledFirmware | None = None
        self._inner: Driver | None = None
        self._found = False  # whether the driver has received data since the start
        self._linked = False  # whether the firmware's driver should be open
        self._reports: deque[Report] = deque(maxlen=_KEPT_REPORTS)

    def _address(self, address: str) -> str:
        if not self._inner_options:
            return address
        return f"{address}{'&' if '?' in address else '?'}{self._inner_options}"

    @property
    def firmware(self) -> CoupledFirmware | None:
        """The firmware; None unless the driver is open."""
        return self._firmware

    @property
    def driver(self) -> Driver:
        """The firmware's driver; before :meth:`open`, an unopened driver of the same kind."""
        return self._inner or self._pattern

    def capabilities(self, options: SimOptions) -> Capabilities:
        """Return the capabilities of the firmware's driver, but with the simulated cameras."""
        inner = self._pattern.capabilities()
        return Capabilities(
            vehicle="sim",
            actions=inner.actions,
            cameras=tuple(model.info() for model in options.cameras),
            description=f"{_NAMES[self.kind]} in the world {options.world!r}, seed {options.seed}",
        )

    # Life cycle ------------------------------------------------------------------------------------------------

    def open(self, host: SimHost, drone: int, sink: Sink) -> None:
        """Start the firmware and let it fly the drone; the firmware's driver is opened once the process is running."""
        self._host, self._drone, self._sink = host, drone, sink
        folder = Path(self._options.autopilot_folder) if self._options.autopilot_folder else None
        if folder is not None and host.drones > 1:
            folder /= f"drone{drone + 1}"  # each drone has its own settings
        instruments = rotors_of(host.simulation.parameters[drone]).instruments
        self._firmware = firmware = make_firmware(
            self.kind, self._happened, instruments=instruments, position=self._options.position, folder=folder
        )
        self._linked, self._found = True, False
        sink.link(LinkState.CONNECTING, self._starting)
        firmware.start()
        host.simulation.fly_by(drone, firmware)

    @property
    def _starting(self) -> str:
        return f"{WAKING_UP}: {_NAMES[self.kind]} is being started"

    def close(self) -> None:
        """Stop the rotors, then the driver and the firmware. Idempotent."""
        self._close_driver()
        host, firmware = self._host, self._firmware
        if host is not None and host.simulation.flown_by_firmware(self._drone):
            host.simulation.release(self._drone)
        if firmware is not None:
            firmware.close()
        self._firmware = self._host = self._sink = None
        self._reports.clear()

    def switch_link(self, *, on: bool) -> None:
        """Open or close the firmware's driver; while it is closed, the vehicle is out of radio range."""
        if on:
            self._linked = True
            self._open_driver()
            return
        self._close_driver()
        if self._sink is not None:
            self._sink.link(LinkState.LOST, _LINK_OFF)

    def _open_driver(self) -> None:
        with self._lock:
            firmware, sink = self._firmware, self._sink
            if not self._linked or self._inner is not None or firmware is None or sink is None:
                return
            made = make_driver(self._address(firmware.address))
            made.open(_InnerSink(self, sink))
            self._inner = made

    def _close_driver(self) -> None:
        with self._lock:
            self._linked = False
            inner, self._inner = self._inner, None
            if inner is not None:
                inner.close()

    def _happened(self, event: FirmwareEvent) -> None:
        sink = self._sink
        if sink is not None:
            severity = Severity.ERROR if event.kind in _ERRORS else Severity.INFO
            sink.event(EventKind.VEHICLE_MESSAGE, event.text, severity, reason=f"firmware_{event.kind}")
        if event.kind is FirmwareEventKind.STARTED:
            self._open_driver()
        elif event.kind is FirmwareEventKind.FAILED and sink is not None and not self._found:
            sink.link(LinkState.LOST, event.text, "fix the named problem; the start is retried")

    def link(self, state: LinkState, reason: str) -> tuple[LinkState, str, str]:
        """Translate a link state reported by the firmware's driver, with a reason and remedy that fit this drone.

        The driver assumes a vehicle that is started separately, at an address that a user has given.
        """
        self._found = self._found or state in (LinkState.UP, LinkState.DEGRADED)
        if not self._found:
            return LinkState.CONNECTING, self._starting, ""
        remedy = f"{_NAMES[self.kind]} runs within this drone, and restarts after an exit: wait, or read its "
        remedy += "output in firmware.log, which autopilot_folder=… keeps"
        return state, reason, remedy if state in (LinkState.CONNECTING, LinkState.LOST) else ""

    # Flying ----------------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, *, new: bool) -> AnyAction:
        """Pass an action to the firmware's driver; the action is lost if there is no link."""
        inner = self._inner
        return action if inner is None else inner.apply(action, new=new)

    def external_pose(self, pose: ExternalPose) -> None:
        """Pass an external pose to the firmware's driver."""
        inner = self._inner
        if inner is None:
            raise DriverError(_LINK_OFF)
        inner.external_pose(pose)

    # Called by the host and by the inner driver ----------------------------------------------------------------

    def report(self, report: Report) -> None:
        """Store the true state for later feedback, and pass it to a vehicle that needs an external position."""
        self._reports.append(report)
        inner = self._inner
        if self.kind is AutopilotKind.BETAFLIGHT and self._options.position and inner is not None:
            truth = report.truth
            captured_ns = max(report.captured_ns, monotonic_ns() - _OLDEST_NS)  # the firmware uses the computer's clock
            with suppress(DriverError, UnsupportedError):
                inner.external_pose(
                    ExternalPose(truth.position_m, truth.quaternion, captured_ns, position_std_m=_POSE_STD_M)
                )

    def with_truth(self, feedback: Feedback) -> Feedback:
        """Return the firmware's feedback with the true state at its time, or unchanged if no report has arrived."""
        reports = tuple(self._reports)
        if not reports:
            return feedback
        captured_ns = max(feedback.captured_ns, reports[-1].captured_ns - _OLDEST_NS)
        native = truth_of(truth_at(reports, captured_ns), self._options)
        return msgspec.structs.replace(feedback, captured_ns=captured_ns, native={**(feedback.native or {}), **native})


class _InnerSink:
    """Relays reports from the firmware's driver."""

    def __init__(self, flight: FirmwareFlight, sink: Sink) -> None:
        self._flight = flight
        self._sink = sink

    def feedback(self, feedback: Feedback) -> None:
        self._sink.feedback(self._flight.with_truth(feedback))

    def frame(self, *_: Any, **__: Any) -> None:
        raise NotImplementedError  # the simulated cameras' images take another path

    stream = frame

    def wants(self, camera: str) -> bool:  # noqa: ARG002
        return False

    wants_stream = wants

    def wanted_fps(self, camera: str) -> float:  # noqa: ARG002
        return 0.0

    def link(self, state: LinkState, reason: str = "", remedy: str = "") -> None:  # noqa: ARG002
        self._sink.link(*self._flight.link(state, reason))

    def event(self, kind: EventKind, text: str, severity: Severity = Severity.INFO, **data: Value) -> None:
        self._sink.event(kind, text, severity, **data)


def make_firmware(
    kind: AutopilotKind,
    on_event: Callable[[FirmwareEvent], None],
    *,
    instruments: InstrumentParameters,
    position: bool = True,
    folder: Path | None = None,
) -> CoupledFirmware:
    """Return the firmware, not started yet; ``position`` is whether a Crazyflie gets its true position."""
    if kind is AutopilotKind.ARDUPILOT:
        from skyloop.vehicles.sim.firmware.ardupilot import ArduCopter

        return ArduCopter(on_event, folder=folder)
    if kind is AutopilotKind.PX4:
        from skyloop.vehicles.sim.firmware.px4 import Px4

        return Px4(on_event, folder=folder, instruments=instruments)
    if kind is AutopilotKind.CRAZYFLIE:
        from skyloop.vehicles.sim.firmware.crazyflie import Crazyflie

        return Crazyflie(on_event, folder=folder, position=position)
    from skyloop.vehicles.sim.firmware.betaflight import Betaflight

    return Betaflight(on_event, folder=folder)
