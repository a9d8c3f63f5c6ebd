"""Loads and reloads the user's controller from a Python file; errors state the line and the reason.

When the file, or a module in the same folder that it imports, is saved, it is reloaded without interrupting the flight.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
import threading
import time
from collections import deque
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Final, Self

from skyloop.control.controller import Controller
from skyloop.errors import FileFormatError, SkyloopError, UnknownNameError, UsageError

POLL_S: Final = 0.1  #: interval at which the files are polled
Stamp = tuple[int, int, int]  #: modification time [ns], size and inode, which change when a file is saved


def load_controller(path: str | Path, class_name: str | None = None) -> type[Controller]:
    """Load the controller class from a Python file; the class name is only needed if there are several.

    The file is executed and, like a script, can import modules from its own folder. Imported classes are considered
    only if the file itself defines no controller. A :class:`FileFormatError` states the line that can't be executed.
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
    """A loader that always compiles: Python's cache misses changes that keep the size within the same second."""

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
    sys.modules[module_name] = module  # needed for dataclasses and pickling in the user's file
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        where = "" if _is(error.filename, file) else f"{error.filename}, "
        raise FileFormatError(f"{file}: {where}line {error.lineno}: {error.msg}") from error
    except SystemExit as error:
        raise FileFormatError(
            f"{file}{_line_of(error, file)}: it ends the program when loaded; put script code "
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
    """Return the text of the line in the user's file that raised an exception; empty if raised elsewhere."""
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
    """Execute a Python file as a separate module; ``what`` names the expected content in the error message."""
    if file.is_dir():
        raise UsageError(f"{file} is a directory: give a Python file in it")
    if not file.exists():
        raise UsageError(f"there is no file {file}: give a Python file with {what}")
    return _run(file)


class Reloader:
    """Watches a controller's file and reloads it on a background thread after each save. A context manager.

    A file counts as saved once it has not changed for ``poll_s / 2``, so that no half-written file is loaded.
    """

    def __init__(self, path: str | Path, class_name: str | None = None, *, poll_s: float = POLL_S) -> None:
        """Record the files' state, to be polled every ``poll_s``. The thread starts when the context is entered."""
        self._path = Path(path)
        self._folder = self._path.resolve().parent
        self._class_name = class_name
        self._poll_s = poll_s
        self._seen = self._stamps()
        self._loaded: deque[type[Controller] | SkyloopError] = deque(maxlen=1)
        self._saved_at = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-reloader", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    @property
    def waiting(self) -> bool:
        """Whether :meth:`take` has anything to return."""
        return bool(self._loaded)

    @property
    def age_s(self) -> float:
        """Time since a change was last detected [s]."""
        return time.monotonic() - self._saved_at

    def take(self) -> type[Controller] | SkyloopError | None:
        """Return the new class or the error that prevented loading it; None if there is nothing new."""
        return self._loaded.popleft() if self._loaded else None

    def poll(self) -> None:
        """Check the files once, and load them if they have changed."""
        found = self._stamps()
        if found == self._seen:
            return
        self._saved_at = time.monotonic()
        while (again := self._settled()) != found:  # the file is still being written
            found = again
        self._seen = found
        try:
            self._loaded.append(self._load())
        except SkyloopError as error:
            self._loaded.append(error)
        self._seen = {**self._stamps(), **found}  # also watch modules imported by the new version

    def _settled(self) -> dict[Path, Stamp]:
        self._ended.wait(self._poll_s / 2)
        return self._stamps()

    def _run(self) -> None:
        while not self._ended.wait(self._poll_s):
            self.poll()

    def _load(self) -> type[Controller]:
        """Reload the file and the modules in its folder; on failure, restore the previously loaded modules."""
        before = self._neighbours()
        for name in before:
            sys.modules.pop(name, None)
        try:
            return load_controller(self._path, self._class_name)
        except BaseException:
            sys.modules.update(before)
            raise

    def _neighbours(self) -> dict[str, ModuleType]:
        """Return the loaded modules from the folder of the user's file, including the file itself."""
        loaded = dict(sys.modules)
        tops = {name for name in loaded if "." not in name and self._lies_here(name, loaded[name])}
        return {name: module for name, module in loaded.items() if name.partition(".")[0] in tops and _file(module)}

    def _lies_here(self, name: str, module: ModuleType) -> bool:
        file = _file(module)
        if file is None or name in ("__main__", "skyloop"):
            return False
        return file.parent == self._folder or (file.name == "__init__.py" and file.parent.parent == self._folder)

    def _stamps(self) -> dict[Path, Stamp]:
        files = {self._path.resolve(), *(file for module in self._neighbours().values() if (file := _file(module)))}
        return {file: stamp for file in files if (stamp := _stamp(file)) is not None}


def _file(module: ModuleType) -> Path | None:
    origin = getattr(module, "__file__", None)
    return Path(origin) if isinstance(origin, str) else None


def _stamp(file: Path) -> Stamp | None:
    """Return a stamp that changes with each save; None if the file is missing, for example during a save."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino
