"""The proxy's decisions import nothing with its own thread, lock, socket or clock."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import skyloop.proxy.core
import skyloop.zones

ALLOWED = {
    "__future__",
    "bisect",
    "collections",
    "collections.abc",
    "dataclasses",
    "enum",
    "math",
    "re",
    "skyloop.clock",
    "skyloop.errors",
    "skyloop.messages",
    "skyloop.proxy.core",
    "skyloop.zones",
    "typing",
}
CLOCKS = {"monotonic_ns", "Clock", "ManualClock"}
FILES = [*sorted(Path(skyloop.proxy.core.__file__).parent.glob("*.py")), Path(skyloop.zones.__file__)]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_decision_depends_only_on_its_arguments(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            assert {name.name for name in node.names} <= ALLOWED
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            assert any(module == allowed or module.startswith(f"{allowed}.") for allowed in ALLOWED), module
            assert CLOCKS.isdisjoint(name.name for name in node.names)
