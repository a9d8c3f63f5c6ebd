"""The contenders measured in the same run, by one contract (:mod:`benchmarks.measuring.contract`)."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Contender:
    """A contender: a module with its two ends, and the interpreter that runs it."""

    name: str
    title: str
    module: str
    python: str = sys.executable
    version: str = ""


OURS: Final = Contender("skyloop", "Skyloop", "benchmarks.measuring.ours")
FLOOR: Final = Contender("floor", "bare hand-over", "benchmarks.measuring.floor")
NETWORK: Final = Contender("fabric", "Skyloop over the network", "benchmarks.measuring.over_loopback")
PORTABLE: Final = Contender("portable", "Skyloop, portable transport", "benchmarks.measuring.over_portable")
