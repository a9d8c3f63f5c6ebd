"""Firmware of real drones, emulated over a simulated vehicle well enough for third-party programs.

Each kind of vehicle has a package ``emulator`` with the firmware that is switched on and off, its thread, ports and
settings. Beside it are ``telemetry``, the logic (``logic``, ``board``, or ``autopilot`` if there are two of a kind),
and its flight (``flight``, ``manoeuvres``). This package holds the shared parts: the thread and its ports
(``datagrams``), the flying body (``flight``), and the encoding of camera pictures (``video``).
"""
