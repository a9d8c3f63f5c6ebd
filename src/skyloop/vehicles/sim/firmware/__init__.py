"""Real flight firmware in the simulated world: ArduCopter, PX4 and Betaflight as processes that fly simulated drones.

Each is a :class:`~skyloop.sim.instruments.Firmware`. Their programs are not part of Skyloop; ``docs/autopilots.md``
says where they come from.
"""
