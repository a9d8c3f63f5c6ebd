"""``skyloop param``: lists, shows and writes a vehicle's parameters."""

from __future__ import annotations

from typing import Annotated, Final

import msgspec
import typer

from skyloop.cli import naming
from skyloop.cli.text import columns, print_json
from skyloop.errors import UsageError
from skyloop.messages import Parameter, ParameterType, Value

ADVICE: Final = "write after they have landed, or take over with a higher --priority (a lower number, 0 is the highest)"
TRUTH: Final = {
    word: truth for truth, words in ((True, "true yes on 1"), (False, "false no off 0")) for word in words.split()
}
LONGEST_VALUE: Final = 30  #: maximum length of a value in a table; a simulator's world has a thousand characters
KINDS: Final = {
    ParameterType.BOOL: "true or false",
    ParameterType.INT: "a whole number",
    ParameterType.FLOAT: "a number",
    ParameterType.VECTOR: "numbers such as 0.1,0,-0.5",
    ParameterType.TEXT: "text",
}


def param(
    name: naming.NameArgument = None,
    key: Annotated[
        str | None,
        typer.Argument(
            metavar="[KEY]", help="Parameter, or first part of several: limits", autocompletion=naming.parameter_names
        ),
    ] = None,
    value: Annotated[
        str | None, typer.Argument(metavar="[VALUE]", help="New value; takes the authority for a moment")
    ] = None,
    drone: naming.DroneOption = None,
    priority: Annotated[
        int, typer.Option(metavar="P", min=0, max=31, help="Priority for writing: 0 is the highest, 31 the lowest")
    ] = 31,
    json: Annotated[bool, typer.Option("--json", help="Print the parameters as a JSON array")] = False,
    network: naming.NetworkOption = None,
    keys: naming.KeysOption = None,
) -> None:
    """List a vehicle's parameters, or show or set one of them."""
    if drone is not None:  # in this case, the remaining words are KEY and VALUE
        if value is not None and name != drone:
            raise UsageError(f"NAME {name} and --drone {drone} name two drones: give only one")
        if name != drone:
            name, key, value = drone, name, key
    naming.join_network(network, keys)
    name = naming.one_drone(name, drone)
    if key is not None and value is None and "=" in key:
        key, value = key.split("=", 1)
    found = _write(name, key, value, priority) if key is not None and value is not None else _read(name, key)
    if json:
        print_json([msgspec.structs.asdict(each) for each in found])
        return
    typer.echo("\n".join(details(found[0]) if [each.name for each in found] == [key] else table(found)))


def _read(name: str, key: str | None) -> list[Parameter]:
    from skyloop.client import connect

    with connect(name, access="observe", name="skyloop param") as drone:
        if key is None:
            return drone.config.parameters()
        group = [each for each in drone.config.parameters() if each.name.startswith(f"{key.rstrip('.')}.")]
        return group or [drone.config.describe(key)]


def _write(name: str, key: str, value: str, priority: int) -> list[Parameter]:
    from skyloop.cli.listing import connect_pilot
    from skyloop.client import Authority

    authority = Authority(priority=priority)
    with connect_pilot(name, ADVICE, authority=authority, name="skyloop param", on_exit="hover") as drone:
        drone.config[key] = parse_value(drone.config.describe(key), value)
        return [drone.config.describe(key)]


def parse_value(parameter: Parameter, text: str) -> Value:
    """Parse a value typed by a person, according to the parameter's type."""
    try:
        match parameter.type:
            case ParameterType.BOOL:
                return TRUTH[text.strip().lower()]
            case ParameterType.INT:
                return int(text)
            case ParameterType.FLOAT:
                return float(text)
            case ParameterType.VECTOR:
                return tuple(float(part) for part in text.strip(" ()[]").replace(",", " ").split())
            case ParameterType.TEXT:
                return text
    except (ValueError, KeyError):
        raise UsageError(f"{parameter.name} takes {KINDS[parameter.type]}, not {text!r}") from None


def table(parameters: list[Parameter]) -> list[str]:
    """Return a line for each parameter: name, value with unit, and allowed values. Long values are truncated."""
    rows = [(p.name, shorten(f"{show(p.value)} {p.unit}".rstrip()), allowed(p)) for p in parameters]
    return columns([("PARAMETER", "VALUE", "ALLOWED"), *rows])


def shorten(value: str) -> str:
    return value if len(value) <= LONGEST_VALUE else f"{value[: LONGEST_VALUE - 1]}…"


def details(parameter: Parameter) -> list[str]:
    p = parameter
    rows = [
        (p.name, f"{show(p.value)} {p.unit}".rstrip()),
        ("  allowed", allowed(p) or KINDS[p.type]),
        ("  default", "" if p.default is None else show(p.default)),
        ("  momentary", "each write acts once" if p.momentary else ""),
        ("  what", p.description),
    ]
    return columns([row for row in rows if row[1]])


def allowed(parameter: Parameter) -> str:
    """Return a parameter's allowed values as text for users."""
    p = parameter
    if p.read_only:
        return "read-only"
    if p.choices:
        return ", ".join(map(show, p.choices))
    if p.type is ParameterType.BOOL:
        return KINDS[p.type]
    low, high = ("" if end is None else f"{end:g}" for end in (p.minimum, p.maximum))
    if low and high:
        return f"{low} to {high}" + (" each" if p.type is ParameterType.VECTOR else "")
    return f"at least {low}" if low else f"at most {high}" if high else ""


def show(value: Value) -> str:
    """Return a value as a person would type it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ",".join(map(show, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)
