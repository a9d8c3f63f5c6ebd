"""An ArduCopter or a PX4, emulated on the network over a simulated vehicle, for any program that speaks MAVLink.

On free ports of this machine, for a test::

    from skyloop.emulators.mavlink import Kind, MavlinkFirmware, Ports, with_multirotors
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_multirotors(SimOptions(world="empty", seed=1)))
    with MavlinkFirmware(host, kind=Kind.PX4, ports=Ports.free(Kind.PX4)) as firmware:
        firmware.address  # mavlink://udpin:127.0.0.1:…, what to give to the driver

What the two do differently is what was observed on the real ones; ``docs/mavlink.md`` has it as a table.
"""

from skyloop.emulators.mavlink.emulator import MavlinkFirmware
from skyloop.emulators.mavlink.settings import Kind, Ports, with_multirotors
from skyloop.faults import Faults

__all__ = ["Faults", "Kind", "MavlinkFirmware", "Ports", "with_multirotors"]
