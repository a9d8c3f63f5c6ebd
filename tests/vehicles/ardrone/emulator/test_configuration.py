"""The emulated drone's configuration."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.vehicles.ardrone.emulator.configuration import MOST_CUSTOM, Configuration, Ids
from skyloop.vehicles.ardrone.wire.configuration import END_OF_DUMP, KEYS, Value, VideoCodec, keys_of, parse_dump

MINE: Ids = ("0a0b0c0d", "11111111", "22222222")


def in_session(version: int = 2) -> Configuration:
    """Return a configuration in use by a program with its own ids."""
    made = Configuration(version)
    for key, one_id in zip(("session", "profile", "application"), MINE, strict=True):
        assert made.write(f"custom:{key}_id", one_id, MINE)
    return made


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("general:navdata_demo", "TRUE", True),
        ("GENERAL:Navdata_Demo ", " true", True),
        ("general:ardrone_name", "Käthe", "Käthe"),
        ("control:altitude_max", "2500", 2500),
        ("control:altitude_max", "2500.7", 2500),
        ("control:altitude_max", "1", 500),  # clamped to the range
        ("control:euler_angle_max", "0.25", 0.25),
        ("control:euler_angle_max", "9", 0.52),
        ("video:video_codec", "131", VideoCodec.H264_720P),
        ("video:video_channel", "4", 1),  # the next one
    ],
)
def test_a_key_is_written(key: str, text: str, value: Value) -> None:
    configuration = Configuration(2)
    assert configuration.write(key, text)
    assert configuration[key.strip().lower()] == value


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("general:no_such_key", "1"),
        ("general:num_version_soft", "9.9.9"),  # read-only
        ("control:altitude_max", "high"),
        ("control:altitude_max", "nan"),
        ("control:euler_angle_max", "inf"),
        ("control:flying_mode", "17"),
        ("general:navdata_demo", "perhaps"),
        ("video:video_codec", "32"),  # of an AR.Drone 1
        ("video:video_codec", "0"),
        ("video:video_channel", "2"),  # of an AR.Drone 1
        ("custom:session_id", "too long for an id"),
        ("network:at_port", "5556"),  # of an AR.Drone 1
    ],
)
def test_nonsense_is_ignored(key: str, text: str) -> None:
    configuration = Configuration(2)
    before = configuration.dump()
    assert not configuration.write(key, text)
    assert configuration.dump() == before


@given(st.sampled_from(sorted(KEYS)) | st.text(), st.text() | st.integers().map(str), st.sampled_from([1, 2]))
def test_a_configuration_can_be_sent_after_any_text(key: str, text: str, version: int) -> None:
    configuration = Configuration(version)
    configuration.write(key, text)
    assert parse_dump(configuration.dump()).keys() == keys_of(version).keys()


def test_the_channels_of_an_ar_drone_1_wrap_around() -> None:
    configuration = Configuration(1)
    seen = []
    for _ in range(5):
        configuration.write("video:video_channel", "4")
        seen.append(configuration["video:video_channel"])
    assert seen == [1, 2, 3, 0, 1]


def test_outdoor_flight_has_other_limits() -> None:
    configuration = Configuration(2)
    configuration.write("control:outdoor_control_vz_max", "1500")
    configuration.write("control:euler_angle_max", "0.1")
    assert configuration["control:indoor_euler_angle_max"] == 0.1
    configuration.write("control:outdoor", "TRUE")
    assert configuration["control:control_vz_max"] == 1500
    assert configuration["control:euler_angle_max"] == configuration["control:outdoor_euler_angle_max"] != 0.1
    configuration.write("control:outdoor_euler_angle_max", "0.4")
    assert configuration["control:euler_angle_max"] == 0.4
    configuration.write("control:outdoor", "FALSE")
    assert configuration["control:euler_angle_max"] == 0.1


def test_a_new_session_begins_with_factory_values() -> None:
    configuration = Configuration(2)
    configuration.write("video:codec_fps", "20")  # of the session
    configuration.write("control:altitude_max", "1500")  # shared
    configuration.write("custom:session_id", MINE[0])
    assert configuration["video:codec_fps"] == 30
    assert configuration["control:altitude_max"] == 1500
    configuration.write("custom:session_id", "00000000")
    assert configuration["video:codec_fps"] == 20


def test_values_belong_to_their_session_user_and_application() -> None:
    configuration = in_session()
    assert configuration.write("video:codec_fps", "25", MINE)
    assert configuration.write("control:euler_angle_max", "0.3", MINE)
    assert configuration.write("general:navdata_options", "7", MINE)
    configuration.forget_client()
    defaults = Configuration(2)
    for key in ("video:codec_fps", "control:euler_angle_max", "general:navdata_options", "custom:session_id"):
        assert configuration[key] == defaults[key]
    configuration.write("custom:profile_id", MINE[1])
    assert configuration["control:euler_angle_max"] == 0.3


@pytest.mark.parametrize("ids", [None, (MINE[0], MINE[1], "33333333"), ("00000000",) * 3])
def test_commands_with_other_ids_are_ignored(ids: Ids | None) -> None:
    configuration = in_session()
    assert not configuration.write("control:altitude_max", "1500", ids)
    assert configuration["control:altitude_max"] == 3000


def test_the_ids_in_force_can_be_read_and_are_listed() -> None:
    configuration = in_session()
    configuration.write("custom:session_desc", "an evening's flight", MINE)
    dump = parse_dump(configuration.dump())
    assert (dump["custom:session_id"], dump["custom:profile_id"], dump["custom:application_id"]) == MINE
    assert configuration.custom_ids() == (
        b"[applis]\r22222222,Default application configuration\r"
        b"[profiles]\r11111111,Default profile configuration\r"
        b"[sessions]\r0a0b0c0d,an evening's flight\r" + END_OF_DUMP
    )


@pytest.mark.parametrize("text", ["-0a0b0c0d", "-all"])
def test_a_deleted_session_leaves_the_default_one(text: str) -> None:
    configuration = in_session()
    configuration.write("video:codec_fps", "25", MINE)
    assert configuration.write("custom:session_id", text, MINE)
    assert configuration.ids == ("00000000", *MINE[1:])
    assert configuration["video:codec_fps"] == 30


def test_the_default_session_cannot_be_deleted() -> None:
    configuration = Configuration(2)
    assert not configuration.write("custom:session_id", "-00000000")
    assert configuration.ids == ("00000000",) * 3


def test_the_number_of_sessions_is_limited() -> None:
    configuration = Configuration(2)
    made = [configuration.write("custom:session_id", f"{n:08x}") for n in range(1, MOST_CUSTOM + 2)]
    assert made == [True] * MOST_CUSTOM + [False]
    assert configuration.write("custom:session_id", f"{1:08x}"), "an existing one can still be chosen"
