"""``msp://tcp:HOST:PORT`` and ``msp:///dev/ttyACM0``: Betaflight and INAV, by the MultiWii serial protocol."""
