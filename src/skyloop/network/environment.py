"""Whether and how this process joins the network, by arguments or else by its environment."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Final

from skyloop.errors import Hint, UsageError
from skyloop.network import config
from skyloop.network.settings import LEASE_S, MAX_LEASE_S, FabricSettings, secured

_log = logging.getLogger(__name__)

NETWORK_VARIABLE: Final = "SKYLOOP_NETWORK"
KEYS_VARIABLE: Final = "SKYLOOP_KEYS"
LEASE_VARIABLE: Final = "SKYLOOP_LEASE_S"
MULTICAST: Final = "multicast"
_ON: Final = frozenset({MULTICAST, "on", "1", "true", "yes"})
_OFF: Final = frozenset({"", "off", "0", "false", "no"})

#: ``True``: search by multicast; addresses to call, with ``multicast`` among them to search as well, separated by
#: commas; ``False``: this host only; ``None``: as the environment says.
NetworkChoice = bool | str | FabricSettings | None


def choose(network: NetworkChoice = None, keys: Path | str | None = None) -> FabricSettings | None:
    """Return the settings of the network, None to stay on this host.

    A key that ends within a week is logged as a warning.

    Args:
        network: See :data:`NetworkChoice`; defaults to the variable ``SKYLOOP_NETWORK``, without which nothing leaves
            this host.
        keys: The folder of an identity; defaults to ``SKYLOOP_KEYS``.

    Raises:
        UsageError: An address, the folder or the variable ``SKYLOOP_LEASE_S`` is not valid.
    """
    found = _choose(network, keys)
    if found is not None and found.ring is not None:
        for change in found.ring.poll():
            _log.warning("%s", change)
    return found


def _choose(network: NetworkChoice, keys: Path | str | None) -> FabricSettings | None:
    if isinstance(network, FabricSettings):
        return network if keys is None else secure(network, keys)
    requested = os.environ.get(NETWORK_VARIABLE, "") if network is None else network
    if isinstance(requested, bool):
        requested = MULTICAST if requested else ""
    if requested.strip().lower() in _OFF:
        if keys is not None and network is None:
            raise UsageError("keys are for the network").with_hint(Hint.NAME_NETWORK)
        return None
    words = [word.strip() for word in requested.split(",") if word.strip()]
    connect = tuple(word for word in words if word.lower() not in _ON)
    return settings(connect=connect, multicast=len(connect) < len(words), keys=keys)


def serving(
    network: str,
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    multicast: bool = True,
    keys: Path | str | None = None,
) -> FabricSettings:
    """Return the settings of what serves on the network, or joins its parts.

    Args:
        network: ``multicast``, or addresses of routers with commas, with ``multicast`` among them for both.
        listen: Addresses to listen at.
        connect: More addresses to connect to.
        multicast: Whether to be found by multicast, where ``network`` names it.
        keys: The folder of an identity; defaults to ``SKYLOOP_KEYS``.

    Raises:
        UsageError: An address or the folder is not valid, or no place is named.
    """
    words = [word.strip() for word in network.split(",") if word.strip()]
    if not words:
        raise UsageError("the network names no place: give multicast, or addresses with commas")
    routers = [word for word in words if word.lower() != MULTICAST]
    return settings(
        listen=listen, connect=(*routers, *connect), multicast=multicast and len(routers) < len(words), keys=keys
    )


def settings(
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    multicast: bool = True,
    keys: Path | str | None = None,
) -> FabricSettings:
    """Make settings for the network.

    Args:
        listen: Addresses to listen at.
        connect: Addresses to connect to.
        multicast: Whether to search, and be found, by multicast.
        keys: The folder of an identity; defaults to ``SKYLOOP_KEYS``.

    Raises:
        UsageError: An address or the folder is not valid.
    """
    found = FabricSettings(listen=listen, connect=connect, multicast=multicast, lease_s=_lease_s())
    config.endpoints_of((*listen, *connect), found)  # says what is wrong with an address before anything is opened
    folder = keys or os.environ.get(KEYS_VARIABLE) or None
    return found if folder is None else secure(found, folder)


def _lease_s() -> float:
    """Return the lease that the environment asks for [s]. Raises :class:`UsageError`."""
    text = os.environ.get(LEASE_VARIABLE) or f"{LEASE_S:g}"
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"{LEASE_VARIABLE} is {text!r} and must be {LEASE_S:g} to {MAX_LEASE_S:g} seconds") from None


def secure(plain: FabricSettings, folder: Path | str) -> FabricSettings:
    """Return these settings with the identity in a folder.

    Raises:
        UsageError: The folder is not valid, or an address does not go with keys.
    """
    from skyloop.network.keys import load  # with keys only: it needs cryptography

    found = secured(plain, load(folder))
    config.endpoints_of((*found.listen, *found.connect), found)  # not all that are good without keys are with them
    return found
