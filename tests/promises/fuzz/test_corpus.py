"""Replays earlier findings and inputs that reach corner cases: nothing raises an unexpected error, or takes long."""

from __future__ import annotations

import time

import pytest

from tests.promises.fuzz.run import PACKAGES
from tests.promises.fuzz.targets import TARGETS, seeds

LONGEST_S = 5.0


def test_each_target_names_the_modules_it_uses() -> None:
    assert PACKAGES.keys() == TARGETS.keys()


@pytest.mark.parametrize("name", TARGETS)
def test_the_corpus_causes_no_finding(name: str) -> None:
    number = 0
    for seed in seeds(name):
        begin = time.process_time()
        TARGETS[name](seed)
        assert time.process_time() - begin < LONGEST_S, seed[:100]
        number += 1
    assert number, f"there is no corpus of {name}: make fuzz ARGS='--keep {name}'"
