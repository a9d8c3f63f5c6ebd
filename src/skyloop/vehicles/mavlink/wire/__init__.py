"""MAVLink code shared by the driver and the emulated autopilot: frames, modes, axes, parameter values and texts.

Messages are pymavlink's, which only :mod:`skyloop.vehicles.mavlink.wire.codec` imports.
"""
