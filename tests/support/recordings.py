"""Recordings of real vehicles by others. They are not part of the project: tests find them beside the checkout, in
``../shared/fixtures``, or where the variable ``SKYLOOP_FIXTURES`` points, and are skipped without them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import pytest

FIXTURES: Final = Path(os.environ.get("SKYLOOP_FIXTURES") or Path(__file__).parents[3] / "shared" / "fixtures")
WHY: Final = f"needs data recorded from real vehicles, and {FIXTURES} is not there: set SKYLOOP_FIXTURES to its folder"
#: Marks a test that needs recorded data which its module reads on import.
needs_recordings: Final = pytest.mark.skipif(not FIXTURES.is_dir(), reason=WHY)


def recorded(name: str) -> Path:
    """Return a recorded file or folder; skip the test or fixture if it is missing."""
    path = FIXTURES / name
    if not path.exists():
        pytest.skip(WHY if not FIXTURES.is_dir() else f"{path} is not there")
    return path


def content(name: str) -> bytes:
    """Return a recorded file's content, for use at import; empty if it is missing, see :data:`needs_recordings`."""
    path = FIXTURES / name
    return path.read_bytes() if path.exists() else b""
