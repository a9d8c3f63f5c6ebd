"""Real Betaflight for a test: its program, and its ports, of which a computer has one set."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skyloop.errors import UsageError
from skyloop.vehicles.sim.firmware.betaflight import program_path


@contextmanager
def real_betaflight() -> Iterator[None]:
    """Keep the tests of other processes away from its ports meanwhile.

    Skips where it is not installed, or fails where somebody has promised that it is.
    """
    try:
        program_path()
    except UsageError as error:
        if os.environ.get("SKYLOOP_THIRD_PARTY") == "required":
            pytest.fail(str(error))
        pytest.skip(str(error))
    with (Path(tempfile.gettempdir()) / f"skyloop-betaflight-{os.getuid()}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
