"""A simulated drone without a second process: ``skyloop.connect("sim://?process=none")``.

Proxy, simulator and application share this process and the clock of the computer, for notebooks, classes and systems
where starting a process is slow or forbidden. All rules of a proxy apply, but the application's computation delays the
proxy, and other processes can't reach the drone. Only simulated drones fly this way: the failsafe of a real vehicle
must survive the application.
"""

from __future__ import annotations

import sys
import threading
from functools import partial
from typing import TYPE_CHECKING, Final

from skyloop.child_process import GRACE_S
from skyloop.client.connect import ORPHAN_LANDS_WITHIN_S
from skyloop.client.connection import Scheduler
from skyloop.clock import SWITCH_INTERVAL_S
from skyloop.errors import DriverError, LinkError, UsageError
from skyloop.transport.base import Dialer

if TYPE_CHECKING:
    from skyloop.drivers.uri import VehicleUri

_OPTION: Final = "process"


def connector(uri: str) -> InProcess | None:
    """Start the proxy of a simulated drone. The entry point ``sim`` in the group ``skyloop.connectors``.

    Returns None for an address without ``process=none``, which a private proxy serves.

    Raises:
        UsageError: The address is invalid, or ``process`` has another value.
        LinkError: The simulated drone can't be started.
    """
    if f"{_OPTION}=" not in uri:  # the usual case: import nothing
        return None
    from skyloop.drivers.uri import VehicleUri, parse_uri

    given = parse_uri(uri)
    options = {name: given.reveal(name) or "" for name in given.options}
    process = options.pop(_OPTION, None)
    if process is None:
        return None
    if process != "none":
        raise UsageError(f"{given}: {_OPTION} is {process!r} and must be none; leave it out for a separate process")
    return InProcess(VehicleUri(given.scheme, given.reveal_place(), options, uri))


class InProcess:
    """The proxy of a simulated drone in this process, and the way to reach it."""

    def __init__(self, uri: VehicleUri) -> None:
        """Start the proxy."""
        from skyloop.drivers.registry import make_driver
        from skyloop.proxy.proxy import Proxy
        from skyloop.transport.memory import MemoryServer

        self.reach = None
        self.scheduler = Scheduler()
        self._server = MemoryServer("sim")
        self._proxy = Proxy(make_driver(uri), self._server, name="sim")
        # A busy application thread must hand the interpreter to the proxy as soon as in a process that only serves.
        sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_INTERVAL_S))
        try:
            self._proxy.start()
        except DriverError as error:
            raise LinkError(f"the simulated drone {uri} could not be started: {error}") from error

    def dialer(self, deadline_s: float) -> Dialer:  # noqa: ARG002  (the proxy is already serving)
        """Return a dialer for the proxy, which already accepts connections."""
        return self._server.dial

    def close(self) -> None:
        """End the proxy; if it is landing a flying drone, wait for it for at most 4 s. Idempotent."""
        end = partial(self._proxy.end, ORPHAN_LANDS_WITHIN_S, reason="the application closed its drone")
        thread = threading.Thread(target=end, name="skyloop-in-process-end", daemon=True)
        thread.start()
        thread.join(GRACE_S)
