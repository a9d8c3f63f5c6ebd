"""``skyloop sim --firmware``: simulated drones that behave as real vehicles' firmware on the network."""

from __future__ import annotations

import ipaddress
import signal
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import astuple, dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final, TypeAlias

from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.faults import Faults
    from skyloop.sim.options import SimOptions
    from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports
    from skyloop.vehicles.mavlink.emulator import MavlinkFirmware
    from skyloop.vehicles.msp.emulator import BetaflightFirmware
    from skyloop.vehicles.tello.emulator import TelloFirmware

    Emulated: TypeAlias = ArdroneFirmware | BetaflightFirmware | MavlinkFirmware | TelloFirmware

PORT_BASE: Final = 5550
PORTS_APART: Final = 10
LOOK_UP_S: Final = 0.2


class Firmware(StrEnum):
    """The kinds of firmware that can be emulated."""

    ARDRONE1 = "ardrone1"
    ARDRONE2 = "ardrone2"
    ARDUCOPTER = "arducopter"
    BETAFLIGHT = "betaflight"
    PX4 = "px4"
    TELLO = "tello"


MAVLINK: Final = (Firmware.ARDUCOPTER, Firmware.PX4)


@dataclass(frozen=True, slots=True)
class Serving:
    """Where the emulated drones listen, and what happens to their datagrams."""

    bind: str
    port_base: int | None  #: None: the usual ports
    faults: Faults
    delay_s: float
    video_port: int | None = None  #: of autopilots: where pictures are sent; None: nowhere


def serve(options: SimOptions, drones: int, firmware: Firmware, serving: Serving) -> None:
    """Run the drones until SIGINT or SIGTERM. On the main thread.

    One line that begins with ``ready`` is written for each drone when all of them listen.

    Raises:
        UsageError: An option is not valid.
        LinkError: A port is taken.
    """
    if firmware in MAVLINK:
        _run(_autopilots(options, drones, firmware, serving))
    elif serving.video_port is not None:
        raise UsageError("--video-port is for --firmware arducopter and px4: the others have a port of their own")
    elif firmware is Firmware.BETAFLIGHT:
        _run(_racers(options, drones, serving))
    elif firmware is Firmware.TELLO:
        _run(_tellos(options, drones, serving))
    else:
        _run(_ardrones(options, drones, firmware, serving))


def _ardrones(options: SimOptions, drones: int, firmware: Firmware, serving: Serving) -> list[ArdroneFirmware]:
    from skyloop.sim.host import SimHost
    from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, with_ardrones

    host = SimHost(with_ardrones(options), drones)
    base = PORT_BASE if serving.port_base is None else serving.port_base
    all_ports = [ports_from(base, drone) for drone in range(drones)]
    return [
        ArdroneFirmware(
            host,
            drone,
            version=1 if firmware is Firmware.ARDRONE1 else 2,
            bind=serving.bind,
            ports=ports,
            faults=serving.faults,
            delay_s=serving.delay_s,
        )
        for drone, ports in enumerate(all_ports)
    ]


def _autopilots(options: SimOptions, drones: int, firmware: Firmware, serving: Serving) -> list[MavlinkFirmware]:
    from skyloop.sim.host import SimHost
    from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors

    kind, video = Kind(firmware.value), serving.video_port
    host = SimHost(with_multirotors(options), drones)
    all_ports = Ports.several(kind, serving.port_base, drones)
    return [
        MavlinkFirmware(
            host,
            drone,
            kind=kind,
            bind=serving.bind,
            ports=ports,
            faults=serving.faults,
            delay_s=serving.delay_s,
            video=None if video is None else ("127.0.0.1", video + drone),
        )
        for drone, ports in enumerate(all_ports)
    ]


def _racers(options: SimOptions, drones: int, serving: Serving) -> list[BetaflightFirmware]:
    from skyloop.sim.host import SimHost
    from skyloop.vehicles.msp.emulator import BetaflightFirmware, with_racers
    from skyloop.vehicles.msp.emulator.board import PORT

    if serving.faults.drop or serving.delay_s:
        raise UsageError(
            "--lose and --delay are for datagrams: --firmware betaflight speaks over TCP, which loses none"
        )
    base = PORT if serving.port_base is None else serving.port_base
    host = SimHost(with_racers(options), drones)
    return [
        BetaflightFirmware(host, drone, bind=serving.bind, port=base + drone if base else 0) for drone in range(drones)
    ]


def _tellos(options: SimOptions, drones: int, serving: Serving) -> list[TelloFirmware]:
    from skyloop.sim.host import SimHost
    from skyloop.sim.render.planar import Quality, prepare
    from skyloop.vehicles.tello.emulator import FRONT, TelloFirmware, with_tellos
    from skyloop.vehicles.tello.wire import PORT

    prepare(FRONT, Quality(options.quality))  # so that its first picture comes at once when it is asked for
    host = SimHost(with_tellos(options), drones)
    return [
        TelloFirmware(
            host,
            drone,
            bind=address_from(serving.bind, drone),
            port=PORT if serving.port_base is None else serving.port_base,
            faults=serving.faults,
            delay_s=serving.delay_s,
        )
        for drone in range(drones)
    ]


def address_from(base: str, drone: int) -> str:
    """Return the address of a Tello: all have the same port, and each further one the next address.

    Raises:
        UsageError: The first address is not IPv4, or there is no next one.
    """
    if drone == 0:
        return base
    try:
        return str(ipaddress.IPv4Address(base) + drone)
    except ValueError:
        raise UsageError(f"--bind {base}: several Tellos need an IPv4 address to count their own from") from None


def ports_from(base: int, drone: int) -> Ports:
    """Return the ports of an AR.Drone; each further drone's are 10 higher.

    Args:
        base: From where the first drone's ports count, usually 5550; 0 for any free ones.
        drone: The drone's index.

    Raises:
        UsageError: There are no such ports.
    """
    from skyloop.vehicles.ardrone.emulator import Ports

    if base == 0:
        return Ports.free()
    shift = base - PORT_BASE + drone * PORTS_APART
    ports = Ports(*(port + shift for port in astuple(Ports())))
    if not all(0 < port < 1 << 16 for port in astuple(ports)):
        raise UsageError(f"--port-base {base}: drone {drone} would need port {max(astuple(ports))}; the last is 65535")
    return ports


def _run(firmwares: Sequence[Emulated]) -> None:
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


def describe(firmware: Emulated) -> str:
    """Return one line with the ports of a drone."""
    from skyloop.vehicles.ardrone.emulator import ArdroneFirmware
    from skyloop.vehicles.tello.emulator import TelloFirmware

    if isinstance(firmware, TelloFirmware):
        tello = firmware.settings
        return f"tello drone {firmware.drone} on {tello.bind}: commands udp {firmware.port}, SDK {tello.sdk}"
    if not isinstance(firmware, ArdroneFirmware):
        return firmware.description
    ports, settings = firmware.ports, firmware.settings
    video = "udp" if settings.version == 1 else "tcp"
    return (
        f"ardrone{settings.version} drone {firmware.drone} on {settings.bind}: at udp {ports.at}, "
        f"navdata udp {ports.navdata}, video {video} {ports.video}, control tcp {ports.control}"
    )
