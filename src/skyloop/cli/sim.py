"""``skyloop sim``: several simulated drones in one world, each with a proxy of its own."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import urlencode

import typer

from skyloop.errors import UsageError

MOST_DRONES = 100
OWN_OPTIONS = ("world", "seed", "speed")


def sim(
    drones: Annotated[int, typer.Option(metavar="N", min=1, max=MOST_DRONES, help="How many, in one world")] = 1,
    world: Annotated[str, typer.Option(metavar="WORLD", help="Its name, or a file")] = "room",
    seed: Annotated[
        int, typer.Option(metavar="S", min=0, help="The same one gives the same wind, noise and targets")
    ] = 0,
    speed: Annotated[float, typer.Option(metavar="X", min=0.01, max=100.0, help="Simulated seconds in a second")] = 1.0,
    name: Annotated[
        str, typer.Option(metavar="NAME", help="Of the proxy; several get a number: sim1, sim2, …")
    ] = "sim",
    option: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE", help="Any other option of sim://, e.g. cameras=front; may be repeated"),
    ] = None,
) -> None:
    """Simulate drones that see one another in one world, each with a proxy of its own, until Ctrl-C."""
    from skyloop.cli.simulating import settle
    from skyloop.drivers.sim import SimDriver, options_of
    from skyloop.drivers.uri import parse_uri
    from skyloop.proxy import Proxy
    from skyloop.proxy.serve import run
    from skyloop.sim.host import SimHost
    from skyloop.transport.local import LocalServer

    uri = parse_uri(address(world, seed, speed, option or []))
    options = options_of(uri)
    settle(options)
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
