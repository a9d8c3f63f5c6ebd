"""Tests that mean something on some systems only, real or pretended (``elsewhere/sitecustomize.py``)."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

#: What Skyloop takes for its system.
PLATFORM = os.environ.get("SKYLOOP_PRETEND") or sys.platform

#: Step of the clock there, if it is long: a time may be that much older than it is, and two may be equal.
STEP_NS = 15_625_000 if PLATFORM == "win32" else 0


def only_on(*systems: str, reason: str) -> pytest.MarkDecorator:
    """Skip a test on all other systems. ``reason``: what they lack, or what the test reads there."""
    return pytest.mark.skipif(PLATFORM not in systems, reason=f"not on {PLATFORM}: {reason}")


has_modes = only_on("linux", "darwin", reason="modes and groups of files say nothing there")


def only_root(does: str) -> pytest.MarkDecorator:
    """Skip a test unless it runs as root. ``does``: what only root can do."""
    return pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason=f"only root can {does}")


def served_files(folder: Path) -> list[str]:
    """Return what is in a directory of proxies, except for the lock of Windows, where no directory can be locked."""
    return sorted(path.name for path in folder.iterdir() if PLATFORM != "win32" or path.name != ".lock")
