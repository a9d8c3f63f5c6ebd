"""MAVLink as a driver and an emulated autopilot both need it: frames, modes, axes, parameters' values, texts.

The messages themselves are pymavlink's; :mod:`skyloop.vehicles.mavlink.wire.codec` imports it, and nothing else does.
"""
