"""Reload a controller's file after a save."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from skyloop.control import Controller
from skyloop.control.loading import Reloader, load_controller
from skyloop.errors import FileFormatError
from skyloop.transport.testing import wait_until

TEXT = """
import skyloop
from gains import GAIN

class Mine(skyloop.Controller):
    number = 1
    gain = GAIN
"""


@pytest.fixture
def file(tmp_path: Path) -> Iterator[Path]:
    path, modules, bytecode = list(sys.path), set(sys.modules), sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    (tmp_path / "gains.py").write_text("GAIN = 0.1\n")
    (tmp_path / "mine.py").write_text(TEXT)
    yield tmp_path / "mine.py"
    sys.path[:] = path
    sys.dont_write_bytecode = bytecode
    for name in set(sys.modules) - modules:
        del sys.modules[name]


def controller(reloader: Reloader) -> type[Controller]:
    found = reloader.take()
    assert isinstance(found, type)
    return found


def test_nothing_is_loaded_while_nothing_is_saved(file: Path) -> None:
    load_controller(file)
    reloader = Reloader(file, poll_s=0.002)
    reloader.poll()
    assert not reloader.waiting
    assert reloader.take() is None


def test_a_saved_file_is_loaded_even_within_the_same_second_and_with_the_same_size(file: Path) -> None:
    load_controller(file)
    reloader = Reloader(file, poll_s=0.002)
    for number in "2345":
        file.write_text(TEXT.replace("number = 1", f"number = {number}"))
        reloader.poll()
        assert controller(reloader).number == int(number)  # type: ignore[attr-defined]
    assert reloader.take() is None, "each change is reported once"


def test_a_neighbour_that_it_imports_counts_too(file: Path) -> None:
    load_controller(file)
    reloader = Reloader(file, poll_s=0.002)
    (file.parent / "gains.py").write_text("GAIN = 0.2\n")
    reloader.poll()
    assert controller(reloader).gain == 0.2  # type: ignore[attr-defined]
    (file.parent / "unrelated.py").write_text("nobody imports this")
    reloader.poll()
    assert not reloader.waiting


def test_a_broken_file_is_reported_and_a_fixed_one_loaded(file: Path) -> None:
    load_controller(file)
    gains = sys.modules["gains"]
    reloader = Reloader(file, poll_s=0.002)
    file.write_text("def (")
    reloader.poll()
    error = reloader.take()
    assert isinstance(error, FileFormatError)
    assert "line 1" in str(error)
    assert sys.modules["gains"] is gains, "the flying controller keeps its modules"
    file.write_text(TEXT.replace("number = 1", "number = 7"))
    reloader.poll()
    assert controller(reloader).number == 7  # type: ignore[attr-defined]


def test_a_file_missing_for_a_moment_is_reported_and_found_again(file: Path) -> None:
    load_controller(file)
    reloader = Reloader(file, poll_s=0.002)
    file.rename(file.with_suffix(".old"))
    reloader.poll()
    assert "there is no file" in str(reloader.take())
    file.with_suffix(".old").rename(file)
    reloader.poll()
    assert controller(reloader).number == 1  # type: ignore[attr-defined]


def test_the_thread_polls_and_ends_with_its_block(file: Path) -> None:
    load_controller(file)
    with Reloader(file, poll_s=0.002) as reloader:
        file.write_text(TEXT.replace("number = 1", "number = 3"))
        wait_until(lambda: reloader.waiting, "it was loaded")
        assert reloader.age_s < 60.0
    assert controller(reloader).number == 3  # type: ignore[attr-defined]
