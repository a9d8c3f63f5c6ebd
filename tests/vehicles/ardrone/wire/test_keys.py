"""The table of keys is consistent, and has the keys that drivers and emulated drones rely on."""

from __future__ import annotations

import pytest

from skyloop.vehicles.ardrone.wire.configuration import (
    KEYS,
    NAVDATA_OPTIONS_USUAL,
    Category,
    Key,
    VideoChannel,
    VideoCodec,
    format_value,
    keys_of,
    parse_value,
)
from skyloop.vehicles.ardrone.wire.navdata import LAYOUTS, Demo, VisionDetect


@pytest.mark.parametrize("key", KEYS.values(), ids=lambda key: key.name)
def test_a_key_is_consistent(key: Key) -> None:
    section, colon, name = key.name.partition(":")
    assert colon
    assert section.islower()
    assert name == name.lower().strip()
    assert set(key.versions) <= {1, 2}
    assert key.versions
    if isinstance(key.default, int | float) and not isinstance(key.default, bool):
        assert key.low is None or key.default >= key.low
        assert key.high is None or key.default <= key.high
    else:
        assert key.low is None
        assert key.high is None
    assert not key.choices or key.default in key.choices
    text = format_value(key.default)
    assert format_value(parse_value(text, key.default)) == text


def test_versions_differ() -> None:
    one, two = keys_of(1), keys_of(2)
    assert "network:navdata_port" in one.keys() - two.keys()
    assert {"video:codec_fps", "gps:latitude", "video:max_bitrate"} <= two.keys() - one.keys()
    assert {"control:euler_angle_max", "video:video_channel", "custom:session_id"} <= one.keys() & two.keys()


def test_categories() -> None:
    assert KEYS["control:altitude_max"].category is Category.COMMON
    assert KEYS["general:navdata_options"].category is Category.APPLICATION
    assert KEYS["control:euler_angle_max"].category is Category.USER
    assert KEYS["video:video_channel"].category is Category.SESSION


def test_values_of_codecs_and_channels() -> None:
    assert [VideoCodec.UVLC, VideoCodec.P264, VideoCodec.H264_360P, VideoCodec.H264_720P] == [0x20, 0x40, 0x81, 0x83]
    assert KEYS["video:video_codec"].default == VideoCodec.H264_360P
    assert set(KEYS["video:video_channel"].choices) == set(VideoChannel)


def test_the_usual_options() -> None:
    assert 1 << LAYOUTS[Demo].tag | 1 << LAYOUTS[VisionDetect].tag == NAVDATA_OPTIONS_USUAL
