"""Fuzzes one target with atheris: ``python -m tests.promises.fuzz.run TARGET FOLDER … [-OPTION=VALUE …]``."""

from __future__ import annotations

import importlib
import logging
import pkgutil
import sys

#: The modules that a target uses, instrumented before they are imported.
PACKAGES = {
    "samples": ["skyloop.messages"],
    "packets": ["skyloop.messages", "skyloop.transport.local.packets", "skyloop.network.packets"],
    "proxy": ["skyloop.messages", "skyloop.proxy"],
    "ardrone": ["skyloop.vehicles.ardrone.wire"],
    "tello": ["skyloop.vehicles.tello.wire"],
    "mavlink": ["skyloop.vehicles.mavlink.wire"],
    "msp": ["skyloop.vehicles.msp.wire"],
    "cpx": ["skyloop.vehicles.crazyflie.wire"],
    "vrpn": ["skyloop.motion_capture.vrpn", "skyloop.motion_capture.vrpn"],
    "recording": ["skyloop.recording", "mcap"],
    "files": ["skyloop.sim", "skyloop.calibration", "skyloop.zones", "skyloop.drivers.uri", "tomllib"],
    "page": ["skyloop.cockpit.commands"],
}


def main() -> None:
    """Run until libFuzzer's options end it."""
    import atheris

    name = sys.argv.pop(1)
    logging.disable()
    with atheris.instrument_imports(include=PACKAGES[name]):
        for package in PACKAGES[name]:
            module = importlib.import_module(package)
            for info in pkgutil.iter_modules(getattr(module, "__path__", ())):
                try:
                    importlib.import_module(f"{package}.{info.name}")
                except ImportError:
                    continue  # it belongs to an extra that is not installed
    from tests.promises.fuzz.targets import TARGETS

    atheris.Setup(sys.argv, TARGETS[name])
    atheris.Fuzz()


if __name__ == "__main__":
    main()
