"""The page of the examples shows each of them, with a picture that the script of pictures makes."""

from __future__ import annotations

import ast
import itertools
import re
import tomllib
from pathlib import Path

import pytest

from tests.support.pages import ROOT, rows

PAGE = ROOT / "docs" / "examples.md"
EXAMPLES = sorted(path for path in (ROOT / "examples").iterdir() if path.suffix in (".py", ".ipynb"))
FROM_ELSEWHERE = {"notebook"}  # a package, no extra
_PICTURE = re.compile(r"!\[[^\]]+\]\(pictures/examples/([\w.]+)\)")


def table() -> dict[str, list[str]]:
    """The row of each example, by its file's name."""
    found = {}
    for row in rows(PAGE.read_text()):
        link = re.fullmatch(r"\[([\w.]+)\]\(\.\./examples/([\w.]+)\)", row[0])
        if link:
            assert link[1] == link[2]
            found[link[1]] = row
    return found


def shown() -> dict[str, str]:
    """The picture above each example's name, by the example's file's name."""
    cells = rows(PAGE.read_text())
    return {
        name[1]: picture[1]
        for above, below in itertools.pairwise(cells)
        for picture, name in (
            (_PICTURE.fullmatch(a), re.match(r"`([\w.]+)`", b)) for a, b in zip(above, below, strict=False)
        )
        if picture and name
    }


def stem(example: Path) -> str:
    """What its picture and that picture's maker are called."""
    return example.stem + ("_notebook" if example.suffix == ".ipynb" else "")


def test_the_table_has_each_example_once() -> None:
    assert sorted(table()) == [path.name for path in EXAMPLES]


def test_the_extras_of_each_are_there_and_fly_a_simulated_drone() -> None:
    known = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    for name, row in table().items():
        extras = set(re.findall(r"`([^`]+)`", row[2]))
        assert extras <= known | FROM_ELSEWHERE, name
        assert extras & {"sim", "gym"}, f"{name} flies the simulator"


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.name)
def test_each_has_a_picture_and_a_maker_of_it(example: Path) -> None:
    picture = shown().get(example.name)
    assert picture is not None, f"{PAGE.name} shows no picture of {example.name}"
    assert Path(picture).stem == stem(example)
    assert (PAGE.parent / "pictures" / "examples" / picture).is_file()
    assert stem(example) in makers(), "scripts/example_pictures.py does not make it"


def makers() -> set[str]:
    """The functions in ``MAKERS``, without running the script, which needs more than the tests do."""
    tree = ast.parse((ROOT / "scripts" / "example_pictures.py").read_text())
    [mapping] = [
        node.value
        for node in tree.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id == "MAKERS"
    ]
    assert isinstance(mapping, ast.DictComp)
    makers = mapping.generators[0].iter
    assert isinstance(makers, ast.Tuple)
    return {maker.id for maker in makers.elts if isinstance(maker, ast.Name)}
