"""The process of one vehicle of a host: ``python -m skyloop.host.child NAME``, which a host starts.

The host hands over its settings. It ends with its host, at once and without landing, as a proxy of the host's own
process does. Each line of its standard output is a status in JSON, for the host.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from typing import Final

import msgspec

from skyloop.child_process import handed_over
from skyloop.drivers.registry import make_driver
from skyloop.errors import SkyloopError
from skyloop.host.fleet import VehicleSettings, decoder_of_handed
from skyloop.host.vehicle import Condition, VehicleStatus, network_of, of_proxy, reason_of
from skyloop.proxy import Proxy
from skyloop.proxy.serve import run
from skyloop.transport.base import TransportServer
from skyloop.transport.local import LocalServer

FAILED: Final = 1
STATUS_EVERY_S: Final = 0.25


def serve(settings: VehicleSettings) -> None:
    """Serve one vehicle until SIGTERM, which lands it, or the end of the host. On the main thread.

    Raises:
        SkyloopError: It can't be served.
    """
    network = network_of(settings)
    driver = make_driver(settings.address)
    end: TransportServer = LocalServer(settings.name, group=settings.group)
    if network is not None:
        from skyloop.network import FabricServer
        from skyloop.transport.composite import CompositeServer

        end = CompositeServer([end, FabricServer(settings.name, network, vehicle=str(driver.uri))])
    proxy = Proxy(driver, end, name=settings.name)
    proxy.parameters.preset(settings.presets)
    reporter = _Reporter(settings, proxy)
    keys = None if network is None or network.ring is None else network.ring.poll

    def look() -> Sequence[str]:
        reporter.report()
        return () if keys is None else keys()

    run([proxy], parent_fd=0, look=look, records=True)


class _Reporter:
    """Writes the status of a proxy to standard output, several times a second."""

    def __init__(self, settings: VehicleSettings, proxy: Proxy) -> None:
        self._settings = settings
        self._proxy = proxy
        self._began_s = time.monotonic()
        self._said_s = 0.0

    def report(self) -> None:
        now_s = time.monotonic()
        if now_s - self._said_s < STATUS_EVERY_S:
            return
        self._said_s = now_s
        row = VehicleStatus(
            self._settings.name,
            str(self._settings.address),
            Condition.RUNNING,
            uptime_s=now_s - self._began_s,
            process="own",
            pid=os.getpid(),
        )
        _write(msgspec.structs.replace(row, **of_proxy(self._proxy)))


def _write(status: VehicleStatus) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(status) + b"\n")
    sys.stdout.buffer.flush()


def main() -> None:
    """Serve the vehicle of the settings that were handed over."""
    settings = decoder_of_handed(VehicleSettings).decode(handed_over() or "")
    try:
        serve(settings)
    except SkyloopError as error:
        _write(VehicleStatus(settings.name, str(settings.address), Condition.FAILED, failed=reason_of(error)))
        sys.exit(FAILED)


if __name__ == "__main__":
    main()
