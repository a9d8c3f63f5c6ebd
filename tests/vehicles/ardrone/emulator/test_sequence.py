"""Which AT commands count as new."""

from __future__ import annotations

import pytest

from skyloop.clock import ManualClock
from skyloop.vehicles.ardrone.emulator.logic import CommandSequence


@pytest.mark.parametrize(
    ("numbers", "taken"),
    [
        ((1, 2, 3), (True, True, True)),
        ((0, 1, 2), (False, True, True)),  # as sent by node-ar-drone
        ((5, 4, 5, 6), (True, False, False, True)),
        ((7, 8, 1, 2, 8), (True, True, True, True, True)),  # 1 restarts
        ((1, 1), (True, True)),
        ((-3, -2), (False, False)),
        ((4_294_967_295, 3), (True, False)),
    ],
)
def test_numbers_without_a_pause(numbers: tuple[int, ...], taken: tuple[bool, ...]) -> None:
    sequence = CommandSequence()
    assert tuple(sequence.takes(number, 0) for number in numbers) == taken


def test_two_seconds_of_silence_make_old_numbers_new() -> None:
    sequence, clock = CommandSequence(), ManualClock()
    assert sequence.takes(100, clock())
    assert not sequence.takes(50, clock.advance(2.0))
    assert sequence.takes(50, clock.advance(0.001))
    assert not sequence.takes(50, clock())


def test_ignored_commands_do_not_end_the_silence() -> None:
    sequence, clock = CommandSequence(), ManualClock()
    sequence.takes(100, clock())
    for number in range(10, 30):
        assert not sequence.takes(number, clock.advance(0.1))
    assert sequence.takes(31, clock.advance(0.1))
