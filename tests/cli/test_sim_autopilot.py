"""``skyloop sim --autopilot``: errors about several ones, before any firmware starts."""

from __future__ import annotations

import pytest

from tests.support.commands import Run


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--autopilot px4 --autopilot ardupilot", "--autopilot given 2 times for --drones 1"),
        ("--drones 2 --autopilot px4 --autopilot betaflight", "choose one, such as --option vehicle=iris"),
        ("--drones 2 --speed 2 --autopilot px4 --autopilot betaflight", "speed must be 1, not 2"),
        ("--autopilot px4 --firmware px4", "give one of them"),
    ],
)
def test_autopilots_that_do_not_go_together_are_refused(words: str, said: str, run: Run) -> None:
    ended = run("sim", *words.split())
    assert ended.code == 2
    assert said in ended.err
