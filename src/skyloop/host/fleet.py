"""Read a host's vehicle file, ``fleet.toml``, as described in ``docs/host.md``. Pure except that it reads the file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec

from skyloop.drivers.registry import driver_class
from skyloop.drivers.uri import VehicleUri, parse_uri
from skyloop.errors import FileFormatError, SkyloopError, UsageError
from skyloop.files import decoded, expand
from skyloop.messages import Value
from skyloop.proxy.parameters import check_presets
from skyloop.toml_file import MAX_BYTES, Place, parse_toml, read_tables
from skyloop.transport.base import check_name
from skyloop.zones import ZONES

HOST: Final = "host"  #: default name of a host
#: Schemes where every use of an address creates a new vehicle, so that two vehicles may share one.
MADE_BY_ADDRESS: Final = frozenset({"sim", "video", "replay"})
Text = Annotated[str, msgspec.Meta(min_length=1)]
T = TypeVar("T")


class FlightLimits(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """``limits``: the values of the proxy parameters with the same names."""

    tilt: float | None = None
    climb: float | None = None
    yaw_rate: float | None = None
    speed: float | None = None
    altitude: float | None = None


class Defaults(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """``[defaults]``: settings for each vehicle that does not override them."""

    network: Text | None = None  #: the same as ``--network`` of ``skyloop proxy``; ``off``: this host only
    listen: list[str] | None = None
    multicast: bool | None = None  #: whether multicast discovery is used if ``network`` includes it
    keys: Text | None = None  #: an identity's folder
    group: Text | None = None  #: users who may connect in addition to the current user
    limits: FlightLimits | None = None
    zones: list[str] | None = None
    parameters: dict[str, Any] | None = None  #: the proxy's parameters, by name
    autostart: bool | None = None
    process: Literal["shared", "own"] | None = None


class Vehicle(Defaults, frozen=True, omit_defaults=True, forbid_unknown_fields=True, kw_only=True):
    """One vehicle in the file (``[[vehicle]]``)."""

    name: Text
    address: Text


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: Text = HOST
    defaults: Defaults = Defaults()
    vehicle: list[Vehicle] = []


class VehicleSettings(msgspec.Struct, frozen=True, omit_defaults=True):
    """The settings of one vehicle on a host, with all defaults filled in."""

    name: str
    address: VehicleUri
    network: str | None = None  #: None: this host only
    listen: tuple[str, ...] = ()
    multicast: bool = True
    keys: str | None = None
    group: str | None = None
    presets: dict[str, Value] = {}  #: the proxy's parameters
    autostart: bool = True
    own_process: bool = False


def encode_handed(value: object) -> bytes:
    """Encode settings, alone or nested, for the process that serves the vehicle. Includes the secrets in addresses."""
    return msgspec.json.encode(value, enc_hook=_revealed)


def decoder_of_handed(kind: Any) -> msgspec.json.Decoder[Any]:
    """Return a decoder for values of this type that :func:`encode_handed` encoded."""
    return msgspec.json.Decoder(kind, dec_hook=lambda _, text: parse_uri(text))


def _revealed(value: object) -> str:
    if not isinstance(value, VehicleUri):
        raise TypeError(f"{type(value).__name__} can't be encoded")
    return value.reveal_text()


class Fleet(msgspec.Struct, frozen=True):
    """The vehicles of a host."""

    name: str
    vehicles: tuple[VehicleSettings, ...]
    defaults: Defaults  #: the default settings of vehicles added by address


def read_fleet(path: Path) -> Fleet:
    """Read a host's vehicle file. Paths of key folders in it are relative to the file's own folder."""
    path = expand(path)
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise UsageError(f"the vehicle file {path} can't be read: {error.strerror}") from None
    if len(data) > MAX_BYTES:
        raise FileFormatError(f"{path}: the file has more than {MAX_BYTES} bytes")
    try:
        text = decoded(data)
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from None
    fleet = parse_fleet(text, str(path))

    def from_here(keys: str | None) -> str | None:
        return None if keys is None else str((path.parent / expand(keys)).resolve())

    replace = msgspec.structs.replace
    return replace(
        fleet,
        vehicles=tuple(replace(vehicle, keys=from_here(vehicle.keys)) for vehicle in fleet.vehicles),
        defaults=replace(fleet.defaults, keys=from_here(fleet.defaults.keys)),
    )


def parse_fleet(text: str, source: str) -> Fleet:
    """Parse the text of a vehicle file; see :func:`read_fleet`."""
    found = read_tables(parse_toml(text, source), source, _File)
    top = Place(source)
    _checked(top, "name", lambda: check_name(found.name))
    settings_of(Vehicle(name="unnamed", address="sim://"), found.defaults, top.under("defaults"), found.defaults)
    seen: dict[str, Place] = {}
    vehicles: list[VehicleSettings] = []
    for number, vehicle in enumerate(found.vehicle, start=1):
        place = top.item("vehicle", number, vehicle.name)
        settings = settings_of(vehicle, found.defaults, place, vehicle)
        if settings.name in seen:
            raise place.error("name", f"{settings.name!r} is the name of two vehicles; names must be unique")
        for other in vehicles:
            if other.address == settings.address and settings.address.scheme not in MADE_BY_ADDRESS:
                raise place.error("address", f"{str(settings.address)!r} is also the address of {other.name!r}")
        seen[settings.name] = place
        vehicles.append(settings)
    return Fleet(found.name, tuple(vehicles), found.defaults)


def settings_of(vehicle: Vehicle, defaults: Defaults, place: Place, own: Defaults) -> VehicleSettings:
    """Return a vehicle's settings with defaults filled in. ``own`` contains the file's values at ``place``."""
    _checked(place, "name", lambda: check_name(vehicle.name))
    uri = _checked(place, "address", lambda: parse_uri(vehicle.address))
    _checked(place, "address", lambda: driver_class(uri.scheme))

    def either(key: str) -> Any:
        value = getattr(vehicle, key)
        return getattr(defaults, key) if value is None else value

    network = either("network")
    if network == "off":
        network = None
    for key in ("keys", "listen"):
        if network is None and getattr(own, key) and own is vehicle:
            raise place.error(key, 'it needs the network: also set network = "multicast", or addresses')
    presets = {**_presets(defaults), **_presets(vehicle)}
    own_presets = _presets(own)
    for name in own_presets:
        _check_preset(place, name, own_presets)
    return VehicleSettings(
        name=vehicle.name,
        address=uri,
        network=network,
        listen=tuple(either("listen") or ()) if network is not None else (),
        multicast=either("multicast") is not False,
        keys=either("keys") if network is not None else None,
        group=either("group"),
        presets=_checked(place, "parameters", lambda: check_presets(presets)),
        autostart=either("autostart") is not False,
        own_process=either("process") == "own",
    )


def _presets(table: Defaults) -> dict[str, Value]:
    limits = {} if table.limits is None else msgspec.structs.asdict(table.limits)
    found: dict[str, Value] = {f"limits.{name}": value for name, value in limits.items() if value is not None}
    if table.zones is not None:
        found[ZONES] = "; ".join(table.zones)
    for name, value in (table.parameters or {}).items():
        found[name] = tuple(value) if isinstance(value, list) else value
    return found


def _check_preset(place: Place, name: str, presets: dict[str, Value]) -> None:
    limit = name.removeprefix("limits.")
    if name == ZONES:
        at, key = place, "zones"
    elif name.startswith("limits.") and limit in FlightLimits.__struct_fields__:
        at, key = place.under("limits"), limit
    else:
        at, key = place.under("parameters"), name
    _checked(at, key, lambda: check_presets({name: presets[name]}))


def _checked(place: Place, key: str, check: Any) -> Any:
    """Return the result of ``check``, and convert its exceptions to errors about the file."""
    try:
        return check()
    except FileFormatError:
        raise
    except SkyloopError as error:
        raise place.error(key, error.reason) from None
