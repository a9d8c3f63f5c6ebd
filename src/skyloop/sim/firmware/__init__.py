"""Firmware of real drones, emulated over a simulated vehicle well enough for other people's programs."""
