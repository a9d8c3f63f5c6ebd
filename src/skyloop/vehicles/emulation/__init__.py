"""Emulated firmware of real drones, flying a simulated vehicle and complete enough for third-party programs.

Each kind of vehicle has a package ``emulator`` with the firmware that can be switched on and off, its ports and
settings, and with modules for its telemetry (``telemetry``), its logic (``logic``, or ``autopilot`` if there are two of
a kind) and its flight (``flight``, ``manoeuvres``). This package holds what these emulators share: the thread, its
ports and the life cycle (``emulator``), the flying body (``flight``), and the encoding of camera images (``video``).
"""
