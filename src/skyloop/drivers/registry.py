"""Finds drivers by the entry-point group ``skyloop.drivers``: the entry point's name is the URI scheme.

A driver's module is imported when a vehicle of its scheme is asked for, and not before.
"""

from __future__ import annotations

from collections import defaultdict
from importlib.metadata import EntryPoint, entry_points
from typing import Final

from skyloop.drivers.base import Driver
from skyloop.drivers.uri import VehicleUri, parse_uri
from skyloop.errors import DriverError, SkyloopError, UnknownNameError

GROUP: Final = "skyloop.drivers"


def known_schemes() -> list[str]:
    """The schemes that an installed package claims, sorted. Imports no driver."""
    return sorted(_claims())


def driver_class(scheme: str) -> type[Driver]:
    """The class of driver for a scheme, imported now.

    Raises :class:`UnknownNameError` for a scheme that nobody claims and :class:`DriverError` for one that two
    packages claim or whose class cannot be had; both name the packages.
    """
    claims = _claims()
    if scheme not in claims:
        raise UnknownNameError("vehicle driver", scheme, claims)
    claimed = claims[scheme]
    if len(claimed) > 1:
        rivals = " and ".join(sorted(_owner(entry) for entry in claimed))
        raise DriverError(f"{scheme}:// is claimed by {rivals}: uninstall all but one of them")
    return _load(claimed[0])


def make_driver(uri: str | VehicleUri) -> Driver:
    """A driver for a vehicle's address, not yet opened.

    Raises :class:`UsageError` for an address or option that makes no sense, and what :func:`driver_class` raises.
    """
    parsed = parse_uri(uri) if isinstance(uri, str) else uri
    return driver_class(parsed.scheme)(parsed)


def _claims() -> dict[str, list[EntryPoint]]:
    claims: dict[str, dict[tuple[str, str], EntryPoint]] = defaultdict(dict)
    for entry in entry_points(group=GROUP):
        # One package may be found twice, through two folders of the path; that is no second claim.
        claims[entry.name][entry.value, _package(entry)] = entry
    return {scheme: list(found.values()) for scheme, found in claims.items()}


def _load(entry: EntryPoint) -> type[Driver]:
    try:
        loaded = entry.load()
    except SkyloopError:  # says already what is missing and how to install it
        raise
    except Exception as error:
        raise DriverError(f"the driver for {entry.name}:// of {_owner(entry)} cannot be loaded: {error!r}") from error
    if not (isinstance(loaded, type) and issubclass(loaded, Driver)):
        raise DriverError(
            f"the driver for {entry.name}:// of {_owner(entry)} is not a class of skyloop.drivers.base.Driver"
        )
    return loaded


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "an unnamed package"


def _owner(entry: EntryPoint) -> str:
    return f"package {_package(entry)} ({entry.value})"
