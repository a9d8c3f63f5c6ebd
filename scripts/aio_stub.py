"""Write the stub of `skyloop.aio`, which type checkers and editors read instead of its tables: `make stubs`.

    python scripts/aio_stub.py    # src/skyloop/aio/__init__.pyi, which ruff then formats

The stub has each public class and function with its arguments and docstring at run time. A test compares it with the
code.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections import defaultdict
from collections.abc import Iterator
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Final

from skyloop import aio

STUB: Final = Path(__file__).parents[1] / "src" / "skyloop" / "aio" / "__init__.pyi"
_HEAD: Final = "# Made by scripts/aio_stub.py (`make stubs`) of bridge.py and of the synchronous classes.\n\n"
_imports: dict[str, set[str]] = defaultdict(set)  #: names used in the stub, by their module


class _Source:
    """A value shown as this text in a signature."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def stub() -> str:
    """Return the text of the stub."""
    _imports.clear()
    _imports["skyloop.aio.bridge"].add("Callback as Callback")
    lines: list[str] = []
    for name in aio.__all__[1:]:  # Callback is an alias
        value = getattr(aio, name)
        lines += _class(name, value) if inspect.isclass(value) else _function(name, value)
    imports = [f"from {module} import {', '.join(sorted(names))}" for module, names in sorted(_imports.items())]
    return _HEAD + "\n".join([*imports, "", f"__all__ = {aio.__all__}", "", *lines, ""])


def _class(name: str, kind: type) -> Iterator[str]:
    home = kind.__module__
    bases = next(one.bases for one in _tree(home).body if isinstance(one, ast.ClassDef) and one.name == name)
    yield f"class {name}({', '.join(_named(ast.unparse(one), home) for one in bases)}):"
    yield from _text(kind, "    ")
    for key, annotation in inspect.get_annotations(kind).items():
        yield f"    {key}: {_named(annotation, home)}"
    for member, value in vars(kind).items():
        if isinstance(value, property):
            yield "    @property"
            yield from _function(member, value.fget, "    ")
        elif inspect.isfunction(value):
            yield from _function(member, value, "    ")


def _function(name: str, function: Any, indent: str = "") -> Iterator[str]:
    home, theirs = inspect.unwrap(function).__module__, hasattr(function, "__wrapped__")
    signature = inspect.signature(function)
    parameters = [
        one.replace(
            annotation=one.annotation if one.annotation is one.empty else _Source(_named(one.annotation, home, theirs)),
            default=_member(one.default) if isinstance(one.default, Enum) else one.default,
        )
        for one in signature.parameters.values()
    ]
    returns = _Source(_named(signature.return_annotation, home, theirs))
    begin = "async def" if inspect.iscoroutinefunction(function) else "def"
    yield f"{indent}{begin} {name}{signature.replace(parameters=parameters, return_annotation=returns)}:"
    yield from list(_text(function, indent + "    ")) or [f"{indent}    ..."]


def _text(documented: Any, indent: str) -> Iterator[str]:
    text = inspect.cleandoc(documented.__doc__ or "").splitlines()
    if text:
        text = [f'"""{text[0]}', *text[1:]]
        text = [*text, '"""'] if len(text) > 1 else [f'{text[0]}"""']
    yield from ((indent + line).rstrip() for line in text)


def _member(value: Enum) -> _Source:
    return _Source(f"{type(value).__name__}.{value.name}")  # also named by the annotation


def _named(annotation: str, home: str, theirs: bool = False) -> str:
    """Return an annotation of module ``home``, and record the modules of its names."""
    tree = ast.parse(annotation, mode="eval")
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id in aio.__all__ and theirs:
            node.id = f"client.{node.id}"
            _imports["skyloop"].add("client")
        elif isinstance(node, ast.Name) and node.id not in aio.__all__:
            found = _sources(home).get(node.id) or _sources("skyloop.aio.bridge").get(node.id)
            if found is not None:
                _imports[found].add(node.id)
    return ast.unparse(tree)


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(Path(sys.modules[module].__file__ or "").read_text(encoding="utf-8"))


@cache
def _sources(module: str) -> dict[str, str]:
    """Return the module of each top-level name in a module."""
    found: dict[str, str] = {}
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name: node.module or "" for alias in node.names}
    for node in _tree(module).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
        found |= {name: module for one in targets if (name := getattr(one, "id", getattr(one, "name", None)))}
    return found


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")
