"""Real Betaflight for a test: its program and its ports, which exist only once per computer."""

from __future__ import annotations

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
    """Reserve its ports against tests in other processes.

    Skips if Betaflight is not installed, or fails if the environment promises that it is.
    """
    try:
        program_path()
    except UsageError as error:
        if os.environ.get("SKYLOOP_THIRD_PARTY") == "required":
            pytest.fail(str(error))
        pytest.skip(str(error))
    import fcntl

    with (Path(tempfile.gettempdir()) / f"skyloop-betaflight-{os.getuid()}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
