"""Firmware of real drones, emulated over a simulated vehicle well enough for other people's programs.

A folder for each kind of vehicle; beside them what they share: switching on and off (``firmware``, ``running``), the
thread and its ports (``loop``, ``datagrams``), what flies (``vehicle``), and the camera's pictures on their way out
(``video``, ``encoders``).
"""
