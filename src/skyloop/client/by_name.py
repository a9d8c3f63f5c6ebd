"""A proxy looked for by its name: on this host first, then on the network if it may be asked."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from skyloop.errors import LinkError, UnknownNameError
from skyloop.transport.base import ClientEnd, ClientHandler, Dialer
from skyloop.transport.names import check_name

if TYPE_CHECKING:
    from skyloop.transport.fabric.environment import Network
    from skyloop.transport.fabric.settings import FabricSettings

NETWORK_VARIABLE: Final = "SKYLOOP_NETWORK"
_HINT: Final = "; only this host was looked at (network=True, or the variable SKYLOOP_NETWORK, looks further)"


def network_settings(network: Network = None, keys: Path | str | None = None) -> FabricSettings | None:
    """How to look on the network, None if not at all. See :func:`skyloop.connect`."""
    if network is False or (network is None and keys is None and not os.environ.get(NETWORK_VARIABLE)):
        return None  # without loading what is not needed
    from skyloop.transport.fabric.environment import choose

    return choose(network, keys)


def dial_by_name(name: str, network: Network = None, keys: Path | str | None = None) -> Dialer:
    """The dialer of the proxy with this name: each time the one of this host if there is one.

    Raises :class:`UsageError`. The dialer raises :class:`UnknownNameError`, which says where it looked, and
    :class:`LinkError`.
    """
    check_name(name)
    settings = network_settings(network, keys)
    if settings is None:
        return _hinting(_local(name))
    from skyloop.transport.fabric import dial

    far = dial(name, settings)
    if sys.platform != "linux":
        return far
    near = _local(name)

    def dialer(handler: ClientHandler) -> ClientEnd:
        try:
            return near(handler)
        except LinkError:
            return far(handler)  # it was killed and left its socket, or belongs to another user
        except UnknownNameError as here:
            known = here.known
        try:
            return far(handler)
        except UnknownNameError as there:
            place = f"proxy on this host or the network ({settings.reach})"
            raise UnknownNameError(place, name, {*known, *there.known}) from None

    return dialer


def _local(name: str) -> Dialer:
    from skyloop.transport.local import dial

    return dial(name)


def _hinting(near: Dialer) -> Dialer:
    def dialer(handler: ClientHandler) -> ClientEnd:
        try:
            return near(handler)
        except UnknownNameError as error:
            error.message += _HINT
            raise

    return dialer
