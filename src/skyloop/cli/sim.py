"""``skyloop sim``: several simulated drones in one world.

Each has a proxy of its own, or is the firmware of a real drone for other people's programs.
"""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlencode

import typer

from skyloop.cli.firmware import Firmware, Serving, serve
from skyloop.cli.network import (
    ConnectOption,
    KeysOption,
    ListenOption,
    MakeEnd,
    MetricsOption,
    MulticastOption,
    ServeOption,
    key_changes,
    metrics_beside,
    server_ends,
    settings_of,
    warn_if_open,
)
from skyloop.errors import UsageError
from skyloop.vehicles.sim.firmware.kinds import AutopilotKind

if TYPE_CHECKING:
    from collections.abc import Callable

    from skyloop.drivers.uri import VehicleUri
    from skyloop.proxy.serve import Beside
    from skyloop.sim.options import SimOptions

MOST_DRONES = 100
OWN_OPTIONS = ("world", "seed", "speed")
NAME = "sim"
FIXED_BY_FIRMWARE = frozenset({"cameras", "width", "height", "fps", "latency", "native", "position", "truth", "rate"})
LOOPBACK = "127.0.0.1"
MOST_DELAY_S = 10.0


def sim(
    drones: Annotated[int, typer.Option(metavar="N", min=1, max=MOST_DRONES, help="How many, in one world")] = 1,
    world: Annotated[str, typer.Option(metavar="WORLD", help="Its name, or a file")] = "room",
    seed: Annotated[
        int, typer.Option(metavar="S", min=0, help="The same one gives the same wind, noise and targets")
    ] = 0,
    speed: Annotated[float, typer.Option(metavar="X", min=0.01, max=100.0, help="Simulated seconds in a second")] = 1.0,
    name: Annotated[str, typer.Option(metavar="NAME", help="Of the proxy; several get a number: sim1, sim2, …")] = NAME,
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE", help="Any other option of sim://, e.g. cameras=front; may be repeated"),
    ] = None,
    autopilot: Annotated[
        list[AutopilotKind] | None,
        typer.Option(
            metavar="KIND",
            help="Real firmware flies the drones: ardupilot, betaflight or px4; its program by SKYLOOP_ARDUCOPTER, "
            "SKYLOOP_BETAFLIGHT or SKYLOOP_PX4; several, by repeating it, are given to the drones in turn",
        ),
    ] = None,
    network: ServeOption = None,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    multicast: MulticastOption = True,
    keys: KeysOption = None,
    metrics: MetricsOption = None,
    firmware: Annotated[
        Firmware | None,
        typer.Option(
            metavar="KIND",
            help="Be a real drone for other programs instead: ardrone1, ardrone2, arducopter, betaflight, px4 or tello",
        ),
    ] = None,
    bind: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help=f"Of the firmware: where it listens [{LOOPBACK}]")
    ] = None,
    port_base: Annotated[
        int | None,
        typer.Option(
            metavar="P", min=0, max=65000, help="Of the firmware: its ports count from here, not the usual; 0 any free"
        ),
    ] = None,
    lose: Annotated[
        float | None, typer.Option(metavar="SHARE", min=0, max=1, help="Of the firmware: datagrams lost, each way")
    ] = None,
    delay: Annotated[
        float | None,
        typer.Option(metavar="S", min=0, max=MOST_DELAY_S, help="Of the firmware: datagrams late, each way [s]"),
    ] = None,
    repeat: Annotated[
        float | None, typer.Option(metavar="SHARE", min=0, max=1, help="Of the firmware: datagrams that come twice")
    ] = None,
    reorder: Annotated[
        float | None,
        typer.Option(metavar="SHARE", min=0, max=1, help="Of the firmware: datagrams that come after the next"),
    ] = None,
    video_port: Annotated[
        int | None,
        typer.Option(metavar="P", min=1, max=65000, help="Of arducopter and px4: where the camera's video is sent"),
    ] = None,
    fault_seed: Annotated[
        int | None, typer.Option(metavar="S", min=0, help="Of the firmware: the same one, the same faults [0]")
    ] = None,
) -> None:
    """Simulate drones that see one another in one world, each with a proxy of its own, until Ctrl-C.

    With --autopilot real ArduCopter, PX4 or Betaflight flies them (docs/autopilots.md). With --firmware each is an
    emulated drone's firmware on the network instead, for any program that flies the real one.

    Examples: skyloop sim --drones 2; SKYLOOP_ARDUCOPTER=bin/arducopter skyloop sim --autopilot ardupilot --option
    cameras=front.
    """
    from skyloop.cli.simulating import settle
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
            raise UsageError(f"{given[0]} is for --firmware: give --firmware {Firmware.ARDRONE2} as well")
        network_settings = settings_of(network, listen, connect, multicast, keys)
        settle(options)
        names = [name] if drones == 1 else [f"{name}{number}" for number in range(1, drones + 1)]
        warn_if_open(network_settings, names)
        look, beside = key_changes(network_settings), metrics_beside(metrics)
        _serve_proxies(uris, options, names, server_ends(network_settings), look, beside)
        return
    if metrics is not None:
        raise UsageError("--metrics is of proxies, and with --firmware there is none: leave it out")
    if network is not None:
        raise UsageError("--network is for proxies, and with --firmware there is none: give --bind ADDRESS instead")
    if options.autopilot is not None:
        raise UsageError("--autopilot is real firmware and --firmware an emulation of it: give one of them")
    _refuse_for_firmware(name, uri)
    from skyloop.vehicles.ardrone.emulator import Faults

    settle(options)
    faults = Faults(seed=fault_seed or 0, drop=lose or 0.0, duplicate=repeat or 0.0, reorder=reorder or 0.0)
    serve(options, drones, firmware, Serving(bind or LOOPBACK, port_base, faults, delay or 0.0, video_port))


def _refuse_for_firmware(name: str, uri: VehicleUri) -> None:
    if name != NAME:
        raise UsageError("--name is the proxy's, and with --firmware there is none: leave it out")
    fixed = sorted(FIXED_BY_FIRMWARE.intersection(uri.options))
    if fixed:
        raise UsageError(f"--option {fixed[0]} can't be chosen with --firmware: the emulated drone has its own")


def _world_options(uris: list[VehicleUri], drones: int) -> SimOptions:
    """Return the options of the world that these drones share.

    Raises:
        UsageError: An option is not valid, or the drones can't share a world.
    """
    from skyloop.vehicles.sim.options import options_of

    if len(uris) > drones:
        raise UsageError(f"--autopilot is given {len(uris)} times for --drones {drones}: give one for each at most")
    each = [options_of(uri) for uri in uris]
    if any(options.parameters != each[0].parameters for options in each):
        raise UsageError("these --autopilot usually fly different vehicles: choose one, such as --option vehicle=iris")
    return min(each, key=lambda options: options.most_lag_s)  # one that keeps the computer's time decides


def _serve_proxies(
    uris: list[VehicleUri],
    options: SimOptions,
    names: list[str],
    make_end: MakeEnd,
    look: Callable[[], list[str]] | None,
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
    run(proxies, look=look, beside=beside)


def address(world: str, seed: int, speed: float, others: list[str]) -> str:
    """Return the vehicles' address.

    Raises:
        UsageError: There is no such option, or its value is not valid.
    """
    settings = {"world": world, "seed": str(seed), "speed": f"{speed:g}"}
    for text in others:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"--option {text!r} has no value: it looks like --option cameras=front")
        if key in OWN_OPTIONS:
            raise UsageError(f"--option {text!r}: give --{key} {value} instead")
        if key in settings:
            raise UsageError(f"--option {key} is given twice")
        settings[key] = value
    return "sim://?" + urlencode(settings, safe="/,")
