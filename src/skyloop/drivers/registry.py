"""Find drivers in the entry-point group ``skyloop.drivers``, in which the name of each entry point is a URI scheme.

A driver's module is imported only when a vehicle with its scheme is requested.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from importlib.metadata import EntryPoint, entry_points
from typing import Final

from skyloop.drivers.base import Driver
from skyloop.drivers.uri import VehicleUri, parse_uri
from skyloop.errors import DriverError, SkyloopError, UnknownNameError

GROUP: Final = "skyloop.drivers"
#: Cache by scheme and package folders: reading entry points takes 20 ms, and a host may have thousands of drones.
_loaded: Final[dict[tuple[str, tuple[str, ...]], type[Driver]]] = {}


def known_schemes() -> list[str]:
    """Return the sorted schemes that installed packages claim, without importing any driver."""
    return sorted(_claims())


def driver_class(scheme: str) -> type[Driver]:
    """Import and return the driver class for a scheme, for example ``ardrone``.

    Raises:
        UnknownNameError: If no installed package claims the scheme.
        DriverError: If two packages claim the scheme, or the class can't be loaded; the message names the packages.
        MissingExtraError: If a package that the driver needs is not installed.
    """
    known = scheme, tuple(sys.path)
    if known in _loaded and _loaded[known].__module__ in sys.modules:
        return _loaded[known]
    claims = _claims()
    if scheme not in claims:
        raise UnknownNameError("vehicle driver", scheme, claims)
    claimed = claims[scheme]
    if len(claimed) > 1:
        rivals = " and ".join(sorted(_owner(entry) for entry in claimed))
        raise DriverError(f"{scheme}:// is claimed by {rivals}: uninstall all but one of them")
    _loaded[known] = _load(claimed[0])
    return _loaded[known]


def make_driver(uri: str | VehicleUri) -> Driver:
    """Return an unopened driver for a vehicle's address.

    Raises the errors of :func:`driver_class`, and :class:`UsageError` if the address or one of its options is invalid.
    """
    parsed = parse_uri(uri) if isinstance(uri, str) else uri
    return driver_class(parsed.scheme)(parsed)


def _claims() -> dict[str, list[EntryPoint]]:
    claims: dict[str, dict[tuple[str, str], EntryPoint]] = defaultdict(dict)
    for entry in entry_points(group=GROUP):
        # A package found in two folders of sys.path counts as a single claim.
        claims[entry.name][entry.value, _package(entry)] = entry
    return {scheme: list(found.values()) for scheme, found in claims.items()}


def _load(entry: EntryPoint) -> type[Driver]:
    try:
        loaded = entry.load()
    except SkyloopError:  # its message names the missing package and explains how to install it
        raise
    except Exception as error:
        raise DriverError(f"the driver for {entry.name}:// from {_owner(entry)} cannot be loaded: {error!r}") from error
    if not (isinstance(loaded, type) and issubclass(loaded, Driver)):
        raise DriverError(
            f"the driver for {entry.name}:// from {_owner(entry)} is not a subclass of skyloop.drivers.base.Driver"
        )
    return loaded


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "an unnamed package"


def _owner(entry: EntryPoint) -> str:
    return f"package {_package(entry)} ({entry.value})"
