"""The borders between packages, and between tests: what each may use of another."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from skyloop.client import Drone, Swarm

TESTS = Path(__file__).parent
SOURCE = TESTS.parent / "src" / "skyloop"
KINDS = (Drone, Swarm)
#: The client, its asyncio face, and the one module through which other packages reach further.
INSIDE = ("client/", "aio/", "extend.py")


def private_names() -> set[str]:
    """Private attributes and methods that the two classes set or define."""
    found = set()
    for name in ("drone", "swarm"):
        tree = ast.parse((SOURCE / "client" / f"{name}.py").read_text())
        for kind in (each for each in tree.body if isinstance(each, ast.ClassDef)):
            if kind.name in {one.__name__ for one in KINDS}:
                found |= {one.name for one in kind.body if isinstance(one, ast.FunctionDef)}
                found |= {one.attr for one in ast.walk(kind) if isinstance(one, ast.Attribute) and _is_own(one)}
    return {name for name in found if name.startswith("_") and not name.startswith("__")}


def _is_own(attribute: ast.Attribute) -> bool:
    return isinstance(attribute.value, ast.Name) and attribute.value.id == "self"


def private_uses(source: str, names: set[str]) -> list[str]:
    """Uses of these names on other objects, and on ``self`` in classes derived from a drone or a swarm."""
    if not re.search(rf"(?<!\bself)\.({'|'.join(names)})\b|\bclass .*\b(Drone|Swarm)\b", source):
        return []  # most modules need no parsing
    tree = ast.parse(source)
    kinds = {kind.__name__ for kind in KINDS}
    heirs = [
        one
        for one in ast.walk(tree)
        if isinstance(one, ast.ClassDef) and kinds & {ast.unparse(base).split(".")[-1] for base in one.bases}
    ]
    inherited = {id(node) for heir in heirs for node in ast.walk(heir)}
    return [
        f"{node.lineno}: {ast.unparse(node)}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr in names and (not _is_own(node) or id(node) in inherited)
    ]


def test_private_attributes_are_found() -> None:
    names = private_names()
    assert {"_commands", "_state", "_listen", "_drones", "_leave"} <= names
    mine = "class Mine(Drone):\n    def f(self, other):\n        return self._commands, self._own, other.sync._state"
    assert private_uses(mine, names) == ["3: self._commands", "3: other.sync._state"]
    assert not private_uses("class Theirs:\n    def f(self):\n        return self._state\n", names)


def test_only_the_client_uses_private_attributes() -> None:
    names = private_names()
    found = [
        f"{module}:{use}"
        for path in sorted(SOURCE.rglob("*.py"))
        if not (module := path.relative_to(SOURCE).as_posix()).startswith(INSIDE)
        for use in private_uses(path.read_text(), names)
    ]
    assert not found, "use skyloop.extend, or add to it"


def test_windows_can_import_all_test_modules() -> None:
    """Modules that it lacks are imported where they are used, by tests that are skipped there."""
    lacks = {"curses", "fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
    found = [
        f"{path.relative_to(TESTS)}: {alias.name}"
        for path in sorted(TESTS.rglob("*.py"))
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.Import)
        for alias in node.names
        if alias.name in lacks
    ]
    assert not found


def test_no_test_module_imports_another() -> None:
    """What several share lies in a conftest, in a helper beside them or, for several rooms, in ``tests/support``."""
    found = []
    for path in sorted(TESTS.rglob("*.py")):
        for line in re.findall(r"^ *(?:from|import) (tests\b.*)", path.read_text(), re.MULTILINE):
            module, _, names = line.partition(" import ")
            room = path.relative_to(TESTS).parts[0]
            theirs = module.split(".")[1:2] not in ([room], ["support"], ["conftest"])
            if re.search(r"\btest_", module) or names.startswith("test_") or theirs:
                found.append(f"{path.relative_to(TESTS)}: {line}")
    assert not found
