"""Keys as parameters, and the commands that are parameters."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.drivers.recording_sink import mismatch
from skyloop.errors import DecodeError, ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.proxy.parameters import check
from skyloop.vehicles.ardrone.parameters import Commands, active_camera, entries_of, is_confirmed, prepare_write
from skyloop.vehicles.ardrone.setpoints import ArdroneSetpoints, Condition
from skyloop.vehicles.ardrone.wire.at import AtMessage
from skyloop.vehicles.ardrone.wire.configuration import FLIGHT_ANIMATIONS, LED_ANIMATIONS, format_value, keys_of
from skyloop.vehicles.ardrone.wire.navdata import ControlState, State

DRONES = {version: {name: format_value(key.default) for name, key in keys_of(version).items()} for version in (1, 2)}
GROUND = Condition(State(0), ControlState.LANDED)
AIR = Condition(State.FLYING, ControlState.HOVERING)


@pytest.mark.parametrize("version", [1, 2])
def test_every_parameter_fits_its_own_description(version: int) -> None:
    entries = entries_of(DRONES[version], version)
    assert len(entries) > len(DRONES[version])
    for name, entry in entries.items():
        parameter = entry.parameter
        assert parameter.name == name
        assert not mismatch(parameter, parameter.value), name
        assert parameter.default is None or not mismatch(parameter, parameter.default), name


@pytest.mark.parametrize("version", [1, 2])
def test_every_parameter_survives_a_round_trip(version: int) -> None:
    for name, entry in entries_of(DRONES[version], version).items():
        if not entry.parameter.read_only:
            same, text = prepare_write(entries_of(DRONES[version], version), name, entry.parameter.value)
            assert is_confirmed(same, text, DRONES[version][entry.key]), name


@pytest.mark.parametrize(
    ("name", "value", "key", "text"),
    [
        ("limits.tilt", 0.3, "control:euler_angle_max", "3.000000e-01"),
        ("limits.climb", 1.5, "control:control_vz_max", "1.500000e+03"),
        ("limits.yaw_rate", 2, "control:control_yaw", "2.000000e+00"),
        ("limits.altitude", 2.0, "control:altitude_max", "2000"),
        ("limits.outdoor.tilt", 0.3, "control:outdoor_euler_angle_max", "3.000000e-01"),
        ("limits.indoor.climb", 0.5, "control:indoor_control_vz_max", "5.000000e+02"),
        ("camera.fps", 20, "video:codec_fps", "20"),
        ("camera.active", "bottom", "video:video_channel", "1"),
        ("ardrone.control.altitude_max", 2000, "control:altitude_max", "2000"),
        ("ardrone.control.outdoor", True, "control:outdoor", "TRUE"),
        ("ardrone.general.ardrone_name", "Bee", "general:ardrone_name", "Bee"),
    ],
)
def test_names_and_units(name: str, value: Value, key: str, text: str) -> None:
    entry, said = prepare_write(entries_of(DRONES[2], 2), name, value)
    assert (entry.key, said) == (key, text)
    assert entry.from_text(text) == (pytest.approx(value) if isinstance(value, float) else value)
    assert not entry.parameter.read_only


@given(st.floats(0.2, 2.0))
def test_a_limit_in_si_counts_as_written(value: float) -> None:
    entry, text = prepare_write(entries_of(DRONES[2], 2), "limits.climb", value)
    told = entry.from_text(text)
    assert isinstance(told, float)
    assert math.isclose(told, value, rel_tol=1e-5)
    assert is_confirmed(entry, text, f"{value * 1000:.3f}")


@pytest.mark.parametrize(
    "name",
    [
        "ardrone.general.num_version_soft",
        "ardrone.general.navdata_demo",
        "ardrone.custom.session_id",
        "ardrone.control.flight_anim",
        "ardrone.leds.leds_anim",
    ],
)
def test_read_only_parameters(name: str) -> None:
    with pytest.raises(ParameterError, match="only be read") as caught:
        prepare_write(entries_of(DRONES[2], 2), name, "x")
    assert caught.value.code == Refusal.READ_ONLY


def test_an_unknown_name() -> None:
    with pytest.raises(UnknownNameError, match=r"limits\.tilt"):
        prepare_write(entries_of(DRONES[2], 2), "limits.tild", 0.1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("limits.tilt", "steep"),
        ("limits.tilt", True),
        ("limits.tilt", math.nan),
        ("camera.active", "left"),
        ("camera.active", 1),
        ("ardrone.control.outdoor", 1),
        ("ardrone.general.ardrone_name", 3),
    ],
)
def test_values_of_the_wrong_type(name: str, value: Value) -> None:
    with pytest.raises(ParameterError) as caught:
        prepare_write(entries_of(DRONES[2], 2), name, value)
    assert caught.value.code == Refusal.WRONG_TYPE


def test_cameras_of_both_versions() -> None:
    two = entries_of(DRONES[2], 2)["camera.active"].parameter
    one = entries_of(DRONES[1], 1)["camera.active"].parameter
    assert two.choices == ("front", "bottom")
    assert one.choices == ("front", "bottom", "front_with_bottom", "bottom_with_front")
    assert "camera.fps" not in entries_of(DRONES[1], 1)


@pytest.mark.parametrize(
    ("channel", "camera"), [("0", "front"), ("1", "bottom"), ("2", "front"), ("3", "bottom"), ("x", "front")]
)
def test_the_active_camera(channel: str, camera: str) -> None:
    assert active_camera({"video:video_channel": channel}) == camera
    assert active_camera({}) == "front"


def test_unknown_keys_and_unusual_values() -> None:
    strange = {
        **DRONES[2],
        "general:something_new": "42",
        "general:Bad Name": "1",
        "control:altitude_max": "high",
        "control:altitude_min": "10",
        "video:video_channel": "7",
        "detect:enemy_colors": "9",
    }
    entries = entries_of(strange, 2)
    unknown = entries["ardrone.general.something_new"].parameter
    assert (unknown.type, unknown.value, unknown.read_only) == (ParameterType.TEXT, "42", True)
    assert "ardrone.general.bad name" not in entries
    assert entries["ardrone.control.altitude_max"].parameter.type is ParameterType.TEXT
    assert "limits.altitude" not in entries
    assert "camera.active" not in entries
    assert entries["ardrone.control.altitude_min"].parameter.minimum == 10, "its own range is wider"
    assert 9 in entries["ardrone.detect.enemy_colors"].parameter.choices
    for entry in entries.values():
        assert not mismatch(entry.parameter, entry.parameter.value)


def test_texts_without_a_value() -> None:
    entry = entries_of(DRONES[2], 2)["camera.active"]
    with pytest.raises(DecodeError, match="not the index of one of"):
        entry.from_text("7")
    assert not is_confirmed(entry, "1", "bottom")


# Commands --------------------------------------------------------------------------------------------------------


class Bench:
    """Commands with a controller, and their messages."""

    def __init__(self, condition: Condition | None, version: int | None = 2) -> None:
        self.setpoints = ArdroneSetpoints()
        self.setpoints.condition = condition
        self.said: list[tuple[AtMessage, int]] = []
        self.commands = Commands(self.setpoints, lambda message, times: self.said.append((message, times)))
        self.version = version

    def parameter(self, name: str) -> Parameter:
        return next(p for p in self.commands.parameters(self.version) if p.name == name)

    def write(self, name: str, value: Value) -> Value:
        parameter = self.parameter(name)
        assert check(parameter, value) == value, "the proxy would not let it through"
        return self.commands.write(parameter, value)


@pytest.mark.parametrize("version", [None, 1, 2])
def test_commands_fit_their_own_description(version: int | None) -> None:
    for parameter in Bench(GROUND, version).commands.parameters(version):
        assert not mismatch(parameter, parameter.value)


def test_flat_trim_on_the_ground() -> None:
    bench = Bench(GROUND)
    assert bench.write("ardrone.flat_trim", True) is True
    assert bench.parameter("ardrone.flat_trim").value is True
    assert bench.write("ardrone.flat_trim", False) is False
    assert bench.said == [(("FTRIM", ()), 3)]


def test_calibration_in_the_air() -> None:
    bench = Bench(AIR)
    bench.write("ardrone.calibrate_magnetometer", True)
    assert bench.said == [(("CALIB", (0,)), 3)]


@pytest.mark.parametrize(
    ("name", "value", "condition", "says"),
    [
        ("ardrone.flat_trim", True, AIR, "land first"),
        ("ardrone.flat_trim", True, None, "no data from"),
        ("ardrone.calibrate_magnetometer", True, GROUND, "take off first"),
        ("ardrone.flight_animation", "wave", GROUND, "take off first"),
        ("ardrone.flight_animation", "wave", Condition(State.EMERGENCY), "take off first"),
        ("leds.animation", "fire", None, "no data from"),
    ],
)
def test_commands_forbidden_in_a_state(name: str, value: Value, condition: Condition | None, says: str) -> None:
    bench = Bench(condition)
    before = bench.parameter(name).value
    with pytest.raises(ParameterError, match=says) as caught:
        bench.write(name, value)
    assert caught.value.code == Refusal.WRONG_STATE
    assert bench.said == []
    assert bench.parameter(name).value == before


def test_lights() -> None:
    bench = Bench(GROUND)
    bench.write("leds.frequency", 4.0)
    bench.write("leds.duration", 5.0)
    assert bench.write("leds.animation", "snake_green_red") == "snake_green_red"
    assert bench.write("leds.animation", "none") == "none"
    assert bench.said == [(("LED", (4, 4.0, 5)), 3)]


def test_flight_animations_are_sent_once() -> None:
    bench = Bench(AIR)
    bench.write("ardrone.flight_animation", "flip_left")
    bench.write("ardrone.flight_animation", "yaw_shake")
    bench.write("ardrone.flight_animation", "none")
    assert bench.said == [(("ANIM", (18, 15)), 1), (("ANIM", (8, 2000)), 1)]


def test_numbers_of_animations() -> None:
    assert len(LED_ANIMATIONS) == 21
    assert LED_ANIMATIONS[20] == "blink_standard"
    assert len(FLIGHT_ANIMATIONS) == 20
    assert [duration for _, duration in FLIGHT_ANIMATIONS] == [1000] * 6 + [5000] * 2 + [2000] + [5000] * 7 + [15] * 4


def test_commands_missing_on_an_ardrone_1() -> None:
    names = {parameter.name for parameter in Bench(GROUND, 1).commands.parameters(1)}
    assert "ardrone.calibrate_magnetometer" not in names
    assert "ardrone.absolute_control" not in names
    assert "flip_left" not in Bench(GROUND, 1).parameter("ardrone.flight_animation").choices


def test_absolute_control() -> None:
    bench = Bench(AIR)
    assert bench.setpoints.reference_rad is None
    bench.write("ardrone.absolute_heading", math.pi)
    assert bench.setpoints.reference_rad is None
    bench.write("ardrone.absolute_control", True)
    assert bench.setpoints.reference_rad == math.pi
    bench.write("ardrone.absolute_control", False)
    assert bench.setpoints.reference_rad is None


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [
        ("leds.animation", "disco", Refusal.OUT_OF_RANGE),
        ("leds.animation", 3, Refusal.WRONG_TYPE),
        ("leds.frequency", 1000.0, Refusal.OUT_OF_RANGE),
        ("leds.frequency", math.nan, Refusal.OUT_OF_RANGE),
        ("leds.frequency", "fast", Refusal.WRONG_TYPE),
        ("ardrone.flat_trim", 1, Refusal.WRONG_TYPE),
    ],
)
def test_commands_check_their_own_values(name: str, value: Value, code: Refusal) -> None:
    bench = Bench(GROUND)
    with pytest.raises(ParameterError) as caught:
        bench.commands.write(bench.parameter(name), value)
    assert caught.value.code == code
