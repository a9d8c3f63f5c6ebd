"""An AR.Drone 1 or 2, emulated on the network over a simulated vehicle, for any program that flies the real one.

On free ports of this machine, for a test::

    from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports, with_ardrones
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_ardrones(SimOptions(world="room", seed=1)))
    with ArdroneFirmware(host, version=2, ports=Ports.free()) as firmware:
        ports = firmware.ports  # .navdata and .at (UDP), .video (TCP; UDP of version 1), .control (TCP)
        host.simulation.truth(0).position_m  # what the vehicle really does

``firmware.stop()`` and ``firmware.start()`` restart it on the same ports. With
``faults=Faults(seed=1, drop=0.1)`` of :mod:`skyloop.faults` datagrams get lost both ways.
"""

from skyloop.faults import Faults
from skyloop.vehicles.ardrone.emulator.emulator import ArdroneFirmware, with_ardrones
from skyloop.vehicles.ardrone.wire.navdata import Ports

__all__ = ["ArdroneFirmware", "Faults", "Ports", "with_ardrones"]
