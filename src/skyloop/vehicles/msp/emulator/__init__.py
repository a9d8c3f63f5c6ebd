"""A racing drone with Betaflight, emulated over a simulated vehicle, for any program that speaks MSP over TCP.

For a test::

    from skyloop.vehicles.msp.emulator import BetaflightFirmware, with_racers
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_racers(SimOptions(world="room", seed=1)))
    with BetaflightFirmware(host, port=0) as firmware:
        firmware.address  # for a driver: msp://tcp:127.0.0.1:…
        host.simulation.truth(0).position_m  # what the vehicle really does

Its barometer and GPS are those of the simulated vehicle. It answers what a driver needs, and is set up as
``docs/msp.md`` asks for.
"""

from skyloop.vehicles.msp.emulator.board import BoardSettings, with_racers
from skyloop.vehicles.msp.emulator.emulator import BetaflightFirmware

__all__ = ["BetaflightFirmware", "BoardSettings", "with_racers"]
