"""Skyloop closes the loop between a camera and a small drone with a few lines of Python.

::

    import skyloop

    with skyloop.connect("sim://") as drone:
        drone.takeoff()
        drone.velocity(forward=0.3)

The names come from the stub next to this file, ``__init__.pyi``, which type checkers also read. Each name is imported
on first use: ``import skyloop`` loads nothing heavy. More is in the packages: ``skyloop.messages``, ``skyloop.errors``,
``skyloop.control``, ``skyloop.vision``, ….
"""

from __future__ import annotations

import os
import re
from importlib import import_module
from pathlib import Path
from typing import Any

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
# Turn off telemetry in dependencies before importing them (see docs/security.md). To allow telemetry, set the variable.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

#: The module from which each name is imported.
_HOMES = {name: home for home, name in re.findall(r"^from (\S+) import (\w+) as \2$", _STUB, re.MULTILINE)}
#: Packages to search for names that are not available here, beginning with the fastest to import.
_ELSEWHERE = ("errors", "messages", "client", "control", "recording", "motion_capture")

__all__ = sorted(["__version__", *_HOMES])  # noqa: PLE0605  (made of the stub)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value = _version()
    elif name not in _HOMES:
        raise AttributeError(f"module 'skyloop' has no attribute {name!r}{_hint(name)}")
    elif _HOMES[name] == __name__:
        value = import_module(f"{__name__}.{name}")
    else:
        value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _hint(name: str) -> str:
    """Return where to find the class ``name``, for an error message; empty if there is no such class."""
    if not name[:1].isupper():
        return ""
    for package in _ELSEWHERE:
        if hasattr(import_module(f"{__name__}.{package}"), name):
            return f": it is in skyloop.{package} (from skyloop.{package} import {name})"
    return ""


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("skyloop")
    except PackageNotFoundError:
        return "0+unknown"
