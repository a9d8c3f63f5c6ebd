"""What fuzzing has found, and what leads into corners, again: nothing raises what it should not, or takes long."""

from __future__ import annotations

import time

import pytest

from tests.promises.fuzz.run import PACKAGES
from tests.promises.fuzz.targets import TARGETS, seeds

LONGEST_S = 5.0


def test_each_target_says_what_it_runs_through() -> None:
    assert PACKAGES.keys() == TARGETS.keys()


@pytest.mark.parametrize("name", TARGETS)
def test_the_kept_corpus_is_survived(name: str) -> None:
    number = 0
    for seed in seeds(name):
        begin = time.process_time()
        TARGETS[name](seed)
        assert time.process_time() - begin < LONGEST_S, seed[:100]
        number += 1
    assert number, f"there is no corpus of {name}: make fuzz ARGS='--keep {name}'"
