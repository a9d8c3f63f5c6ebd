"""An ArduCopter or a PX4, emulated on the network over a simulated vehicle, for any program that speaks MAVLink.

On free ports of this machine, for a test::

    from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_multirotors(SimOptions(world="empty", seed=1)))
    with MavlinkFirmware(host, kind=Kind.PX4, ports=Ports.free(Kind.PX4)) as firmware:
        firmware.address  # mavlink://udpin:127.0.0.1:…, what to give to the driver

What the two do differently is what was observed on the real ones; ``docs/mavlink.md`` has it as a table.
"""

from skyloop.faults import Faults
from skyloop.vehicles.mavlink.emulator.emulator import MavlinkFirmware
from skyloop.vehicles.mavlink.emulator.links import Kind, Ports, with_multirotors

__all__ = ["Faults", "Kind", "MavlinkFirmware", "Ports", "with_multirotors"]
