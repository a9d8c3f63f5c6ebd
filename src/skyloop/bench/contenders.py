"""The contenders that are measured in the same run, by one contract (:mod:`skyloop.bench.contract`)."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Contender:
    """Something that is measured: a module with its two ends, and the interpreter that it runs under."""

    name: str
    title: str
    module: str
    python: str = sys.executable
    version: str = ""


OURS: Final = Contender("skyloop", "Skyloop", "skyloop.bench.ours")
FLOOR: Final = Contender("floor", "bare hand-over", "skyloop.bench.floor")
NETWORK: Final = Contender("fabric", "Skyloop over the network", "skyloop.bench.over_loopback")
