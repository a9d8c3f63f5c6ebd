"""The public API: names of the documented modules, and the attributes of a drone and a swarm. Nothing else is public.

``python -m tests.test_surface`` rewrites ``tests/data/public.txt``; names added there become promises.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from skyloop.client import Config, Drone, Swarm, TakeoverRequest

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).parent / "data" / "public.txt"
MODULES = sorted(
    {"skyloop", "skyloop.extend"}
    | {
        name
        for page in (ROOT / "docs" / "api").glob("*.rst")
        for name in re.findall(r"^\.\. automodule:: ([\w.]+)", page.read_text(), re.MULTILINE)
    }
)


def public() -> Iterator[str]:
    """Names of modules, and members of the classes whose objects users hold."""
    for name in MODULES:
        module = importlib.import_module(name)
        every = getattr(module, "__all__", None) or [
            own
            for own, value in vars(module).items()
            if getattr(value, "__module__", None) == name and own[0] != "_" and not isinstance(value, TypeVar)
        ]
        yield from (f"{name}.{own}" for own in every)
    for kind in (Drone, Swarm, Config, TakeoverRequest):
        attributes = re.findall(r"^ +self\.(\w+)(?:: [^=\n]+)? = ", inspect.getsource(kind), re.MULTILINE)
        yield from (f"{kind.__name__}: {own}" for own in (*dir(kind), *attributes) if own[0] != "_")


def test_the_list_says_what_is_public() -> None:
    pytest.importorskip("gymnasium")
    pytest.importorskip("cv2")
    assert sorted(set(public())) == LIST.read_text().splitlines(), (
        "python -m tests.test_surface, and look at the change"
    )


if __name__ == "__main__":
    LIST.write_text("\n".join(sorted(set(public()))) + "\n")
