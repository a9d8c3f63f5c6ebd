"""Firmware of real drones, emulated over a simulated vehicle well enough for other people's programs.

A package ``emulator`` for each kind of vehicle has what is switched on and off, with its thread, ports and settings;
beside it ``telemetry``, the logic (``logic``, ``board``, or ``autopilot`` where there are two of a kind), and how it
flies (``flight``, ``manoeuvres``). Here is what they share: the thread and its ports (``datagrams``), what flies
(``flight``), and the camera's pictures on their way out (``video``).
"""
