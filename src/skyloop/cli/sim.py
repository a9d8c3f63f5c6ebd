"""``skyloop sim``: several simulated drones in one world.

Each has its own proxy or, with ``--firmware``, is an emulation of a real drone's firmware for other people's programs.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import astuple, dataclass
from enum import StrEnum
from itertools import cycle
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias
from urllib.parse import urlencode

import typer

from skyloop.cli import network as net
from skyloop.errors import UsageError
from skyloop.vehicles.sim.firmware import AutopilotKind

if TYPE_CHECKING:
    from collections.abc import Callable

    from skyloop.drivers.uri import VehicleUri
    from skyloop.faults import Faults
    from skyloop.proxy.serve import Beside
    from skyloop.sim.options import SimOptions
    from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports
    from skyloop.vehicles.crazyflie.emulator import CrazyflieFirmware
    from skyloop.vehicles.mavlink.emulator import MavlinkFirmware
    from skyloop.vehicles.msp.emulator import BetaflightFirmware
    from skyloop.vehicles.tello.emulator import TelloFirmware

    Emulated: TypeAlias = ArdroneFirmware | BetaflightFirmware | CrazyflieFirmware | MavlinkFirmware | TelloFirmware

MOST_DRONES = 100  #: maximum value of --drones
OWN_OPTIONS = ("world", "seed", "speed")
NAME = "sim"
FIXED_BY_FIRMWARE = frozenset({"cameras", "width", "height", "fps", "latency", "native", "position", "truth", "rate"})
LOOPBACK = "127.0.0.1"
MOST_DELAY_S = 10.0  #: maximum value of --delay
PORT_BASE: Final = 5550  #: --port-base of an AR.Drone that uses the usual ports
PORTS_APART: Final = 10  #: distance between the ports of one AR.Drone and those of the next
_POLL_S: Final = 0.2  # interval between checks for signals


def sim(
    drones: Annotated[int, typer.Option(metavar="N", min=1, max=MOST_DRONES, help="Number of drones in the world")] = 1,
    world: Annotated[str, typer.Option(metavar="WORLD", help="Name or file of the world")] = "room",
    seed: Annotated[int, typer.Option(metavar="S", min=0, help="Seed of wind, noise and targets")] = 0,
    speed: Annotated[float, typer.Option(metavar="X", min=0.01, max=100.0, help="Simulated seconds per second")] = 1.0,
    name: Annotated[str, typer.Option(metavar="NAME", help="Proxy name; several are numbered: sim1, sim2, …")] = NAME,
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE", help="Any other option of sim://, e.g. cameras=front; repeatable"),
    ] = None,
    autopilot: Annotated[
        list[AutopilotKind] | None,
        typer.Option(
            metavar="KIND",
            help="Fly with real firmware: ardupilot, betaflight, crazyflie or px4, whose program SKYLOOP_ARDUCOPTER, "
            "SKYLOOP_BETAFLIGHT, SKYLOOP_CRAZYFLIE or SKYLOOP_PX4 names; repeat it to give the drones several in turn",
        ),
    ] = None,
    network: net.ServeOption = None,
    listen: net.ListenOption = None,
    connect: net.ConnectOption = None,
    multicast: net.MulticastOption = True,
    keys: net.KeysOption = None,
    metrics: net.MetricsOption = None,
    firmware: Annotated[
        FirmwareKind | None,
        typer.Option(
            metavar="KIND",
            help="Emulate a drone for other programs instead: ardrone1, ardrone2, arducopter, betaflight, crazyflie, "
            "esp-drone, px4 or tello",
        ),
    ] = None,
    bind: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help=f"Firmware: address to listen on [{LOOPBACK}]")
    ] = None,
    port_base: Annotated[
        int | None,
        typer.Option(metavar="P", min=0, max=65000, help="Firmware: first port, instead of the usual one; 0: any free"),
    ] = None,
    lose: Annotated[
        float | None, typer.Option(metavar="SHARE", min=0, max=1, help="Firmware: fraction of datagrams lost, each way")
    ] = None,
    delay: Annotated[
        float | None,
        typer.Option(metavar="S", min=0, max=MOST_DELAY_S, help="Firmware: delay of datagrams, each way [s]"),
    ] = None,
    repeat: Annotated[
        float | None, typer.Option(metavar="SHARE", min=0, max=1, help="Firmware: fraction of datagrams duplicated")
    ] = None,
    reorder: Annotated[
        float | None,
        typer.Option(metavar="SHARE", min=0, max=1, help="Firmware: fraction of datagrams swapped with the next"),
    ] = None,
    video_port: Annotated[
        int | None,
        typer.Option(
            metavar="P",
            min=1,
            max=65000,
            help="For arducopter and px4: port to send the video to; for crazyflie: port of its AI-deck's images",
        ),
    ] = None,
    fault_seed: Annotated[int | None, typer.Option(metavar="S", min=0, help="Firmware: seed of the faults [0]")] = None,
) -> None:
    """Simulate drones that see one another in one world until Ctrl-C; each has its own proxy.

    With --autopilot, the drones are flown by the firmware of real vehicles (docs/autopilots.md). With --firmware,
    each is instead an emulation of a real drone's firmware on the network, for any program that can fly it.

    Examples: skyloop sim --drones 2; SKYLOOP_ARDUCOPTER=bin/arducopter skyloop sim --autopilot ardupilot --option
    cameras=front.
    """
    from skyloop.drivers.uri import parse_uri

    chosen = [[f"autopilot={kind}"] for kind in autopilot] if autopilot else [[]]
    uris = [parse_uri(address(world, seed, speed, [*each, *(option or [])])) for each in chosen]
    uri, options = uris[0], _world_options(uris, drones)
    settings = {
        "--bind": bind,
        "--port-base": port_base,
        "--lose": lose,
        "--delay": delay,
        "--repeat": repeat,
        "--reorder": reorder,
        "--fault-seed": fault_seed,
        "--video-port": video_port,
    }
    if firmware is None:
        given = [word for word, value in settings.items() if value is not None]
        if given:
            raise UsageError(f"{given[0]} is for --firmware: give --firmware {FirmwareKind.ARDRONE2} as well")
        network_settings = net.settings_of(network, listen, connect, multicast, keys)
        net.settle(options)
        names = [name] if drones == 1 else [f"{name}{number}" for number in range(1, drones + 1)]
        net.warn_if_open(network_settings, names)
        poll, beside = net.key_changes(network_settings), net.metrics_beside(metrics)
        _serve_proxies(uris, options, names, net.server_ends(network_settings), poll, beside)
        return
    if metrics is not None:
        raise UsageError("--metrics is for proxies, and with --firmware there is none: leave it out")
    if network is not None:
        raise UsageError("--network is for proxies, and with --firmware there is none: give --bind ADDRESS instead")
    if options.autopilot is not None:
        raise UsageError("--autopilot is real firmware and --firmware an emulation of it: give one of them")
    _refuse_for_firmware(name, uri)
    from skyloop.vehicles.ardrone.emulator import Faults

    net.settle(options)
    faults = Faults(seed=fault_seed or 0, drop=lose or 0.0, duplicate=repeat or 0.0, reorder=reorder or 0.0)
    serve(options, drones, firmware, Serving(bind or LOOPBACK, port_base, faults, delay or 0.0, video_port))


def _refuse_for_firmware(name: str, uri: VehicleUri) -> None:
    if name != NAME:
        raise UsageError("--name is the proxy's, and with --firmware there is none: leave it out")
    fixed = sorted(FIXED_BY_FIRMWARE.intersection(uri.options))
    if fixed:
        raise UsageError(f"--option {fixed[0]} can't be set with --firmware: the emulated drone has its own")


def _world_options(uris: list[VehicleUri], drones: int) -> SimOptions:
    """Return the options of the world that the drones share."""
    from skyloop.vehicles.sim.options import options_of

    if len(uris) > drones:
        raise UsageError(f"--autopilot given {len(uris)} times for --drones {drones}: give at most one for each")
    each = [options_of(uri) for uri in uris]
    if any(options.parameters != each[0].parameters for options in each):
        raise UsageError(
            "these --autopilot fly different vehicles by default: choose one, such as --option vehicle=iris"
        )
    return min(each, key=lambda options: options.most_lag_s)  # the strictest limit on the computer's lag applies


def _serve_proxies(
    uris: list[VehicleUri],
    options: SimOptions,
    names: list[str],
    make_end: net.MakeEnd,
    poll: Callable[[], list[str]] | None,
    beside: Beside | None,
) -> None:
    from skyloop.proxy import Proxy
    from skyloop.proxy.serve import run
    from skyloop.sim.host import SimHost
    from skyloop.vehicles.sim.driver import SimDriver

    host = SimHost(options, len(names))
    drivers = [SimDriver(uri, host=host, drone=n) for n, uri in zip(range(len(names)), cycle(uris), strict=False)]
    proxies = [
        Proxy(driver, make_end(each, str(driver.uri)), name=each) for driver, each in zip(drivers, names, strict=True)
    ]
    run(proxies, poll=poll, beside=beside)


def address(world: str, seed: int, speed: float, others: list[str]) -> str:
    """Return the address of the vehicles. ``others``: options of the form KEY=VALUE."""
    settings = {"world": world, "seed": str(seed), "speed": f"{speed:g}"}
    for text in others:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"--option {text!r} has no value: use the form --option cameras=front")
        if key in OWN_OPTIONS:
            raise UsageError(f"--option {text!r}: give --{key} {value} instead")
        if key in settings:
            raise UsageError(f"--option {key} is given twice")
        settings[key] = value
    return "sim://?" + urlencode(settings, safe="/,")


class FirmwareKind(StrEnum):
    """The kinds of firmware that can be emulated."""

    ARDRONE1 = "ardrone1"
    ARDRONE2 = "ardrone2"
    ARDUCOPTER = "arducopter"
    BETAFLIGHT = "betaflight"
    CRAZYFLIE = "crazyflie"
    ESP_DRONE = "esp-drone"
    PX4 = "px4"
    TELLO = "tello"


MAVLINK: Final = (FirmwareKind.ARDUCOPTER, FirmwareKind.PX4)
CRAZYFLIES: Final = (FirmwareKind.CRAZYFLIE, FirmwareKind.ESP_DRONE)


@dataclass(frozen=True, slots=True)
class Serving:
    """The addresses of the emulated drones, and the faults that are injected into their datagrams."""

    bind: str
    port_base: int | None  #: first port; None for the usual ones
    faults: Faults
    delay_s: float
    video_port: int | None = None  #: for autopilots: port to which video is sent; None for no video


def serve(options: SimOptions, drones: int, firmware: FirmwareKind, serving: Serving) -> None:
    """Run the drones until the process receives SIGINT or SIGTERM. Must run on the main thread.

    Once all drones are listening, print one line for each that begins with ``ready``. Raise ``UsageError`` if an option
    is invalid, and ``LinkError`` if a port is already in use.
    """
    if firmware in MAVLINK:
        _run(_autopilots(options, drones, firmware, serving))
    elif firmware in CRAZYFLIES:
        _run(_crazyflies(options, drones, firmware, serving))
    elif serving.video_port is not None:
        raise UsageError("--video-port is for --firmware arducopter, crazyflie and px4: the others have their own port")
    elif firmware is FirmwareKind.BETAFLIGHT:
        _run(_racers(options, drones, serving))
    elif firmware is FirmwareKind.TELLO:
        _run(_tellos(options, drones, serving))
    else:
        _run(_ardrones(options, drones, firmware, serving))


def _ardrones(options: SimOptions, drones: int, firmware: FirmwareKind, serving: Serving) -> list[ArdroneFirmware]:
    from skyloop.sim.host import SimHost
    from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, with_ardrones

    host = SimHost(with_ardrones(options), drones)
    base = PORT_BASE if serving.port_base is None else serving.port_base
    all_ports = [ports_from(base, drone) for drone in range(drones)]
    return [
        ArdroneFirmware(
            host,
            drone,
            version=1 if firmware is FirmwareKind.ARDRONE1 else 2,
            bind=serving.bind,
            ports=ports,
            faults=serving.faults,
            delay_s=serving.delay_s,
        )
        for drone, ports in enumerate(all_ports)
    ]


def _autopilots(options: SimOptions, drones: int, firmware: FirmwareKind, serving: Serving) -> list[MavlinkFirmware]:
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
    from skyloop.vehicles.msp.emulator import PORT, BetaflightFirmware, with_racers

    if serving.faults.drop or serving.delay_s:
        raise UsageError(
            "--lose and --delay are for datagrams: --firmware betaflight speaks over TCP, which loses none"
        )
    base = PORT if serving.port_base is None else serving.port_base
    host = SimHost(with_racers(options), drones)
    return [
        BetaflightFirmware(host, drone, bind=serving.bind, port=base + drone if base else 0) for drone in range(drones)
    ]


def _crazyflies(options: SimOptions, drones: int, firmware: FirmwareKind, serving: Serving) -> list[CrazyflieFirmware]:
    from skyloop.sim.host import SimHost
    from skyloop.vehicles.crazyflie.emulator import CrazyflieFirmware, DeckSettings, with_crazyflies
    from skyloop.vehicles.crazyflie.wire.crtp import ESP_PORT, UDP_PORT

    checksum, video = firmware is FirmwareKind.ESP_DRONE, serving.video_port
    usual = ESP_PORT if checksum else UDP_PORT
    base = usual if serving.port_base is None else serving.port_base
    host = SimHost(with_crazyflies(options), drones)
    return [
        CrazyflieFirmware(
            host,
            drone,
            bind=serving.bind,
            port=base + drone if base else 0,
            checksum=checksum,
            faults=serving.faults,
            delay_s=serving.delay_s,
            deck=None if video is None else DeckSettings(bind=serving.bind, port=video + drone),
        )
        for drone in range(drones)
    ]


def _tellos(options: SimOptions, drones: int, serving: Serving) -> list[TelloFirmware]:
    from skyloop.sim.host import SimHost
    from skyloop.sim.render.planar import Quality, prepare
    from skyloop.vehicles.tello.emulator import FRONT, TelloFirmware, with_tellos
    from skyloop.vehicles.tello.wire import PORT

    prepare(FRONT, Quality(options.quality))  # compile now, so that the first image is not delayed
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
    """Return the address of a Tello. All use the same port, and each one's address follows the previous one's."""
    if drone == 0:
        return base
    try:
        return str(ipaddress.IPv4Address(base) + drone)
    except ValueError:
        raise UsageError(f"--bind {base}: several Tellos need an IPv4 address to count from") from None


def ports_from(base: int, drone: int) -> Ports:
    """Return an AR.Drone's ports: ``base`` plus 10 for each preceding drone; if it is 0, any free ports."""
    from skyloop.vehicles.ardrone.emulator import Ports

    if base == 0:
        return Ports.free()
    shift = base - PORT_BASE + drone * PORTS_APART
    ports = Ports(*(port + shift for port in astuple(Ports())))
    if not all(0 < port < 1 << 16 for port in astuple(ports)):
        raise UsageError(f"--port-base {base}: drone {drone} would need port {max(astuple(ports))}; the last is 65535")
    return ports


def _run(firmwares: Sequence[Emulated]) -> None:
    from skyloop.proxy.serve import Shutdown, on_signals

    shutdown = Shutdown()
    with on_signals(shutdown, ignore_interrupt=False), ExitStack() as started:
        for firmware in firmwares:
            started.enter_context(firmware)
        for firmware in firmwares:
            print(f"ready {describe(firmware)}", flush=True)
        while not shutdown.requested.wait(_POLL_S):
            pass  # poll, because a signal delivered to another thread does not wake this one


def describe(firmware: Emulated) -> str:
    """Return a line that lists a drone's ports."""
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
