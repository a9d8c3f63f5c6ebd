"""A Ryze Tello, emulated on the network over a simulated vehicle, for any program that flies the real one.

At an address of this machine, for a test::

    from skyloop.vehicles.tello.emulator import TelloFirmware, with_tellos
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_tellos(SimOptions(world="room", seed=1)))
    with TelloFirmware(host, bind="127.0.0.1", port=0) as firmware:
        firmware.port  # UDP, where it takes commands
        host.simulation.truth(0).position_m  # what the vehicle really does

State and video go to ports 8890 and 11111 of the sender of ``command``, or to those set by ``port`` (SDK 3.0). With
``faults=Faults(seed=1, drop=0.1)`` of :mod:`skyloop.faults` datagrams get lost both ways.
"""

from skyloop.faults import Faults
from skyloop.vehicles.tello.emulator.emulator import TelloFirmware, with_tellos

__all__ = ["Faults", "TelloFirmware", "with_tellos"]
