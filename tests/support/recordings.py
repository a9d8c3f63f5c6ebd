"""What others recorded from real vehicles. It is not part of the project: tests find it beside the checkout, in
``../shared/fixtures``, or where the variable ``SKYLOOP_FIXTURES`` points, and are skipped without it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import pytest

FIXTURES: Final = Path(os.environ.get("SKYLOOP_FIXTURES") or Path(__file__).parents[3] / "shared" / "fixtures")
WHY: Final = f"needs data recorded from real vehicles, and {FIXTURES} is not there: set SKYLOOP_FIXTURES to its folder"
#: Marks a test that needs recorded data which its module reads when it is imported.
needs_recordings: Final = pytest.mark.skipif(not FIXTURES.is_dir(), reason=WHY)


def recorded(name: str) -> Path:
    """A recorded file or folder. In a test or fixture: skips it where that is not there."""
    path = FIXTURES / name
    if not path.exists():
        pytest.skip(WHY if not FIXTURES.is_dir() else f"{path} is not there")
    return path


def content(name: str) -> bytes:
    """What is in a recorded file, for use at import; empty where it is not there, see :data:`needs_recordings`."""
    path = FIXTURES / name
    return path.read_bytes() if path.exists() else b""
