"""The user's class from a module or a file, and the errors if that fails."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from skyloop.errors import FileFormatError, UnknownNameError, UsageError
from skyloop.processing import Code, load_processor

GOOD = "class Detector:\n    def process(self, frame):\n        return 1\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    path, modules = list(sys.path), set(sys.modules)
    yield tmp_path
    sys.path[:] = path
    for name in set(sys.modules) - modules:
        del sys.modules[name]


def test_a_file_and_a_module_with_the_same_class_are_the_same_code(folder: Path) -> None:
    (folder / "one_detector.py").write_text(GOOD)
    by_file = load_processor("one_detector.py")
    assert by_file.name == "detector"
    assert by_file.make().process(None) == 1
    assert by_file.mark.startswith("Detector ")
    for target in ("one_detector.py:Detector", "one_detector:Detector", str(folder / "one_detector.py")):
        assert load_processor(target).mark == by_file.mark


def test_other_code_has_another_mark(folder: Path) -> None:
    (folder / "a.py").write_text(GOOD)
    (folder / "b.py").write_text(GOOD + "# changed\n")
    assert load_processor("a.py").mark != load_processor("b.py").mark


def test_a_class_without_a_file_has_a_mark_from_its_code() -> None:
    def made(text: str) -> Code:
        names: dict[str, type] = {"__name__": "nowhere"}  # type: ignore[dict-item]
        exec(text, names)
        return Code.of(names["Detector"])

    assert made(GOOD).mark == made(GOOD).mark
    assert made(GOOD).mark != made(GOOD.replace("return 1", "return frame.mean()")).mark


def test_one_of_several_is_named(folder: Path) -> None:
    (folder / "two.py").write_text(GOOD + GOOD.replace("Detector", "Finder"))
    assert load_processor("two.py:Finder").name == "finder"
    with pytest.raises(UsageError, match=r"several processors \(Detector, Finder\): choose one with two.py:CLASS"):
        load_processor("two.py")
    with pytest.raises(UnknownNameError, match="'Findr'; did you mean 'Finder'"):
        load_processor("two.py:Findr")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\n", "has no processor: write a class with a method process"),
        ("class A:\n    process = 7\n", "has no processor"),
        ("class A:\n    def process(self): ...\n", "A.process must take one frame"),
        ("class A:\n    async def process(self, frame): ...\n", "must be a plain function"),
        ("1 / 0\n", "bad.py, line 1: ZeroDivisionError"),
        ("class A(\n", "bad.py: line 1"),
    ],
)
def test_a_bad_file_is_reported(folder: Path, text: str, words: str) -> None:
    (folder / "bad.py").write_text(text)
    with pytest.raises(UsageError) as raised:
        load_processor("bad.py")
    assert words in str(raised.value)


def test_a_class_that_is_not_a_processor(folder: Path) -> None:
    (folder / "bad.py").write_text("class A: ...\n")
    with pytest.raises(UsageError, match="A is not a processor: it has no method process"):
        load_processor("bad.py:A")


@pytest.mark.parametrize(
    ("target", "error", "words"),
    [
        (
            "nowhere.py",
            UsageError,
            "there is no file nowhere.py: give a Python file with a class with a method process",
        ),
        ("detector", UsageError, "'detector' is not a processor: give module:Class, file.py:Class or file.py"),
        (":Detector", UsageError, "is not a processor"),
        ("no_such_module:Detector", UsageError, "there is no module no_such_module here or on Python's path"),
        ("broken_module:Detector", FileFormatError, "module broken_module: ZeroDivisionError"),
        ("lacking_module:Detector", FileFormatError, "module lacking_module: No module named 'not_there_at_all'"),
    ],
)
def test_targets_that_do_not_exist(folder: Path, target: str, error: type[Exception], words: str) -> None:
    (folder / "broken_module.py").write_text("1 / 0\n")
    (folder / "lacking_module.py").write_text("import not_there_at_all\n")
    with pytest.raises(error) as raised:
        load_processor(target)
    assert words in str(raised.value)


def test_a_class_that_needs_arguments(folder: Path) -> None:
    (folder / "needy.py").write_text(GOOD + "    def __init__(self, model): ...\n")
    with pytest.raises(UsageError, match=r"can't be made as Detector\(\): missing a required argument: 'model'; give"):
        load_processor("needy.py").make()
