"""The values for pages, as pure functions."""

from __future__ import annotations

import json
import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as some

from skyloop.cockpit.api import parameter_values
from skyloop.cockpit.telemetry import (
    encode_json,
    feedback_values,
    flat_values,
    motion_values,
    number,
    set_point_values,
    target_values,
    truth_values,
)
from skyloop.messages import (
    Attitude,
    Feedback,
    FlightState,
    Hover,
    Parameter,
    ParameterType,
    Value,
    Velocity,
)


def flying(**values: Any) -> Feedback:
    known: dict[str, Any] = {"captured_ns": 1, "state": FlightState.FLYING, "battery": 0.8}
    return Feedback(**(known | values))


@given(some.floats())
def test_numbers_are_finite_and_short(value: float) -> None:
    told = number(value)
    if not math.isfinite(value):
        assert told is None
    else:
        assert told is not None
        assert math.isclose(told, value, rel_tol=1e-6)
        assert len(encode_json(told)) <= 25
    assert number(None) is None


def test_unknown_values_are_null_not_zero() -> None:
    values = feedback_values(flying(), 1_000_000_001)
    assert (values["roll"], values["velocity"], values["position"]) == (None, None, None)
    assert values["age_s"] == 1.0
    assert values["captured_ns"] == "1"
    motion = motion_values(flying())
    assert motion["attitude"] == {"roll": None, "pitch": None, "yaw": None}
    assert (motion["speed"], motion["altitude"]) == (None, None)
    assert motion_values(None)["flight"] == "unknown"
    assert set(motion_values(None)) == set(motion)


def test_every_number_has_a_unique_name() -> None:
    feedback = flying(
        yaw_rad=1.0,
        velocity_m_s=(3.0, 4.0, 0.0),
        angular_velocity_rad_s=(1.0, 2.0, 3.0),
        acceleration_m_s2=(0.0, 0.0, 9.81),
        position_m=(5.0, 6.0, 7.0),
        native={"rpm": 4, "armed": True, "mode": "x", "pwm": (1.0, 2.0), "bad": math.nan},
    )
    values = flat_values(feedback, {"error": 0.5}, Attitude(roll=0.1, climb=math.inf))
    assert values["velocity.left"] == 4.0
    assert values["angular_velocity.z"] == 3.0
    assert values["acceleration.z"] == 9.81
    assert values["position.x"] == 5.0
    assert (values["native.rpm"], values["native.armed"], values["native.pwm.1"]) == (4.0, 1.0, 2.0)
    assert values["native.bad"] is None
    assert values["log.error"] == 0.5
    assert (values["set_point.roll"], values["set_point.climb"]) == (0.1, None)
    assert "altitude" not in values
    assert "native.mode" not in values
    assert motion_values(feedback)["speed"] == 5.0
    assert flat_values(None, {}, None) == {}
    assert set_point_values(Velocity(up=1.0), 0.25)["values"] == {"forward": 0, "left": 0, "up": 1.0, "yaw_rate": 0}
    assert set_point_values(Hover(), 0.0) == {"action": "hover", "values": {}, "age_s": 0.0}


def test_the_truth_and_the_targets_of_a_simulation() -> None:
    native: dict[str, Value] = {"truth.x": 1.0, "truth.y": 2.0, "truth.z": 3.0, "truth.yaw": 0.5}
    assert truth_values(native) == {"position": [1.0, 2.0, 3.0], "yaw": 0.5}
    native |= {"truth.target.x": 4.0, "truth.target.y": 5.0, "truth.target.z": 6.0}
    native |= {"truth.target2.x": 7.0, "truth.target2.y": 8.0, "truth.target2.z": 9.0, "truth.target2.yaw": 1.0}
    assert target_values(native) == [
        {"name": "target", "position": [4.0, 5.0, 6.0], "yaw": None},
        {"name": "target2", "position": [7.0, 8.0, 9.0], "yaw": 1.0},
    ]
    nothing: list[dict[str, Value] | None] = [None, {}, {"truth.x": 1.0}, {"truth.x": "a", "truth.y": 1, "truth.z": 1}]
    for unknown in nothing:
        assert truth_values(unknown) is None
        assert target_values(unknown) == []


def test_parameters_are_plain() -> None:
    one = Parameter("a", ParameterType.VECTOR, (1.0, 2.0), "m", -math.inf, 4.0, (0.0, 0.0), ((1.0, 2.0), (3.0, 4.0)))
    told = json.loads(encode_json(parameter_values(one)))
    assert told["value"] == [1.0, 2.0]
    assert told["default"] == [0.0, 0.0]
    assert told["choices"] == [[1.0, 2.0], [3.0, 4.0]]
    assert (told["minimum"], told["maximum"]) == (None, 4.0)
    text = Parameter("b", ParameterType.TEXT, "x", read_only=True, description="A text")
    assert parameter_values(text)["default"] is None
    assert parameter_values(text)["read_only"] is True
