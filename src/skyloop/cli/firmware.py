"""What ``skyloop sim --firmware`` does: simulated drones that are AR.Drones on the network."""

from __future__ import annotations

import signal
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import astuple
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.sim.firmware.ardrone import ArdroneFirmware, Faults, Ports
    from skyloop.sim.options import SimOptions

PORT_BASE: Final = 5550
PORTS_APART: Final = 10
LOOK_UP_S: Final = 0.2


class Firmware(StrEnum):
    """What can be emulated."""

    ARDRONE1 = "ardrone1"
    ARDRONE2 = "ardrone2"


def serve(
    options: SimOptions, drones: int, firmware: Firmware, *, bind: str, port_base: int, faults: Faults, delay_s: float
) -> None:
    """Run the drones until SIGINT or SIGTERM. On the main thread.

    Writes one line that begins with ``ready`` for each drone when all of them listen. Raises :class:`UsageError`, and
    :class:`skyloop.errors.LinkError` for a port that is taken.
    """
    from skyloop.sim.firmware.ardrone import ArdroneFirmware, with_ardrones
    from skyloop.sim.host import SimHost

    host = SimHost(with_ardrones(options), drones)
    version = 1 if firmware is Firmware.ARDRONE1 else 2
    all_ports = [ports_from(port_base, drone) for drone in range(drones)]
    _run(
        [
            ArdroneFirmware(host, drone, version=version, bind=bind, ports=ports, faults=faults, delay_s=delay_s)
            for drone, ports in enumerate(all_ports)
        ]
    )


def ports_from(base: int, drone: int) -> Ports:
    """The usual ports are those from 5550. Each further drone's are 10 higher; base 0 stands for any free ones.

    Raises :class:`UsageError` if they don't fit.
    """
    from skyloop.sim.firmware.ardrone import Ports

    if base == 0:
        return Ports.free()
    shift = base - PORT_BASE + drone * PORTS_APART
    ports = Ports(*(port + shift for port in astuple(Ports())))
    if not all(0 < port < 1 << 16 for port in astuple(ports)):
        raise UsageError(f"--port-base {base}: drone {drone} would need port {max(astuple(ports))}; the last is 65535")
    return ports


def _run(firmwares: Sequence[ArdroneFirmware]) -> None:
    asked = threading.Event()
    before = {number: signal.signal(number, lambda *_: asked.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with ExitStack() as started:
            for firmware in firmwares:
                started.enter_context(firmware)
            for firmware in firmwares:
                print(f"ready {describe(firmware)}", flush=True)
            while not asked.wait(LOOK_UP_S):  # a signal that another thread gets does not wake this one
                pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def describe(firmware: ArdroneFirmware) -> str:
    """One line: where it listens."""
    ports, settings = firmware.ports, firmware.settings
    video = "udp" if settings.version == 1 else "tcp"
    return (
        f"ardrone{settings.version} drone {firmware.drone} on {settings.bind}: at udp {ports.at}, "
        f"navdata udp {ports.navdata}, video {video} {ports.video}, control tcp {ports.control}"
    )
