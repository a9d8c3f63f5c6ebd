"""Whether the computer has a processor to spare: noticed soon, without flapping, and found again."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.warmth import (
    AGAIN_CORES,
    FIRST_WAIT_S,
    LEAST_CORES,
    LONGEST_WAIT_S,
    LOOK_S,
    Idleness,
    Spare,
    parse_idleness,
    read_idleness,
)

STAT = b"""cpu  804252 304888 174208 2147664 6472 0 5193 1335 0 0
cpu0 360514 142408 83362 1130500 1300 0 2322 667 0 0
cpu2 443738 162480 90845 1017000 5100 0 2871 668 0 0
intr 1 2 3
cpu3 1 2 3 4 5
"""


class Computer:
    """A computer that is as busy as a test says, looked at twice a second."""

    def __init__(self, cores: int = 2) -> None:
        self.cores = cores
        self.now_s = 100.0
        self._idle_s = 5000.0
        self.spare = Spare(lambda: Idleness(self.cores, self._idle_s))
        self.spare(self.now_s)

    def run(self, idle_cores: float, seconds: float) -> list[bool]:
        """What was judged meanwhile."""
        found = []
        for _ in range(round(seconds / LOOK_S)):
            self.now_s += LOOK_S
            self._idle_s += idle_cores * LOOK_S
            found.append(self.spare(self.now_s))
        return found

    def pause(self, seconds: float, idle_cores: float) -> None:
        """Nobody looks."""
        self.now_s += seconds
        self._idle_s += idle_cores * seconds


def test_an_idle_computer_has_one_as_soon_as_that_is_seen() -> None:
    assert Spare(lambda: Idleness(2, 5000.0))(100.0) is False
    assert Computer().run(1.9, 2.0) == [True] * 4
    assert Computer(1).run(0.9, 1.0) == [True] * 2
    assert not any(Computer().run(AGAIN_CORES - 0.1, 60.0))


def test_a_busy_one_is_noticed_within_a_second_and_a_short_burst_is_not() -> None:
    computer = Computer()
    computer.run(1.9, 1.0)
    assert computer.run(0.0, LOOK_S) == [True]
    assert computer.run(1.0, 60.0)[-1] is True
    assert computer.run(LEAST_CORES - 0.1, 1.0) == [True, False]


def test_it_is_found_again_by_itself_a_little_later() -> None:
    computer = Computer()
    computer.run(1.9, 60.0)
    assert computer.run(0.1, 10.0)[-1] is False
    assert not any(computer.run(1.0, 30.0))  # less than what is needed to begin again
    again = computer.run(1.9, 10.0)
    assert again.index(True) == pytest.approx(FIRST_WAIT_S / LOOK_S - 1)


def test_where_many_who_find_one_take_it_away_it_is_tried_ever_more_rarely() -> None:
    computer, enough, begun = Computer(), False, []
    for look in range(round(600.0 / LOOK_S)):
        before = enough
        (enough,) = computer.run(0.0 if enough else 1.9, LOOK_S)
        if enough and not before:
            begun.append(look * LOOK_S)
    pauses_s = [later - before for before, later in itertools.pairwise(begun)]
    assert pauses_s == sorted(pauses_s)
    assert pauses_s[0] < 5.0
    assert pauses_s[-1] == pytest.approx(LONGEST_WAIT_S, abs=2.0)
    assert len(begun) < 15
    computer.run(1.9, 200.0)  # it lasts again
    computer.run(0.0, 2.0)
    assert any(computer.run(1.9, 3.0))


def test_a_time_in_which_nobody_looked_says_nothing_of_now() -> None:
    computer = Computer()
    computer.run(1.9, 1.0)
    computer.pause(600.0, 0.0)
    assert computer.run(1.9, 2.0) == [True] * 4


def test_processors_that_come_and_go_are_not_taken_for_work() -> None:
    computer = Computer(4)
    computer.run(3.9, 1.0)
    computer.cores = 2
    assert computer.run(0.0, LOOK_S) == [True]
    assert computer.run(1.9, 60.0)[-1] is True


@given(st.lists(st.floats(0.0, 2.0), min_size=1, max_size=200), st.booleans())
def test_whatever_happens_it_settles(shares: list[float], busy: bool) -> None:
    computer = Computer()
    found = [judged for share in shares for judged in computer.run(share, LOOK_S)]
    changes = sum(before != after for before, after in itertools.pairwise(found))
    assert changes <= 2 + 2 * len(found) * LOOK_S / (FIRST_WAIT_S + 1.5)  # never faster than that
    end = computer.run(0.0 if busy else 2.0, LONGEST_WAIT_S + 2.0)
    assert end[-1] is not busy
    assert len(set(end[-10:])) == 1


def test_where_it_cannot_be_read_there_is_always_one() -> None:
    judge = Spare(lambda: None)
    assert [judge(now_s) for now_s in (0.0, 0.5, 1.0)] == [True] * 3


def test_only_processors_that_may_be_used_count() -> None:
    both = parse_idleness(STAT, {0, 2})
    one = parse_idleness(STAT, {2, 3})  # what follows other lines is none
    assert both is not None
    assert one is not None
    assert (both.cores, one.cores) == (2, 1)
    assert both.idle_s / one.idle_s == pytest.approx((1130500 + 1300 + 1017000 + 5100) / (1017000 + 5100))
    assert parse_idleness(STAT, {7}) is None
    assert parse_idleness(b"nothing of the sort", {0}) is None
    assert parse_idleness(b"", {0}) is None


@pytest.mark.skipif(sys.platform != "linux" or not Path("/proc/stat").exists(), reason="needs /proc/stat")
def test_this_computer_is_read() -> None:
    found = read_idleness()
    assert found is not None
    assert found.cores >= 1
    assert found.idle_s > 0.0


def test_a_computer_that_does_not_say_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> object:
        raise PermissionError("not for you")

    monkeypatch.setattr(Path, "open", refused)
    assert read_idleness() is None
