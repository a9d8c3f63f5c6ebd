"""MAVLink as a driver and an emulated autopilot both need it: frames, modes, axes, parameters' values, texts.

The messages themselves are pymavlink's; :mod:`skyloop.wire.mavlink.codec` imports it, and nothing else does.
"""
