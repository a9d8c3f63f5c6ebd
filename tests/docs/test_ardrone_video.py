"""``docs/ardrone.md`` describes the video as the code handles it."""

from __future__ import annotations

from dataclasses import fields

from skyloop.drivers.live_video import VideoCounters
from tests.support.pages import rows, section


def test_the_table_of_counters() -> None:
    table = rows(section("docs/ardrone.md", "## Video"))
    assert [row[0] for row in table] == [f"`video.{field.name}`" for field in fields(VideoCounters)]
