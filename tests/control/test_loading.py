"""Load a user's controller from a file, with errors that explain what is wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skyloop.control import Controller
from skyloop.control.loading import load_controller
from skyloop.errors import FileFormatError, UnknownNameError, UsageError

ONE = "import skyloop\nclass One(skyloop.Controller):\n    gain = 2.0\n"
TWO = ONE + "class Two(skyloop.Controller):\n    pass\n"
Write = Callable[[str], Path]


@pytest.fixture(autouse=True)
def _modules_as_before() -> Iterator[None]:
    path, modules = list(sys.path), set(sys.modules)
    yield
    sys.path[:] = path
    for name in set(sys.modules) - modules:
        if name.startswith(("skyloop_user_", "neighbour")):
            del sys.modules[name]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def writer(text: str, name: str = "mine.py") -> Path:
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return writer


def test_the_only_controller_is_taken(write: Write) -> None:
    found = load_controller(write(ONE))
    assert issubclass(found, Controller)
    assert (found.__name__, found.gain) == ("One", 2.0)  # type: ignore[attr-defined]


def test_one_of_several_is_taken_by_name(write: Write) -> None:
    assert load_controller(write(TWO), "Two").__name__ == "Two"
    with pytest.raises(UsageError, match=r"several controllers \(One, Two\): choose one with --class"):
        load_controller(write(TWO))
    with pytest.raises(UnknownNameError, match="did you mean 'Two'"):
        load_controller(write(TWO), "Too")


def test_a_file_may_import_its_neighbours(write: Write, tmp_path: Path) -> None:
    (tmp_path / "neighbour.py").write_text(ONE + "GAIN = 3.0\n")
    own = write("import skyloop\nfrom neighbour import GAIN, One\nclass Mine(skyloop.Controller):\n    gain = GAIN\n")
    assert load_controller(own).__name__ == "Mine"
    assert load_controller(own, "One").__module__ == "neighbour"


def test_an_imported_controller_counts_if_there_is_no_other(write: Write, tmp_path: Path) -> None:
    (tmp_path / "neighbour_two.py").write_text(ONE)
    assert load_controller(write("from neighbour_two import One\n")).__name__ == "One"


def test_dataclasses_work_in_the_file(write: Write) -> None:
    text = (
        "from __future__ import annotations\nfrom dataclasses import dataclass\n@dataclass\nclass P:\n    x: int = 1\n"
    )
    assert load_controller(write(text + ONE.replace("2.0", "P().x"))).gain == 1  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def f(:\n", r"mine\.py: line 1: invalid syntax"),
        ("import skyloop\n\nimport numpi\n", r"mine\.py, line 3: ModuleNotFoundError: No module named 'numpi'"),
        ("def f():\n    return 1 / 0\nf()\n", r"mine\.py, line 2: ZeroDivisionError"),
        ("import sys\nsys.exit(0)\n", r"mine\.py, line 2: it ends the program"),
        ("x = 1\n", r"mine\.py has no controller: write a class derived from skyloop\.Controller"),
        ("from skyloop import Controller\n", "has no controller"),
        ("\0", r"mine\.py"),
    ],
)
def test_errors_in_a_file_name_the_place(write: Write, text: str, words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        load_controller(write(text))


def test_the_place_is_named_for_a_relative_path_too(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("import numpi\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileFormatError, match=r"^mine\.py, line 1: ModuleNotFoundError"):
        load_controller("mine.py")


def test_an_error_in_a_neighbour_names_both_files(write: Write, tmp_path: Path) -> None:
    (tmp_path / "neighbour_bad.py").write_text("\ndef f(:\n")
    with pytest.raises(FileFormatError, match=r"mine\.py: .*neighbour_bad\.py, line 2: invalid syntax"):
        load_controller(write("import neighbour_bad\n"))


def test_other_than_python_files_are_refused(write: Write, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"there is no file .*none\.py"):
        load_controller(tmp_path / "none.py")
    with pytest.raises(UsageError, match="is a directory"):
        load_controller(tmp_path)
    (tmp_path / "text.txt").write_text(ONE)
    with pytest.raises(FileFormatError, match=r"must end in \.py"):
        load_controller(tmp_path / "text.txt")
