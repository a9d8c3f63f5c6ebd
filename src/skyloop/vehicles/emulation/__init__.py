"""Firmware of real drones, emulated over a simulated vehicle well enough for other people's programs.

A folder for each kind of vehicle, with ``emulator`` (what is switched on and off, with its thread and ports),
``settings``, ``telemetry``, its logic (``logic``, or ``autopilot`` where there are two of a kind), and how it flies
(``flight``, ``setpoints``, ``manoeuvres``). Beside them what they share: the thread and its ports (``loop``,
``datagrams``), what flies (``vehicle``), and the camera's pictures on their way out (``video``, ``encoders``).
"""
