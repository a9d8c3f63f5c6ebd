"""A sample with as many values as a real vehicle's, for what measures the code or keeps it warm."""

from __future__ import annotations

from skyloop.messages import Feedback, FlightState


def typical_feedback(captured_ns: int, state: FlightState = FlightState.FLYING) -> Feedback:
    """Return feedback of a vehicle that flies somewhere.

    Args:
        captured_ns: When it was captured [ns].
        state: Its flight state.
    """
    return Feedback(
        captured_ns=captured_ns,
        state=state,
        battery=0.8,
        battery_v=11.4,
        roll_rad=0.01,
        pitch_rad=-0.02,
        yaw_rad=0.5,
        altitude_m=1.2,
        velocity_m_s=(0.1, 0.0, 0.0),
        angular_velocity_rad_s=(0.0, 0.01, 0.0),
        acceleration_m_s2=(0.0, 0.1, 9.8),
        position_m=(0.5, 0.25, 1.2),
    )
