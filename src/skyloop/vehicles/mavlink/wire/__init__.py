"""MAVLink parts shared by the driver and the emulated autopilot: frames, modes, axes, parameter values, texts.

Messages come from pymavlink, which only :mod:`skyloop.vehicles.mavlink.wire.codec` imports.
"""
