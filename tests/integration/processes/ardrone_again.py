"""An emulated AR.Drone 2 on given ports, until killed: ``python ardrone_again.py AT NAVDATA VIDEO CONTROL``."""

from __future__ import annotations

import signal
import sys

from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports

at, navdata, video, control = map(int, sys.argv[1:])
host = SimHost(SimOptions(rate_hz=125.0, cameras=()))
with ArdroneFirmware(host, ports=Ports(navdata=navdata, video=video, at=at, control=control)):
    print("ready", flush=True)
    signal.pause()
