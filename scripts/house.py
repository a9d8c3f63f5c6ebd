"""Measure the package room by room: its size, how finely it is cut, and how it hangs together.

    python scripts/house.py             # the table; --json: as JSON
    python scripts/house.py --budgets   # its part of scripts/budgets.toml, with today's numbers
    python scripts/house.py --check     # holds them against scripts/budgets.toml: `make check`

A room is a folder of the package, of ``vehicles`` each folder, and ``(top)`` is the modules in no folder. *core* is the
rooms of ``CORE`` together, *house* all.

- *files*, *lines*: of ``*.py``, all of them, empty ones too.
- *code*: lines that are not blank, not a comment alone, and not of a docstring.
- *file*, *function*: the median length [lines]; of a function or method from ``def`` to its end, without decorators.
- *small*: classes of at most 12 lines at the top of a module, without decorators.
- *imports*: lines of import statements, wherever they stand, and their *share* of all lines.
- *one importer*: modules that just one other module of the package imports, wherever the import stands.
- *chain*: the longest chain of modules of which each imports the next while it is itself imported, so not in functions
  and not for type checkers; a room's longest begins in it. ``from skyloop.a import b`` imports ``skyloop.a.b`` where
  that is a module, else ``skyloop/a/__init__.py``. That packages run before their modules is left out.
- *_core*: uses of an attribute ``_core`` outside the client and ``extend.py``, past a drone's public face.
"""

from __future__ import annotations

import argparse
import ast
import json
import statistics
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final, TypeAlias

ROOT: Final = Path(__file__).parents[1]
BUDGETS: Final = ROOT / "scripts" / "budgets.toml"
CORE: Final = ("messages", "transport", "proxy", "client", "aio", "drivers")
SMALL: Final = 12  #: maximum lines of a small class
#: The budgets of the whole package; of each room and of the core the first two.
BUDGETED: Final = ("files", "lines", "small", "chain", "_core")

Rows: TypeAlias = Mapping[str, Mapping[str, float]]


@dataclass(slots=True)
class Module:
    """The measurements of one file."""

    room: str
    lines: int
    code: int = 0
    functions: list[int] = field(default_factory=list)
    classes: list[int] = field(default_factory=list)
    import_lines: int = 0
    core_uses: int = 0
    imports: set[str] = field(default_factory=set)  #: anywhere in the file
    chained: set[str] = field(default_factory=set)  #: those that run on import


def room_of(path: Path) -> str:
    """Return the room of a file, by its path in the package."""
    parts = path.parts[:-1] or ("(top)",)
    return "/".join(parts[:2] if parts[0] == "vehicles" else parts[:1])


def measure(package: Path) -> dict[str, Module]:
    """Read a package's files, by the names of their modules."""
    paths: dict[str, Path] = {}
    for path in sorted(package.rglob("*.py")):
        name = ".".join(path.relative_to(package.parent).with_suffix("").parts)
        paths[name.removesuffix(".__init__")] = path
    return {
        name: measure_file(name, path.read_text(encoding="utf-8"), room_of(path.relative_to(package)), paths)
        for name, path in paths.items()
    }


def measure_file(name: str, text: str, room: str, known: Container[str]) -> Module:
    """Measure a module's text. ``known`` are the names of the package's modules."""
    tree, lines = ast.parse(text), text.splitlines()
    found = Module(room, len(lines), classes=[_length(node) for node in tree.body if isinstance(node, ast.ClassDef)])
    documented: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            found.import_lines += _length(node)
            found.imports |= _imported(node, known) - {name}
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            found.functions.append(_length(node))
        elif isinstance(node, ast.Attribute):
            found.core_uses += node.attr == "_core" and room != "client" and name != "skyloop.extend"
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and (
            ast.get_docstring(node, clean=False) is not None
        ):
            documented.update(range(node.body[0].lineno, node.body[0].lineno + _length(node.body[0])))
    for statement in _run_at_import(tree.body):
        found.chained |= _imported(statement, known) - {name}
    kept = (line.strip() for number, line in enumerate(lines, 1) if number not in documented)
    found.code = sum(bool(line) and not line.startswith("#") for line in kept)
    return found


def _length(node: ast.stmt) -> int:
    return (node.end_lineno or node.lineno) - node.lineno + 1


def _imported(node: ast.Import | ast.ImportFrom, known: Container[str]) -> set[str]:
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names if alias.name in known}
    home = node.module or ""
    both = {f"{home}.{alias.name}" if f"{home}.{alias.name}" in known else home for alias in node.names}
    return {each for each in both if each in known}


def _run_at_import(body: Iterable[ast.AST]) -> Iterator[ast.Import | ast.ImportFrom]:
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from _run_at_import(node.orelse)
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.expr):
            yield from _run_at_import(ast.iter_child_nodes(node))


def house(modules: Mapping[str, Module]) -> Rows:
    """Return the figures of each room, of the core and of the whole package."""
    importers = Counter(name for module in modules.values() for name in module.imports)

    @cache
    def chain(name: str) -> int:  # circular imports would never end: `lint-imports` allows none
        return 1 + max(map(chain, modules[name].chained), default=0)

    rooms: dict[str, list[str]] = defaultdict(list)
    for name, module in sorted(modules.items(), key=lambda item: item[1].room):
        rooms[module.room].append(name)
    rooms["core"] = [name for name, module in modules.items() if module.room in CORE]
    rooms["house"] = list(modules)
    rows = {}
    for room, names in rooms.items():
        chosen = [modules[name] for name in names]
        lines, imports = sum(each.lines for each in chosen), sum(each.import_lines for each in chosen)
        rows[room] = {
            "files": len(chosen),
            "lines": lines,
            "code": sum(each.code for each in chosen),
            "file": statistics.median(each.lines for each in chosen),
            "function": statistics.median([length for each in chosen for length in each.functions] or [0]),
            "small": sum(length <= SMALL for each in chosen for length in each.classes),
            "imports": imports,
            "share": imports / max(1, lines),
            "one importer": sum(importers[name] == 1 for name in names),
            "chain": max(map(chain, names), default=0),
            "_core": sum(each.core_uses for each in chosen),
        }
    return rows


def over(measured: Rows, budgets: Rows) -> list[str]:
    """Return a sentence for each budget that is exceeded or missing, or whose room is gone."""
    found = [f"{room} has no budget" for room in measured if room not in budgets]
    found += [f"{room} is gone: remove its budget" for room in budgets if room not in measured]
    return found + [
        f"{room}: {key} is {measured[room][key]:.0f}, the budget is {most:.0f}"
        for room, budget in budgets.items()
        for key, most in budget.items()
        if room in measured and measured[room][key] > most
    ]


def main(arguments: Sequence[str]) -> int:
    """Return 0 unless a budget is exceeded."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    parser.add_argument("--budgets", action="store_true", help="print them as lines of scripts/budgets.toml")
    parser.add_argument("--check", action="store_true", help="hold them against scripts/budgets.toml")
    parser.add_argument("--package", type=Path, default=ROOT / "src" / "skyloop", help="the package to measure")
    options = parser.parse_args(arguments)
    measured = house(measure(options.package))
    if options.check:
        found = over(measured, tomllib.loads(BUDGETS.read_text(encoding="utf-8"))["rooms"])
        print(*found, sep="\n", file=sys.stderr, end="\n" if found else "")
        return 1 if found else 0
    if options.json:
        print(json.dumps(measured, indent=1))
    elif options.budgets:
        for room, row in measured.items():
            held = ", ".join(f"{key} = {row[key]:.0f}" for key in BUDGETED[: 5 if room == "house" else 2])
            print(f'"{room}" = {{ {held} }}')
    else:
        print(f"{'room':16}", *(f"{head:>{max(7, len(head))}}" for head in measured["house"]))
        for room, row in measured.items():
            cells = (f"{value:{max(7, len(key))}{'.1%' if key == 'share' else ',.0f'}}" for key, value in row.items())
            print(f"{room:16}", *cells)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
