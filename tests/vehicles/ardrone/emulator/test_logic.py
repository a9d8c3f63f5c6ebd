"""The emulated drone's main board: the link, the acknowledgement, the state bits."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import FlightState
from skyloop.vehicles.ardrone.emulator.logic import VideoSettings
from skyloop.vehicles.ardrone.wire.at import to_bits
from skyloop.vehicles.ardrone.wire.configuration import VideoChannel, VideoCodec, parse_dump
from skyloop.vehicles.ardrone.wire.navdata import State
from tests.vehicles.ardrone.emulator.rig import Bench

ALIVE = 0x0F800090  # of a healthy drone: altitude control, camera ready, its threads


def test_the_initial_state_is_that_of_a_real_drone() -> None:
    bench = Bench()
    bench.wait(10.0)
    assert bench.state == ALIVE | State.BOOTSTRAP | State.COMMUNICATION_WATCHDOG


def test_the_state_of_a_drone_in_flight() -> None:
    bench = Bench()
    bench.configure("general:navdata_demo", "TRUE")
    bench.say("CTRL", 5, 0)
    bench.say("COMWDG")
    assert bench.state == ALIVE | State.DEMO
    bench.say("REF", 512)
    assert bench.state == ALIVE | State.DEMO | State.FLYING | State.VISION | State.START_BUTTON
    assert bench.logic.state(video=True) & State.VIDEO


# Acknowledgement -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clear", [0, 5])
def test_the_acknowledgement_of_a_config_stays_until_cleared(clear: int) -> None:
    bench = Bench()
    assert not bench.state & State.COMMAND_ACK
    bench.configure("general:navdata_demo", "FALSE")
    assert bench.state & State.COMMAND_ACK
    assert not bench.state & State.BOOTSTRAP
    bench.say("CTRL", clear, 0)
    assert not bench.state & State.COMMAND_ACK


@pytest.mark.parametrize(
    ("key", "text"), [("general:no_such", "1"), ("leds:leds_anim", "red"), ("general:vbat_min", "x")]
)
def test_ignored_configs_are_also_acknowledged(key: str, text: str) -> None:
    bench = Bench()
    bench.configure(key, text)
    assert bench.state & State.COMMAND_ACK


@pytest.mark.parametrize("mode", [4, 6])
def test_the_control_port_sends_the_requested_dump(mode: int) -> None:
    bench = Bench()
    bench.say("CTRL", mode, 0)
    (text,) = bench.texts
    assert text.endswith(b"\0")
    assert bench.state & State.COMMAND_ACK
    if mode == 4:
        assert parse_dump(text)["general:num_version_soft"] == "2.4.8"


def test_ids_count_for_the_next_command_only() -> None:
    bench = Bench()
    ids = ("0000000a", "0000000b", "0000000c")
    for key, one_id in zip(("session", "profile", "application"), ids, strict=True):
        bench.say("CONFIG_IDS", *ids)
        bench.configure(f"custom:{key}_id", one_id)
    bench.say("CONFIG_IDS", *ids)
    bench.configure("video:codec_fps", "20")
    bench.configure("video:codec_fps", "25")
    assert bench.logic.video.fps == 20
    bench.say("CONFIG_IDS", *ids)
    bench.say("COMWDG")
    bench.configure("video:codec_fps", "25")
    assert bench.logic.video.fps == 20


# Watchdogs -----------------------------------------------------------------------------------------------------


def test_the_watchdog_bit_is_set_by_silence_and_cleared_on_demand() -> None:
    bench = Bench()
    bench.say("COMWDG")
    assert not bench.state & State.COMMUNICATION_WATCHDOG
    bench.wait(0.05)
    assert not bench.state & State.COMMUNICATION_WATCHDOG
    bench.wait(0.001)
    assert bench.state & State.COMMUNICATION_WATCHDOG
    bench.say("REF", 0)
    assert bench.state & State.COMMUNICATION_WATCHDOG
    bench.say("COMWDG")
    assert not bench.state & State.COMMUNICATION_WATCHDOG


def test_a_lost_link_restarts_with_the_bootstrap() -> None:
    bench = Bench()
    bench.configure("general:navdata_demo", "TRUE")
    bench.configure("custom:session_id", "0000000a")
    bench.wait(2.0)
    assert not bench.state & (State.COMMUNICATION_LOST | State.BOOTSTRAP)
    bench.wait(0.01)
    assert bench.state & (State.COMMUNICATION_LOST | State.BOOTSTRAP) == State.COMMUNICATION_LOST | State.BOOTSTRAP
    assert bench.logic.configuration.ids == ("00000000",) * 3
    bench.say("REF", 0)
    assert bench.state & (State.COMMUNICATION_LOST | State.BOOTSTRAP) == State.BOOTSTRAP
    bench.configure("general:navdata_demo", "TRUE")
    assert not bench.state & State.BOOTSTRAP


def test_a_drone_without_any_client_reports_no_lost_link() -> None:
    bench = Bench()
    bench.wait(60.0)
    assert not bench.state & State.COMMUNICATION_LOST


# Commands ------------------------------------------------------------------------------------------------------


def test_lights_are_recorded() -> None:
    bench = Bench()
    bench.say("LED", 3, 2.5, 4)
    assert bench.logic.leds == (3, 2.5, 4)
    bench.configure("leds:leds_anim", f"1,{to_bits(0.5)},6")
    assert bench.logic.leds == (1, 0.5, 6)


def test_the_configuration_selects_the_video() -> None:
    bench = Bench()
    for key, text in (
        ("video_channel", "1"),
        ("video_codec", "131"),
        ("codec_fps", "20"),
        ("bitrate", "3000"),
        ("max_bitrate", "2000"),
    ):
        bench.configure(f"video:{key}", text)
    assert bench.logic.video == VideoSettings(VideoChannel.BOTTOM, VideoCodec.H264_720P, 20.0, 2000)
    assert Bench(version=1).logic.video == VideoSettings(VideoChannel.FRONT, VideoCodec.UVLC, 15.0, 1000)


def test_the_old_commands_for_camera_and_detection() -> None:
    bench = Bench()
    bench.say("ZAP", 1)
    bench.say("CAD", 2, 1)
    assert bench.logic.video.channel is VideoChannel.BOTTOM
    assert bench.logic.configuration["detect:detect_type"] == 2
    assert bench.state & State.VISION


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("PMODE", (2,)),
        ("MISC", (2, 20, 2000, 3000)),
        ("GAIN", (1,)),
        ("VICON", tuple(range(11))),
        ("CTRL", (1, 0)),
        ("FTRIM", (1,)),
        ("COMWDG", (0,)),
    ],
)
def test_commands_of_real_programs_are_accepted(name: str, arguments: tuple[int, ...]) -> None:
    bench = Bench()
    bench.say(name, *arguments)
    assert bench.logic.malformed == 0
    assert bench.vehicle.told == []


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("REF", ()),
        ("REF", ("take off",)),
        ("PCMD", (1, 0, 0, 0)),
        ("PCMD", (1, "a", "b", "c", "d")),
        ("PCMD_MAG", (1, 0, 0, 0, 0)),
        ("CONFIG", ("general:navdata_demo",)),
        ("CONFIG_IDS", ("one",)),
        ("ANIM", ("x", "y")),
        ("LED", (1,)),
        ("WARP", (9,)),
    ],
)
def test_wrong_arguments_are_counted_and_ignored(name: str, arguments: tuple[int | str, ...]) -> None:
    bench = Bench(state=FlightState.HOVERING)
    bench.say(name, *arguments)
    assert bench.logic.malformed == 1
    assert bench.vehicle.told == []


def test_several_commands_in_a_datagram_with_any_line_ends() -> None:
    bench = Bench()
    bench.logic.receive(b'AT*CTRL=0,5,0\rAT*COMWDG=1\nAT*CONFIG=2,"general:navdata_demo","TRUE"\r\nAT*REF=3,512\r\0')
    assert bench.logic.stale == 1
    assert bench.logic.malformed == 0
    assert bench.state & (State.DEMO | State.FLYING) == State.DEMO | State.FLYING


NAMES = st.sampled_from(
    ["REF", "PCMD", "PCMD_MAG", "FTRIM", "CALIB", "CONFIG", "CONFIG_IDS", "COMWDG", "CTRL", "LED", "ANIM", "ZAP", "CAD"]
)
ARGUMENTS = st.lists(st.integers(-(10**10), 10**10).map(str) | st.text("abc:_,-019 ").map(lambda text: f'"{text}"'))


@given(st.binary(max_size=300))
def test_any_datagram_is_survived(datagram: bytes) -> None:
    bench = Bench()
    bench.logic.receive(datagram)
    bench.wait(0.01)


@given(st.lists(st.tuples(NAMES, ARGUMENTS), max_size=12), st.sampled_from(list(FlightState)), st.sampled_from([1, 2]))
def test_any_commands_are_survived(commands: list[tuple[str, list[str]]], state: FlightState, version: int) -> None:
    bench = Bench(version, state)
    for number, (name, arguments) in enumerate(commands, 1):
        bench.logic.receive(f"AT*{','.join([f'{name}={number}', *arguments])}\r".encode())
        bench.wait(0.03)
    assert 0 <= bench.state < 1 << 32
    assert bench.logic.video.fps >= 15
