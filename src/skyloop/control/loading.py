"""Load the user's controller from a Python file, with errors that give the line and the reason."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType

from skyloop.control.controller import Controller
from skyloop.errors import FileFormatError, UnknownNameError, UsageError


def load_controller(path: str | Path, class_name: str | None = None) -> type[Controller]:
    """Return the controller class in a Python file.

    The file is executed, and may import modules beside it, as a script may. Imported classes count only if the file
    defines none of its own.

    Args:
        path: The Python file.
        class_name: Which class, where the file has several.

    Raises:
        FileFormatError: The file can't be read or executed (with the line), or has no controller.
        UnknownNameError: The file has no class of that name.
        UsageError: The file does not exist, or it has several classes and no name was given.
    """
    file = Path(path)
    module = load_module(file, "a class derived from skyloop.Controller")
    found = {
        name: value
        for name, value in vars(module).items()
        if inspect.isclass(value) and issubclass(value, Controller) and value is not Controller
    }
    own = {name: value for name, value in found.items() if value.__module__ == module.__name__}
    return _choose(own or found, found, class_name, file)


class _FreshLoader(SourceFileLoader):
    """Always compiles the source: Python's cache takes a file of the same second and size for unchanged."""

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)


def _run(file: Path) -> ModuleType:
    module_name = f"skyloop_user_{file.stem}"
    if file.suffix != ".py":
        raise FileFormatError(f"{file} is not a Python file: its name must end in .py")
    path = file.resolve()
    spec = importlib.util.spec_from_file_location(module_name, path, loader=_FreshLoader(module_name, str(path)))
    if spec is None or spec.loader is None:
        raise FileFormatError(f"{file} can't be loaded as a Python module")
    module = importlib.util.module_from_spec(spec)
    folder = str(file.resolve().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    sys.modules[module_name] = module  # so that dataclasses and pickling in the user's file work
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        where = "" if _is(error.filename, file) else f"{error.filename}, "
        raise FileFormatError(f"{file}: {where}line {error.lineno}: {error.msg}") from error
    except SystemExit as error:
        raise FileFormatError(
            f"{file}{_line_of(error, file)}: it ends the program when it is loaded; what only a script does belongs "
            'under if __name__ == "__main__":'
        ) from error
    except Exception as error:
        raise FileFormatError(f"{file}{_line_of(error, file)}: {type(error).__name__}: {error}") from error
    return module


def _choose(
    likely: dict[str, type[Controller]], found: dict[str, type[Controller]], class_name: str | None, file: Path
) -> type[Controller]:
    if class_name is not None:
        if class_name not in found:
            raise UnknownNameError(f"controller in {file}", class_name, found)
        return found[class_name]
    if not likely:
        raise FileFormatError(f"{file} has no controller: write a class derived from skyloop.Controller")
    if len(likely) > 1:
        raise UsageError(f"{file} has several controllers ({', '.join(sorted(likely))}): choose one with --class NAME")
    return next(iter(likely.values()))


def _line_of(error: BaseException, file: Path) -> str:
    """Return where in the user's file an exception was raised, or an empty string if it was elsewhere."""
    traceback = error.__traceback__
    line = None
    while traceback is not None:
        if _is(traceback.tb_frame.f_code.co_filename, file):
            line = traceback.tb_lineno
        traceback = traceback.tb_next
    return f", line {line}" if line is not None else ""


def _is(name: str | None, file: Path) -> bool:
    return name is not None and Path(name).resolve() == file.resolve()


def load_module(file: Path, what: str) -> ModuleType:
    """Execute a Python file as a module of its own.

    Args:
        file: The Python file.
        what: What it should hold; a noun phrase for the error message.

    Raises:
        FileFormatError: The file can't be read or executed (with the line).
        UsageError: The file does not exist, or is a directory.
    """
    if file.is_dir():
        raise UsageError(f"{file} is a directory: give a Python file in it")
    if not file.exists():
        raise UsageError(f"there is no file {file}: give a Python file with {what}")
    return _run(file)
