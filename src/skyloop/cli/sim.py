"""``skyloop sim``: several simulated drones in one world, each with a proxy of its own, or each an AR.Drone for other
people's programs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlencode

import typer

from skyloop.cli.firmware import PORT_BASE, Firmware, serve
from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.drivers.uri import VehicleUri
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
    firmware: Annotated[
        Firmware | None,
        typer.Option(help="Be an AR.Drone for other programs instead, e.g. --firmware ardrone2 --lose 0.1"),
    ] = None,
    bind: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help=f"Of the firmware: where it listens [{LOOPBACK}]")
    ] = None,
    port_base: Annotated[
        int | None,
        typer.Option(
            metavar="P", min=0, max=65000, help=f"Of the firmware: its ports count from here [{PORT_BASE}]; 0 any free"
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
    fault_seed: Annotated[
        int | None, typer.Option(metavar="S", min=0, help="Of the firmware: the same one, the same faults [0]")
    ] = None,
) -> None:
    """Simulate drones that see one another in one world, each with a proxy of its own, until Ctrl-C.

    With --firmware each is an AR.Drone on the network instead, for any program that flies the real one.
    """
    from skyloop.cli.simulating import settle
    from skyloop.drivers.sim import options_of
    from skyloop.drivers.uri import parse_uri

    uri = parse_uri(address(world, seed, speed, option or []))
    options = options_of(uri)
    settings = {
        "--bind": bind,
        "--port-base": port_base,
        "--lose": lose,
        "--delay": delay,
        "--repeat": repeat,
        "--reorder": reorder,
        "--fault-seed": fault_seed,
    }
    if firmware is None:
        given = [word for word, value in settings.items() if value is not None]
        if given:
            raise UsageError(f"{given[0]} is for --firmware: say --firmware {Firmware.ARDRONE2} as well")
        settle(options)
        _serve_proxies(uri, options, drones, name)
        return
    _refuse_for_firmware(name, uri)
    from skyloop.sim.firmware.ardrone import Faults

    settle(options)
    serve(
        options,
        drones,
        firmware,
        bind=bind or LOOPBACK,
        port_base=PORT_BASE if port_base is None else port_base,
        faults=Faults(seed=fault_seed or 0, drop=lose or 0.0, duplicate=repeat or 0.0, reorder=reorder or 0.0),
        delay_s=delay or 0.0,
    )


def _refuse_for_firmware(name: str, uri: VehicleUri) -> None:
    if name != NAME:
        raise UsageError("--name is the proxy's, and with --firmware there is none: leave it out")
    fixed = sorted(FIXED_BY_FIRMWARE.intersection(uri.options))
    if fixed:
        raise UsageError(f"--option {fixed[0]} can't be chosen with --firmware: the emulated drone has its own")


def _serve_proxies(uri: VehicleUri, options: SimOptions, drones: int, name: str) -> None:
    from skyloop.drivers.sim import SimDriver
    from skyloop.proxy import Proxy
    from skyloop.proxy.serve import run
    from skyloop.sim.host import SimHost
    from skyloop.transport.local import LocalServer

    host = SimHost(options, drones)
    names = [name] if drones == 1 else [f"{name}{number}" for number in range(1, drones + 1)]
    drivers = [SimDriver(uri, host=host, drone=index) for index in range(drones)]
    run([Proxy(driver, LocalServer(each), name=each) for driver, each in zip(drivers, names, strict=True)])


def address(world: str, seed: int, speed: float, others: list[str]) -> str:
    """The vehicles' address. Raises :class:`UsageError` for what is no option."""
    settings = {"world": world, "seed": str(seed), "speed": f"{speed:g}"}
    for text in others:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"--option {text!r} has no value: it looks like --option cameras=front")
        if key in OWN_OPTIONS:
            raise UsageError(f"--option {text!r}: say --{key} {value}")
        if key in settings:
            raise UsageError(f"--option {key} is given twice")
        settings[key] = value
    return "sim://?" + urlencode(settings, safe="/,")
