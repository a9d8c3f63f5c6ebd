"""A lab with some identities, at a fixed time."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from skyloop.network.keys import Lab
from skyloop.network.keys.identity import make_identity

NOW = datetime(2030, 5, 1, 12, tzinfo=UTC)


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab.make(tmp_path / "lab", now=NOW)


@pytest.fixture
def jane(lab: Lab) -> Path:
    """Return the folder of a pilot's identity."""
    lab.issue(make_identity("jane", "pilot", "alpha*"), now=NOW)
    return lab.folder("jane")
